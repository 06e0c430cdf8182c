/* Faults of frames at work: random numbers, what strikes or holds a frame, the fate of each, and the log of them. */
#ifndef CORE_FAULTS_H
#define CORE_FAULTS_H

#include <stdbool.h>
#include <stdint.h>

#include "stable_abi.h"

/* Numbers even in [0, 1), of which Python makes a block at a time. */
typedef struct NumbersObject {
    PyObject head;
    PyObject *refill, *block; /* the next block, as octets; the present one */
    const double *numbers;
    Py_ssize_t count, next;
} NumbersObject;

bool draw_number(NumbersObject *self, double *drawn);

/* First ns in which a fault acts, and the first in which it does so no more. */
typedef struct Window {
    int64_t begin, end;
} Window;

enum { CHANCES_MAX = 4 };

typedef enum StrikeShape {
    NO_STRIKE,
    INDEPENDENT, /* chances: of a loss */
    NUMBERED,    /* chances: of a strike; least, width: of its number */
    BURST,       /* chances: to leave the good state, the bad one; of a loss in the good state, the bad one */
    PERIODIC,    /* count: frames seen in the window; width: of them one passes */
    FIRST,       /* count: those left to strike */
    STRIKE_SHAPES,
} StrikeShape;

typedef struct StrikeObject {
    PyObject head;
    PyObject *kind;
    Window window;
    StrikeShape shape;
    bool own_strikes, own_number; /* a Python class on top of it decides */
    NumbersObject *numbers;
    double chances[CHANCES_MAX];
    int64_t least, width, count;
    double value; /* the second draw for the last frame */
    bool bad;
} StrikeObject;

typedef struct Bar {
    int64_t low_ns, width_ns, sum; /* of the counts up to and with this bar */
} Bar;

typedef struct HoldObject {
    PyObject head;
    Window window;
    bool in_order, own_holds;
    NumbersObject *numbers;
    bool measured;
    int64_t least, width; /* uniform */
    int bar_count;        /* measured */
    Bar *bars;
} HoldObject;

bool strikes_frame(StrikeObject *self, int64_t elapsed, bool *struck);
bool number_of_strike(StrikeObject *self, int64_t *number);
bool holds_frame(HoldObject *self, int64_t elapsed, int64_t *held_ns);

/* The order of one link: no frame leaves before the one in front of it. */
typedef struct QueueObject {
    PyObject head;
    int64_t released_at;
} QueueObject;

int64_t release_behind(QueueObject *self, int64_t release);

/* All that can befall the frames of one COB-ID in one direction. */
typedef struct RouteObject {
    PyObject head;
    QueueObject *queue; /* NULL: frames may overtake one another, or are never held */
    PyObject *strikes, *holds; /* tuples */
    int64_t seen, number;
    PyObject *struck; /* the kind that struck the last frame, or NULL */
    bool own_meet;
} RouteObject;

bool meet_frame(RouteObject *self, int64_t elapsed, int64_t n, int64_t *held_ns);

enum {
    /* With its head 3844 octets: a row stays within a page of memory. */
    BLOCK_ENTRIES = 60,
    ENTRY_NUMBERS = 8, /* of servobench.virtual_bus.faults.fault_log.FaultEntry */
    STANDARD_IDS = 1 << 11,
    WAYS = 2,
};

typedef struct BlockObject {
    PyObject head;
    int filled;
    int64_t entries[BLOCK_ENTRIES][ENTRY_NUMBERS];
} BlockObject;

bool note_entry(BlockObject *self, const int64_t *entry);

typedef struct FateWay {
    int64_t frames, delayed;
    RouteObject *routes[STANDARD_IDS];
} FateWay;

typedef struct FatesObject {
    PyObject head;
    BlockObject *log; /* or NULL */
    bool acts;
    int64_t zero, place, delay_code;
    FateWay ways[WAYS];
} FatesObject;

typedef struct JudgedFrame {
    int way;
    int64_t can_id;
    bool extended;
    int64_t now;
} JudgedFrame;

bool fate_of(FatesObject *self, const JudgedFrame *frame, int64_t *held_ns);
void forget_routes(FatesObject *self);

extern PyTypeObject *numbers_type, *strike_type, *hold_type, *queue_type, *route_type, *block_type, *fates_type;

#endif
