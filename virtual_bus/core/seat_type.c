/* Python's DeviceSeat (native.pyi): a device's place on a segment in simulated time.

   Events are never taken back: one that comes too early, because the device has put its deadline off, is entered
   again. That is cheaper than to move an event at every frame. */
#include <stddef.h>

#include "device.h"
#include "types.h"

PyTypeObject *seat_type;

static SeatObject *seat_of(PyObject *self) { return (SeatObject *)self; }

/* One that does not fit into the port's queue, or meets a port that is off, is lost. */
static bool send(SeatObject *self, PyObject *frame)
{
    WireFrame wired;
    if (!read_frame(frame, &wired))
        return false;
    if (send_frame(self->port, &wired))
        return true;
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    if (!PyErr_GivenExceptionMatches(type, self->failure)) {
        PyErr_Restore(type, value, traceback);
        return false;
    }
    forget(&type), forget(&value), forget(&traceback);
    self->frames_lost++;
    return true;
}

static bool wake_by(SeatObject *self, int64_t due)
{
    if (due >= self->scheduled)
        return true;
    self->scheduled = due;
    return let_happen(self->port->segment->timeline, due, CALLBACK, self->wake);
}

/* What the device has to send; the frames are taken from it first, as sending may lead to it again. */
static bool send_all(SeatObject *self)
{
    DeviceObject *device = self->device;
    bool well = true;
    if (device->mute || device->out_count == 0)
        return true;
    PyObject **frames = device->out;
    int count = device->out_count, room = device->out_room;
    device->out = NULL;
    device->out_count = device->out_room = 0;
    for (int place = 0; place < count; place++) {
        well = well && send(self, frames[place]);
        Py_DecRef(frames[place]);
    }
    if (device->out == NULL) {
        device->out = frames;
        device->out_room = room;
    } else {
        PyMem_Free(frames);
    }
    return well;
}

/* A data frame that the device listens to, by `handlers`. */
bool hear_at_seat(SeatObject *self, PyObject *handlers, FrameObject *frame, int64_t now)
{
    bool well = true;
    if (!self->device->booting)
        well = hear_by_device(self->device, handlers, frame, now) && send_all(self);
    int64_t due = well ? due_of_device(self->device, &well) : never_ns;
    return well && wake_by(self, due);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 4, 4, "DeviceSeat"))
        return NULL;
    PyObject *device = PyTuple_GetItem(arguments, 0);
    if ((device != Py_None && !is_a(device, device_type, "a CyclicDevice, or None,"))
        || !is_a(PyTuple_GetItem(arguments, 1), port_type, "a Port"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    seat_of(self)->device = device == Py_None ? NULL : (DeviceObject *)another(device);
    seat_of(self)->port = (PortObject *)another(PyTuple_GetItem(arguments, 1));
    seat_of(self)->failure = another(PyTuple_GetItem(arguments, 2));
    seat_of(self)->wake = another(PyTuple_GetItem(arguments, 3));
    seat_of(self)->scheduled = never_ns;
    return self;
}

enum { HELD_COUNT = 4 };

static void places_of(SeatObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = (PyObject **)&self->device;
    places[1] = (PyObject **)&self->port;
    places[2] = &self->failure;
    places[3] = &self->wake;
}

static int visit_seat(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(seat_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* Device, port and the class of the error stay: they are counted on. */
static int clear_seat(PyObject *self)
{
    PyObject *before = seat_of(self)->wake;
    seat_of(self)->wake = nothing();
    forget(&before);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    places_of(seat_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

static PyObject *call_send(PyObject *self, PyObject *frame)
{
    return send(seat_of(self), frame) ? nothing() : NULL;
}

static PyObject *call_wake_by(PyObject *self, PyObject *due)
{
    int64_t due_ns;
    return integer(due, &due_ns) && wake_by(seat_of(self), due_ns) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"send", call_send, METH_O, NULL},
    {"wake_by", call_wake_by, METH_O, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"scheduled", T_LONGLONG, offsetof(SeatObject, scheduled), 0, NULL},
    {"frames_lost", T_LONGLONG, offsetof(SeatObject, frames_lost), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_seat},
    {Py_tp_clear, (void *)clear_seat},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec seat_spec = {
    .name = "servobench.virtual_bus.core.native.DeviceSeat",
    .basicsize = sizeof(SeatObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
