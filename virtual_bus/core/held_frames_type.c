/* Python's HeldFrames (native.pyi): the one place where frames wait for their release. */
#include <stddef.h>

#include "host_place.h"
#include "objects.h"
#include "types.h"

PyTypeObject *held_type;

static const int64_t NEVER = ((int64_t)1 << 62) - 1; /* servobench.drivers.timebase */

static HeldObject *held_of(PyObject *self) { return (HeldObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    return takes(PyTuple_Size(arguments), 0, "HeldFrames") ? PyType_GenericAlloc(type, 0) : NULL;
}

static int visit_held(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_entries(&held_of(self)->heap, visit, argument);
}

static int clear_held(PyObject *self)
{
    forget_entries(&held_of(self)->heap);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    free_heap(&held_of(self)->heap);
    end_object(self);
}

static PyObject *call_hold(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t release, mark = 0;
    bool kept;
    if (!takes(count == 2 ? 3 : count, 3, "hold") || !integer(arguments[1], &release)
        || (count == 3 && !integer(arguments[2], &mark)))
        return NULL;
    if (mark < 0 || mark > INT32_MAX) {
        PyErr_Format(PyExc_ValueError, "mark %lld: 31 bits expected", (long long)mark);
        return NULL;
    }
    return hold_frame(held_of(self), arguments[0], release, (int)mark, &kept) ? PyBool_FromLong(kept) : NULL;
}

static PyObject *call_next_at(PyObject *self, PyObject *none)
{
    (void)none;
    const EventHeap *heap = &held_of(self)->heap;
    return PyLong_FromLongLong(heap->count ? heap->entries[0].when : NEVER);
}

static PyObject *call_take(PyObject *self, PyObject *instant)
{
    EventHeap *heap = &held_of(self)->heap;
    int64_t now;
    if (!integer(instant, &now))
        return NULL;
    if (heap->count == 0 || heap->entries[0].when > now)
        return nothing();
    HeapEntry entry = take_first(heap);
    PyObject *items[] = {PyLong_FromLongLong(entry.when), PyLong_FromLongLong(entry.order), entry.target,
                         PyLong_FromLongLong(entry.mark)};
    PyObject *made = PyTuple_New(4);
    for (int place = 0; place < 4; place++) {
        if (made != NULL && items[place] != NULL)
            PyTuple_SetItem(made, place, items[place]);
        else
            forget(&items[place]);
    }
    return made;
}

static PyObject *call_clear(PyObject *self, PyObject *none)
{
    (void)none;
    clear_held(self);
    return nothing();
}

static Py_ssize_t length(PyObject *self) { return held_of(self)->heap.count; }

static PyMethodDef methods[] = {
    {"hold", (PyCFunction)(void (*)(void))call_hold, METH_FASTCALL, NULL},
    {"next_at", call_next_at, METH_NOARGS, NULL},
    {"take", call_take, METH_O, NULL},
    {"clear", call_clear, METH_NOARGS, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"overflow", T_LONGLONG, offsetof(HeldObject, overflow), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_held},
    {Py_tp_clear, (void *)clear_held},
    {Py_tp_dealloc, (void *)discard},
    {Py_sq_length, (void *)length},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec held_spec = {
    .name = "servobench.virtual_bus.core.native.HeldFrames",
    .basicsize = sizeof(HeldObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
