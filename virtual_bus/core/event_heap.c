/* The heap of a timeline's events, and of the frames that faults hold. */
#include "event_heap.h"

#include <assert.h>

static bool is_before(const HeapEntry *one, const HeapEntry *other)
{
    return one->when < other->when || (one->when == other->when && one->order < other->order);
}

/* False, with MemoryError set, if there is no memory. */
bool enter(EventHeap *self, int64_t when, PyObject *target, int mark)
{
    if (self->count == self->room) {
        Py_ssize_t room = self->room ? 2 * self->room : 16;
        HeapEntry *entries = PyMem_Realloc(self->entries, (size_t)room * sizeof *entries);
        if (entries == NULL) {
            PyErr_NoMemory();
            return false;
        }
        self->entries = entries;
        self->room = room;
    }
    Py_IncRef(target);
    HeapEntry entry = {when, ++self->entered, target, mark};
    Py_ssize_t place = self->count++;
    while (place > 0) {
        Py_ssize_t parent = (place - 1) / 2;
        if (self->entries[parent].when <= when)
            break;
        self->entries[place] = self->entries[parent];
        place = parent;
    }
    assert(0 <= place && place < self->count);
    self->entries[place] = entry;
    return true;
}

/* The first of a heap that holds one; its reference is the caller's from now on. */
HeapEntry take_first(EventHeap *self)
{
    assert(self->count > 0);
    HeapEntry first = self->entries[0], last = self->entries[--self->count];
    Py_ssize_t place = 0;
    for (Py_ssize_t child = 1; child < self->count; child = 2 * place + 1) {
        if (child + 1 < self->count && is_before(&self->entries[child + 1], &self->entries[child]))
            child++;
        if (is_before(&last, &self->entries[child]))
            break;
        self->entries[place] = self->entries[child];
        place = child;
    }
    self->entries[place] = last;
    return first;
}

/* Their references go one by one: what ends with one of them may look at the heap. */
void forget_entries(EventHeap *self)
{
    while (self->count > 0)
        Py_DecRef(take_first(self).target);
}

void free_heap(EventHeap *self)
{
    forget_entries(self);
    PyMem_Free(self->entries);
    self->entries = NULL;
    self->room = 0;
}

int visit_entries(const EventHeap *self, visitproc visit, void *argument)
{
    for (Py_ssize_t place = 0; place < self->count; place++) {
        int result = visit(self->entries[place].target, argument);
        if (result)
            return result;
    }
    return 0;
}
