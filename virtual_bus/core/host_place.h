/* A participant's place on a segment: its inbox, its sending, and the faults in front of both. */
#ifndef CORE_HOST_PLACE_H
#define CORE_HOST_PLACE_H

#include "faults.h"
#include "segment.h"

enum {
    /* Frames that an inbox holds for its reader; later ones are lost and counted. Three seconds of a bus at 1 Mbit/s
       that is full of the shortest frames, some 20 000 a second. */
    RECEIVE_QUEUE_MAX = 65536,
    /* Frames held in one place; one more is lost and counted: both TPDOs of a cycle of 1 ms for two seconds. */
    HELD_MAX = 4096,
};

/* Frames that wait for their release, an entry's instant. */
typedef struct HeldObject {
    PyObject head;
    EventHeap heap;
    int64_t overflow;
} HeldObject;

typedef struct Arrival {
    PyObject *frame;
    int64_t at;
    bool own;
} Arrival;

typedef struct PlaceObject {
    PyObject head;
    TimelineObject *timeline;
    PortObject *port;
    PyObject *judge, *accepts; /* None: every frame passes */
    FatesObject *fates;        /* the judge itself, if it has no Python in the place of its `hold` */
    HeldObject *held_in, *held_out;
    int way_out, way_in;
    bool closed;
    int64_t overruns;
    Arrival *inbox; /* a ring */
    int first, count, room;
} PlaceObject;

extern PyTypeObject *place_type, *held_type;

bool hold_frame(HeldObject *self, PyObject *frame, int64_t release, int mark, bool *kept);
bool hear_frame(PlaceObject *self, const WireFrame *frame, int64_t now);
PlaceObject *place_told(PyObject *on_sent);
bool keep_frame(PlaceObject *self, PyObject *frame, int64_t at, bool own);
Arrival take_arrival(PlaceObject *self);
bool transmit_frame(PlaceObject *self, const WireFrame *frame);
bool let_in(PlaceObject *self, int64_t now);
bool let_out(PlaceObject *self, int64_t now);

#endif
