/* A binary heap of what is to come, the earliest first; entries of one instant in the order of entry. */
#ifndef CORE_EVENT_HEAP_H
#define CORE_EVENT_HEAP_H

#include <stdbool.h>

#include "stable_abi.h"

typedef struct HeapEntry {
    int64_t when, order;
    PyObject *target; /* a reference of the heap's own */
    int mark;         /* the owner's */
} HeapEntry;

typedef struct EventHeap {
    HeapEntry *entries;
    Py_ssize_t count, room;
    int64_t entered;
} EventHeap;

bool enter(EventHeap *self, int64_t when, PyObject *target, int mark);
HeapEntry take_first(EventHeap *self);
void forget_entries(EventHeap *self);
void free_heap(EventHeap *self);
int visit_entries(const EventHeap *self, visitproc visit, void *argument);

#endif
