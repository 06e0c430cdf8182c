/* Commands of one RPDO that wait for their echo, matched by the instant of the hand-over or, where the bus does not
   report that, by the octets of the frame. */
#ifndef CORE_AWAITED_H
#define CORE_AWAITED_H

#include "objects.h"

enum {
    AWAITED_MAX = 256, /* on a bus that has no echoes, or has stopped sending them */
    /* Commands whose echo may still come after a later one's, on a bus that delays frames by so many cycles; older ones
       never reached the bus, and one of equal octets must not be mistaken for them. */
    OVERTAKEN_MAX = 16,
};

typedef struct SentFrame {
    PyObject *data, *command;
    int64_t handed_at;
} SentFrame;

typedef struct SentFrames {
    SentFrame frames[AWAITED_MAX]; /* the oldest first */
    int count, most;
} SentFrames;

typedef struct Awaited {
    SentFrames waiting, overtaken;
} Awaited;

void begin_awaiting(Awaited *self);
void end_awaiting(Awaited *self);
int visit_awaited(Awaited *self, visitproc visit, void *argument);
void await_echo(Awaited *self, PyObject *data, PyObject *command, int64_t handed_at);
bool give_up(Awaited *self, int64_t handed_at);
bool take_echo(Awaited *self, PyObject *data, int64_t at, int64_t handed_at);

#endif
