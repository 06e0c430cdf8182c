/* Python's SyncTaker (native.pyi): what a SYNC is checked for, and what it sets off (CiA 301, 7.2.5). */
#include <stddef.h>

#include "device.h"
#include "types.h"

PyTypeObject *sync_type;

enum { HELD_COUNT = 5 };

static SyncObject *sync_of(PyObject *self) { return (SyncObject *)self; }

static void places_of(SyncObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = (PyObject **)&self->device;
    places[1] = (PyObject **)&self->clock;
    places[2] = &self->judge_length;
    places[3] = &self->open_window;
    places[4] = &self->hold;
}

static bool call_with_two(PyObject *callable, int64_t first, int64_t second)
{
    PyObject *arguments[] = {PyLong_FromLongLong(first), PyLong_FromLongLong(second)};
    bool well = arguments[0] != NULL && arguments[1] != NULL
                && went_well(PyObject_Vectorcall(callable, arguments, 2, NULL));
    forget(&arguments[0]);
    forget(&arguments[1]);
    return well;
}

bool take_sync(SyncObject *self, const FrameObject *frame, int64_t now)
{
    char *octets;
    Py_ssize_t length;
    if (!self->device->takes_syncs)
        return true;
    if (PyBytes_AsStringAndSize(frame->data, &octets, &length) < 0)
        return false;
    if (length != self->length || self->wrong_length) {
        if (!call_with_instant(self->judge_length, length))
            return false;
        if (self->length && self->wrong_length)
            return true;
    }
    int64_t counter = self->length && length > 0 ? (unsigned char)octets[0] : 0;
    if (is_there(self->open_window)) {
        PyObject *open = another(self->open_window); /* it may put another one in its place */
        bool well = call_with_instant(open, now);
        Py_DecRef(open);
        if (!well)
            return false;
    }
    self->clock->sync_at = now;
    return is_there(self->hold) ? call_with_two(self->hold, counter, now) : sync_device(self->device, counter);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 4, 4, "SyncTaker")
        || !is_a(PyTuple_GetItem(arguments, 0), device_type, "a CyclicDevice")
        || !is_a(PyTuple_GetItem(arguments, 1), device_clock_type, "a DeviceClock"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    sync_of(self)->device = (DeviceObject *)another(PyTuple_GetItem(arguments, 0));
    sync_of(self)->clock = (DeviceClockObject *)another(PyTuple_GetItem(arguments, 1));
    sync_of(self)->judge_length = another(PyTuple_GetItem(arguments, 2));
    sync_of(self)->hold = another(PyTuple_GetItem(arguments, 3));
    sync_of(self)->open_window = nothing();
    return self;
}

static int visit_sync(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(sync_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* Device and clock stay: they are counted on. */
static int clear_sync(PyObject *self)
{
    PyObject *before[] = {sync_of(self)->judge_length, sync_of(self)->open_window, sync_of(self)->hold};
    sync_of(self)->judge_length = nothing();
    sync_of(self)->open_window = nothing();
    sync_of(self)->hold = nothing();
    for (size_t which = 0; which < sizeof before / sizeof *before; which++)
        forget(&before[which]);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    places_of(sync_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

static PyObject *get_window(PyObject *self, void *none)
{
    (void)none;
    return another(sync_of(self)->open_window);
}

static int set_window(PyObject *self, PyObject *callable, void *none)
{
    (void)none;
    PyObject *before = sync_of(self)->open_window;
    sync_of(self)->open_window = callable == NULL ? nothing() : another(callable);
    forget(&before);
    return 0;
}

static PyGetSetDef attributes[] = {
    {"open_window", get_window, set_window, NULL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"length", T_INT, offsetof(SyncObject, length), 0, NULL},
    {"wrong_length", T_BOOL, offsetof(SyncObject, wrong_length), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_sync},
    {Py_tp_clear, (void *)clear_sync},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_getset, attributes},
    {Py_tp_members, members},
    {0},
};

PyType_Spec sync_spec = {
    .name = "servobench.virtual_bus.core.native.SyncTaker",
    .basicsize = sizeof(SyncObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
