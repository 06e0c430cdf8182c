/* Python's Timer (native.pyi): one deadline of a device. A device has a handful: the next one is found by looking at
   each. */
#include <stddef.h>

#include "device.h"
#include "types.h"

PyTypeObject *timer_type;

enum { HELD_COUNT = 2 };

static TimerObject *timer_of(PyObject *self) { return (TimerObject *)self; }

static void places_of(TimerObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = (PyObject **)&self->device;
    places[1] = &self->callback;
}

static TimerObject *timer_at(const DeviceObject *self, Py_ssize_t place)
{
    return (TimerObject *)PyList_GetItem(self->timers, place);
}

/* The earliest, the first of several; NULL for a device without timers. */
static TimerObject *earliest(const DeviceObject *self)
{
    TimerObject *first = NULL;
    for (Py_ssize_t place = 0; place < PyList_Size(self->timers); place++) {
        TimerObject *timer = timer_at(self, place);
        if (first == NULL || timer->due < first->due)
            first = timer;
    }
    return first;
}

static void find_next(DeviceObject *self)
{
    const TimerObject *first = earliest(self);
    self->next_timer = first == NULL ? never_ns : first->due;
}

void start_timer(TimerObject *self, int64_t due)
{
    DeviceObject *device = self->device;
    bool was_next = self->due == device->next_timer;
    self->due = due;
    if (due < device->next_timer)
        device->next_timer = due;
    else if (was_next)
        find_next(device);
}

/* Run what is due, the earliest first; a callback may restart its timer only after `now`. */
bool run_timers(DeviceObject *self, int64_t now)
{
    while (self->next_timer <= now) {
        TimerObject *timer = earliest(self);
        if (timer == NULL)
            break;
        start_timer(timer, never_ns);
        PyObject *callback = another(timer->callback);
        bool well = call_with_instant(callback, now);
        Py_DecRef(callback);
        if (!well)
            return false;
    }
    return true;
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 2, 2, "Timer")
        || !is_a(PyTuple_GetItem(arguments, 0), device_type, "a CyclicDevice"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    timer_of(self)->device = (DeviceObject *)another(PyTuple_GetItem(arguments, 0));
    timer_of(self)->callback = another(PyTuple_GetItem(arguments, 1));
    timer_of(self)->due = never_ns;
    if (PyList_Append(timer_of(self)->device->timers, self) < 0)
        forget(&self);
    return self;
}

static int visit_timer(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(timer_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* The device stays: it is counted on. */
static int clear_timer(PyObject *self)
{
    PyObject *before = timer_of(self)->callback;
    timer_of(self)->callback = nothing();
    forget(&before);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    places_of(timer_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

static PyObject *call_start(PyObject *self, PyObject *due)
{
    int64_t due_ns;
    if (!integer(due, &due_ns))
        return NULL;
    start_timer(timer_of(self), due_ns);
    return nothing();
}

static PyObject *call_stop(PyObject *self, PyObject *none)
{
    (void)none;
    if (timer_of(self)->due != never_ns)
        start_timer(timer_of(self), never_ns);
    return nothing();
}

static PyMethodDef methods[] = {
    {"start", call_start, METH_O, NULL},
    {"stop", call_stop, METH_NOARGS, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"due", T_LONGLONG, offsetof(TimerObject, due), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_timer},
    {Py_tp_clear, (void *)clear_timer},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec timer_spec = {
    .name = "servobench.virtual_bus.core.native.Timer",
    .basicsize = sizeof(TimerObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
