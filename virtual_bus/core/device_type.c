/* Python's CyclicDevice (native.pyi). */
#include <stddef.h>

#include "device.h"
#include "types.h"

PyTypeObject *device_type;

enum { HELD_COUNT = 6 };

static DeviceObject *device_of(PyObject *self) { return (DeviceObject *)self; }

static void places_of(DeviceObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = &self->application;
    places[1] = &self->timers;
    places[2] = (PyObject **)&self->drive;
    places[3] = &self->transmit;
    places[4] = &self->receive;
    places[5] = &self->watching;
}

static void forget_frames(DeviceObject *self)
{
    while (self->out_count > 0)
        Py_DecRef(self->out[--self->out_count]);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 1, 1, "CyclicDevice"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    DeviceObject *device = device_of(self);
    device->application = another(PyTuple_GetItem(arguments, 0));
    device->timers = PyList_New(0);
    device->transmit = PyTuple_New(0);
    device->receive = PyTuple_New(0);
    device->watching = PyList_New(0);
    device->next_timer = device->look_at = never_ns;
    if (device->timers == NULL || device->transmit == NULL || device->receive == NULL || device->watching == NULL)
        forget(&self);
    return self;
}

static int visit_device(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(device_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    for (int place = 0; result == 0 && place < device_of(self)->out_count; place++)
        result = visit(device_of(self)->out[place], argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* Tuples and lists stay: they are counted on. What they hold lets go of Python's callables, which lead back. */
static int clear_device(PyObject *self)
{
    DeviceObject *device = device_of(self);
    PyObject *before = device->application;
    device->application = nothing();
    forget(&before);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    forget_frames(device_of(self));
    PyMem_Free(device_of(self)->out);
    places_of(device_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

/* The frames to send, as a list; an empty tuple for none, as while the device is mute. */
static PyObject *take_frames(DeviceObject *self)
{
    if (self->mute || self->out_count == 0)
        return PyTuple_New(0);
    PyObject *frames = PyList_New(0);
    for (int place = 0; frames != NULL && place < self->out_count; place++) {
        if (PyList_Append(frames, self->out[place]) < 0)
            forget(&frames);
    }
    if (frames != NULL)
        forget_frames(self);
    return frames;
}

static PyObject *call_hear(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t now;
    if (!takes(count, 3, "hear") || !is_a(arguments[0], &PyTuple_Type, "a tuple")
        || !is_a(arguments[1], frame_type, "a WireFrame") || !integer(arguments[2], &now))
        return NULL;
    if (device_of(self)->booting)
        return PyTuple_New(0);
    bool heard = hear_by_device(device_of(self), arguments[0], (FrameObject *)arguments[1], now);
    return heard ? take_frames(device_of(self)) : NULL;
}

static PyObject *call_wake(PyObject *self, PyObject *now)
{
    DeviceObject *device = device_of(self);
    int64_t now_ns;
    if (!integer(now, &now_ns) || !advance_application(device, now_ns)
        || !run_timers(device, now_ns)
        || (is_watching(device) && !look_for_changes(device)))
        return NULL;
    return take_frames(device);
}

static PyObject *call_advance(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    return integer(now, &now_ns) && advance_application(device_of(self), now_ns) ? nothing() : NULL;
}

static PyObject *call_take_frames(PyObject *self, PyObject *none)
{
    (void)none;
    return is_watching(device_of(self)) && !look_for_changes(device_of(self)) ? NULL : take_frames(device_of(self));
}

static PyObject *call_send(PyObject *self, PyObject *frame)
{
    return is_a(frame, frame_type, "a WireFrame") && queue_frame(device_of(self), frame) ? nothing() : NULL;
}

static PyObject *call_forget_frames(PyObject *self, PyObject *none)
{
    (void)none;
    forget_frames(device_of(self));
    return nothing();
}

/* A tuple of objects of one type; NULL with an error. */
static PyObject *all_of(PyObject *objects, PyTypeObject *type, const char *expected)
{
    PyObject *tuple = PySequence_Tuple(objects);
    for (Py_ssize_t place = 0; tuple != NULL && place < PyTuple_Size(tuple); place++) {
        if (!is_a(PyTuple_GetItem(tuple, place), type, expected))
            forget(&tuple);
    }
    return tuple;
}

static PyObject *call_carry(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    if (!takes(count, 2, "carry"))
        return NULL;
    PyObject *transmit = all_of(arguments[0], tpdo_type, "a CyclicTpdo");
    PyObject *receive = transmit == NULL ? NULL : all_of(arguments[1], rpdo_type, "a CyclicRpdo");
    if (receive == NULL) {
        forget(&transmit);
        return NULL;
    }
    PyObject *before[] = {device_of(self)->transmit, device_of(self)->receive};
    device_of(self)->transmit = transmit;
    device_of(self)->receive = receive;
    forget(&before[0]);
    forget(&before[1]);
    return nothing();
}

static PyObject *call_watch(PyObject *self, PyObject *tpdo)
{
    bool well = is_a(tpdo, tpdo_type, "a CyclicTpdo") && PyList_Append(device_of(self)->watching, tpdo) == 0;
    return well ? nothing() : NULL;
}

/* Nothing happens if it was not watching. */
static PyObject *call_unwatch(PyObject *self, PyObject *tpdo)
{
    PyObject *left = PyList_New(0), *before = device_of(self)->watching;
    bool well = left != NULL;
    for (Py_ssize_t place = 0; well && place < PyList_Size(before); place++) {
        PyObject *other = PyList_GetItem(before, place);
        well = other == tpdo || PyList_Append(left, other) == 0;
    }
    if (!well) {
        forget(&left);
        return NULL;
    }
    device_of(self)->watching = left;
    forget(&before);
    return nothing();
}

static PyObject *call_sync(PyObject *self, PyObject *counter)
{
    int64_t value;
    return integer(counter, &value) && sync_device(device_of(self), value) ? nothing() : NULL;
}

static PyObject *call_open_window(PyObject *self, PyObject *open)
{
    int is_open = PyObject_IsTrue(open);
    if (is_open < 0)
        return NULL;
    for (Py_ssize_t place = 0; place < PyTuple_Size(device_of(self)->receive); place++)
        ((RpdoObject *)PyTuple_GetItem(device_of(self)->receive, place))->window_open = is_open != 0;
    return nothing();
}

static PyObject *get_due_at(PyObject *self, void *none)
{
    (void)none;
    bool well;
    int64_t due = due_of_device(device_of(self), &well);
    return well ? PyLong_FromLongLong(due) : NULL;
}

static PyMethodDef methods[] = {
    {"hear", (PyCFunction)(void (*)(void))call_hear, METH_FASTCALL, NULL},
    {"wake", call_wake, METH_O, NULL},
    {"advance", call_advance, METH_O, NULL},
    {"take_frames", call_take_frames, METH_NOARGS, NULL},
    {"send", call_send, METH_O, NULL},
    {"forget_frames", call_forget_frames, METH_NOARGS, NULL},
    {"carry", (PyCFunction)(void (*)(void))call_carry, METH_FASTCALL, NULL},
    {"watch", call_watch, METH_O, NULL},
    {"unwatch", call_unwatch, METH_O, NULL},
    {"sync", call_sync, METH_O, NULL},
    {"open_window", call_open_window, METH_O, NULL},
    {0},
};

static PyObject *get_drive(PyObject *self, void *none)
{
    (void)none;
    PyObject *drive = (PyObject *)device_of(self)->drive;
    return drive == NULL ? nothing() : another(drive);
}

static int set_drive(PyObject *self, PyObject *drive, void *none)
{
    (void)none;
    bool none_given = drive == NULL || drive == Py_None;
    if (!none_given && !is_a(drive, drive_type, "a CyclicDrive, or None,"))
        return -1;
    PyObject *before = (PyObject *)device_of(self)->drive;
    device_of(self)->drive = none_given ? NULL : (DriveObject *)another(drive);
    forget(&before);
    return 0;
}

static PyGetSetDef attributes[] = {
    {"drive", get_drive, set_drive, NULL, NULL},
    {"due_at", get_due_at, NULL, NULL, NULL},
    {0},
};

#define PLACE(path) offsetof(DeviceObject, path)

static PyMemberDef members[] = {
    {"now", T_LONGLONG, PLACE(now), 0, NULL},
    {"booting", T_BOOL, PLACE(booting), 0, NULL},
    {"mute", T_BOOL, PLACE(mute), 0, NULL},
    {"operational", T_BOOL, PLACE(operational), 0, NULL},
    {"takes_syncs", T_BOOL, PLACE(takes_syncs), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_device},
    {Py_tp_clear, (void *)clear_device},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {Py_tp_members, members},
    {0},
};

PyType_Spec device_spec = {
    .name = "servobench.virtual_bus.core.native.CyclicDevice",
    .basicsize = sizeof(DeviceObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
