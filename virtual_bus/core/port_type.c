/* Python's Port (native.pyi). */
#include <stddef.h>

#include "objects.h"
#include "device.h"
#include "segment.h"
#include "types.h"

PyTypeObject *port_type;

static PortObject *port_of(PyObject *self) { return (PortObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    int64_t rank;
    if (!takes(PyTuple_Size(arguments), 4, "Port")
        || !is_a(PyTuple_GetItem(arguments, 0), segment_type, "a Segment")
        || !integer(PyTuple_GetItem(arguments, 1), &rank))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    PortObject *port = port_of(self);
    port->segment = (SegmentObject *)another(PyTuple_GetItem(arguments, 0));
    port->rank = rank;
    port->name = another(PyTuple_GetItem(arguments, 2));
    port->listener = another(PyTuple_GetItem(arguments, 3));
    port->room = TRANSMIT_QUEUE_MAX;
    return self;
}

static int visit_port(PyObject *self, visitproc visit, void *argument)
{
    PortObject *port = port_of(self);
    PyObject *held[] = {(PyObject *)self->type, (PyObject *)port->segment, port->name, port->listener,
                        port->on_sent, port->heard, (PyObject *)port->seat};
    for (size_t place = 0; place < sizeof held / sizeof *held; place++) {
        int result = visit_one(held[place], visit, argument);
        if (result)
            return result;
    }
    for (int place = 0; place < port->count; place++) {
        int result = visit(port->queue[(port->first + place) % TRANSMIT_QUEUE_MAX].object, argument);
        if (result)
            return result;
    }
    return 0;
}

static void forget_queue(PortObject *self)
{
    while (self->count > 0)
        Py_DecRef(take_head(self).object);
}

/* The queue is left to the segment, which may be about to send from it. */
static int clear_port(PyObject *self)
{
    forget(&port_of(self)->listener);
    forget(&port_of(self)->on_sent);
    forget(&port_of(self)->heard);
    forget((PyObject **)&port_of(self)->seat);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    PortObject *port = port_of(self);
    clear_port(self);
    forget_queue(port);
    forget(&port->name);
    PyObject *segment = (PyObject *)port->segment;
    forget(&segment);
    end_object(self);
}

static PyObject *call_send(PyObject *self, PyObject *object)
{
    WireFrame frame;
    return read_frame(object, &frame) && send_frame(port_of(self), &frame) ? nothing() : NULL;
}

/* Sets an error while the segment sends by itself: it counts on what is in the queue. */
static bool is_handled(PortObject *self, const char *name)
{
    bool handled = is_there(self->segment->handling);
    if (!handled)
        PyErr_Format(PyExc_ValueError, "%s: the segment's error handling is not in charge", name);
    return handled;
}

static PyObject *call_take_head(PyObject *self, PyObject *none)
{
    (void)none;
    PortObject *port = port_of(self);
    if (!is_handled(port, "take_head"))
        return NULL;
    return port->count ? take_head(port).object : nothing();
}

static PyObject *call_clear(PyObject *self, PyObject *none)
{
    (void)none;
    if (!is_handled(port_of(self), "clear"))
        return NULL;
    forget_queue(port_of(self));
    return nothing();
}

static PyObject *get_head(PyObject *self, void *none)
{
    (void)none;
    PortObject *port = port_of(self);
    return port->count ? another(head_of(port)->object) : nothing();
}

static PyObject *get_key(PyObject *self, void *none)
{
    (void)none;
    PortObject *port = port_of(self);
    return port->count ? PyLong_FromLongLong((long long)key_of(port)) : nothing();
}

static int set_room(PyObject *self, PyObject *value, void *none)
{
    (void)none;
    int64_t room;
    if (value == NULL || !integer(value, &room))
        return -1;
    if (room < 0 || room > TRANSMIT_QUEUE_MAX) {
        PyErr_Format(PyExc_ValueError, "room %lld: 0..%d expected", (long long)room, TRANSMIT_QUEUE_MAX);
        return -1;
    }
    port_of(self)->room = (int)room;
    return 0;
}

static PyObject *get_room(PyObject *self, void *none)
{
    (void)none;
    return PyLong_FromLongLong(port_of(self)->room);
}

static PyObject *call_hear_only(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    if (!takes(count, 2, "hear_only") || !is_a(arguments[0], &PyDict_Type, "a dictionary")
        || (arguments[1] != Py_None && !is_a(arguments[1], seat_type, "a DeviceSeat with a device, or None,")))
        return NULL;
    SeatObject *seat = arguments[1] == Py_None ? NULL : (SeatObject *)arguments[1];
    if (seat != NULL && seat->device == NULL)
        return PyErr_Format(PyExc_ValueError, "hear_only: a DeviceSeat with a device, or None, expected");
    PortObject *port = port_of(self);
    PyObject *before[] = {port->heard, (PyObject *)port->seat};
    port->heard = another(arguments[0]);
    port->seat = seat == NULL ? NULL : (SeatObject *)another(arguments[1]);
    forget(&before[0]);
    forget(&before[1]);
    return nothing();
}

static PyMethodDef methods[] = {
    {"send", call_send, METH_O, NULL},
    {"hear_only", (PyCFunction)(void (*)(void))call_hear_only, METH_FASTCALL, NULL},
    {"take_head", call_take_head, METH_NOARGS, NULL},
    {"clear", call_clear, METH_NOARGS, NULL},
    {0},
};

static PyGetSetDef attributes[] = {
    {"head", get_head, NULL, NULL, NULL},
    {"key", get_key, NULL, NULL, NULL},
    {"room", get_room, set_room, NULL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"name", T_OBJECT, offsetof(PortObject, name), READONLY, NULL},
    {"listener", T_OBJECT, offsetof(PortObject, listener), 0, NULL},
    {"on_sent", T_OBJECT, offsetof(PortObject, on_sent), 0, NULL},
    {"rank", T_LONGLONG, offsetof(PortObject, rank), READONLY, NULL},
    {"pending", T_INT, offsetof(PortObject, count), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_port},
    {Py_tp_clear, (void *)clear_port},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {Py_tp_members, members},
    {0},
};

PyType_Spec port_spec = {
    .name = "servobench.virtual_bus.core.native.Port",
    .basicsize = sizeof(PortObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
