/* Frames in and out of a bus by its port, and the taps that see them pass. */
#ifndef CORE_LINK_H
#define CORE_LINK_H

#include "frames.h"
#include "objects.h"

enum { LINK_TAPS_MAX = 16 };

typedef struct TapEntry {
    PyObject *tap, *sink; /* the tap's own way in C, or NULL */
    const SinkWay *way;
} TapEntry;

typedef struct LinkObject {
    PyObject head;
    PyObject *port, *place; /* the port's own way in C, or NULL */
    const PortWay *way;
    PyObject *now, *failures; /* a clock's; classes of the errors of a bus, a tuple */
    int tap_count;
    TapEntry taps[LINK_TAPS_MAX];
    bool waits; /* frames wait for room on the bus */
    int64_t sent_frames, received_frames, echoed_frames, ignored_frames, error_frames;
    FrameObject *last;
    int64_t last_at;
    bool last_own;
} LinkObject;

PyObject *call_named(const char *spelt, PyObject **name, PyObject **arguments, size_t count);
int offer(LinkObject *self, FrameObject *frame, PyObject *at);
PyObject *hand_over(LinkObject *self, FrameObject *frame);
int fetch(LinkObject *self, int64_t until);
int needs_watching(LinkObject *self);

#endif
