/* Nothing happens between two events, so time jumps from one to the next. Events of one instant happen in the
   order in which they were entered: a run depends on nothing but its input. */
#include "timeline.h"

#include "host_place.h"
#include "objects.h"
#include "segment.h"

/* An instant that has passed means: at once. */
bool let_happen(TimelineObject *self, int64_t when, Happening kind, PyObject *target)
{
    return enter(&self->heap, when > self->now ? when : self->now, target, (int)kind);
}

bool call_with_instant(PyObject *callback, int64_t now)
{
    PyObject *arguments[] = {NULL, PyLong_FromLongLong(now)};
    if (arguments[1] == NULL)
        return false;
    bool well = went_well(PyObject_Vectorcall(callback, arguments + 1, 1 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL));
    Py_DecRef(arguments[1]);
    return well;
}

static bool run_event(EventObject *event, int64_t now)
{
    PyObject *callback = event->callback;
    if (callback == NULL)
        return true;
    event->callback = NULL;
    bool well = call_with_instant(callback, now);
    Py_DecRef(callback);
    return well;
}

static bool happen(const HeapEntry *entry)
{
    switch ((Happening)entry->mark) {
    case EVENT:
        return run_event((EventObject *)entry->target, entry->when);
    case END_OF_FRAME:
        return end_frame((SegmentObject *)entry->target, entry->when);
    case LET_IN:
        return let_in((PlaceObject *)entry->target, entry->when);
    case LET_OUT:
        return let_out((PlaceObject *)entry->target, entry->when);
    case CALLBACK:
        break;
    }
    return call_with_instant(entry->target, entry->when);
}

/* Go to the first event of a timeline that has one. False: an error was raised by what happened. */
bool step(TimelineObject *self)
{
    HeapEntry entry = take_first(&self->heap);
    self->now = entry.when;
    bool well = happen(&entry);
    Py_DecRef(entry.target);
    return well;
}

static void stand_at(TimelineObject *self, int64_t when)
{
    if (when > self->now)
        self->now = when;
}

/* The instant of the next event that was not taken back; false if there is none. */
bool next_event(TimelineObject *self, int64_t *when)
{
    EventHeap *heap = &self->heap;
    while (heap->count > 0) {
        const HeapEntry *first = &heap->entries[0];
        if (first->mark != EVENT || ((EventObject *)first->target)->callback != NULL) {
            *when = first->when;
            return true;
        }
        Py_DecRef(take_first(heap).target);
    }
    return false;
}

/* Run every event up to and including `when`, then stand at `when`. */
bool run_until(TimelineObject *self, int64_t when)
{
    while (self->heap.count > 0 && self->heap.entries[0].when <= when) {
        if (!step(self))
            return false;
    }
    stand_at(self, when);
    return true;
}

static Py_ssize_t waiting(PyObject *inbox)
{
    return inbox->type == place_type ? ((PlaceObject *)inbox)->count : PyObject_Size(inbox);
}

/* As run_until, but stop after the event that puts something into `inbox`: 1 if there is something in it, 0 if
   there is nothing, -1 for an error. */
int run_until_filled(TimelineObject *self, int64_t when, PyObject *inbox)
{
    for (;;) {
        Py_ssize_t count = waiting(inbox);
        if (count != 0)
            return count < 0 ? -1 : 1;
        if (self->heap.count == 0 || self->heap.entries[0].when > when) {
            stand_at(self, when);
            return 0;
        }
        if (!step(self))
            return -1;
    }
}
