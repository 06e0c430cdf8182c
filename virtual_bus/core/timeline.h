/* Simulated time: what happens at which instant. */
#ifndef CORE_TIMELINE_H
#define CORE_TIMELINE_H

#include "event_heap.h"

typedef struct TimelineObject {
    PyObject head;
    EventHeap heap;
    int64_t now;
} TimelineObject;

/* What an entry's target is. */
typedef enum Happening {
    CALLBACK,     /* a callable that gets the instant */
    EVENT,        /* an EventObject */
    END_OF_FRAME, /* a SegmentObject */
    LET_IN,       /* a PlaceObject, for a frame that was held on its way in */
    LET_OUT,
} Happening;

/* One that can be taken back; it runs once or never. */
typedef struct EventObject {
    PyObject head;
    PyObject *callback; /* NULL: it ran or was taken back */
} EventObject;

extern PyTypeObject *timeline_type, *event_type;

bool let_happen(TimelineObject *self, int64_t when, Happening kind, PyObject *target);
bool next_event(TimelineObject *self, int64_t *when);
bool step(TimelineObject *self);
bool run_until(TimelineObject *self, int64_t when);
int run_until_filled(TimelineObject *self, int64_t when, PyObject *inbox);
bool call_with_instant(PyObject *callback, int64_t now);

#endif
