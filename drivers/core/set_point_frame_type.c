/* Python's SetPointFrame (native.pyi). */
#include "set_point_frame.h"

#include <assert.h>
#include <string.h>

#include "types.h"

PyTypeObject *set_point_frame_type;

static SetPointFrameObject *frame_of(PyObject *self) { return (SetPointFrameObject *)self; }

/* How many octets, and the kind of the value in them. */
static bool add_field(SetPointFrameObject *self, PyObject *pair)
{
    int64_t octets, kind;
    if (!is_a(pair, &PyTuple_Type, "a tuple") || !takes(PyTuple_Size(pair), 2, "a field")
        || !integer(PyTuple_GetItem(pair, 0), &octets) || !integer(PyTuple_GetItem(pair, 1), &kind))
        return false;
    bool known = UNSIGNED_VALUE <= kind && kind <= OCTETS_VALUE && (kind != REAL_VALUE || octets == 4 || octets == 8);
    if (!known || octets < 1 || octets > RPDO_OCTETS_MAX - self->octets) {
        PyErr_Format(PyExc_ValueError, "%lld octets of kind %lld behind %d: at most %d in all expected",
                     (long long)octets, (long long)kind, self->octets, RPDO_OCTETS_MAX);
        return false;
    }
    assert(self->count < RPDO_OCTETS_MAX);
    self->fields[self->count++] = (ValueField){self->octets, (int)octets, (ValueKind)kind};
    self->octets += (int)octets;
    return true;
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t can_id;
    if (!takes_between(arguments, names, 3, 3, "SetPointFrame")
        || !is_a(PyTuple_GetItem(arguments, 0), link_type, "a Link")
        || !integer(PyTuple_GetItem(arguments, 1), &can_id)
        || !is_a(PyTuple_GetItem(arguments, 2), &PyTuple_Type, "a tuple"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0), *fields = PyTuple_GetItem(arguments, 2);
    if (self == NULL)
        return NULL;
    frame_of(self)->link = (LinkObject *)another(PyTuple_GetItem(arguments, 0));
    frame_of(self)->can_id = can_id;
    begin_awaiting(&frame_of(self)->awaited);
    for (Py_ssize_t place = 0; place < PyTuple_Size(fields); place++) {
        if (!add_field(frame_of(self), PyTuple_GetItem(fields, place))) {
            Py_DecRef(self);
            return NULL;
        }
    }
    return self;
}

static int visit_frame(PyObject *self, visitproc visit, void *argument)
{
    int result = visit_one((PyObject *)self->type, visit, argument);
    if (result == 0)
        result = visit_one((PyObject *)frame_of(self)->link, visit, argument);
    return result ? result : visit_awaited(&frame_of(self)->awaited, visit, argument);
}

static int clear_frame(PyObject *self)
{
    end_awaiting(&frame_of(self)->awaited);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    PyObject *link = (PyObject *)frame_of(self)->link;
    end_awaiting(&frame_of(self)->awaited);
    forget(&frame_of(self)->sent_data);
    forget(&link);
    end_object(self);
}

static void write_octets(SetPointFrameObject *self, const ValueField *field, const void *octets, size_t length)
{
    size_t room = (size_t)field->octets;
    memset(&self->image[field->place], 0, room);
    memcpy(&self->image[field->place], octets, length < room ? length : room);
}

static bool put_whole(SetPointFrameObject *self, const ValueField *field, PyObject *value)
{
    int bits = 8 * field->octets;
    uint64_t raw;
    int64_t told;
    if (field->kind == UNSIGNED_VALUE && bits == 64) {
        raw = PyLong_AsUnsignedLongLong(value);
        if (raw == UINT64_MAX && PyErr_Occurred())
            return false;
    } else {
        if (!integer(value, &told))
            return false;
        raw = (uint64_t)told;
        uint64_t sign = (uint64_t)1 << (bits - 1);
        bool fits = field->kind == UNSIGNED_VALUE ? told >= 0 && raw >> (bits - 1) <= 1 : raw + sign <= 2 * sign - 1;
        if (bits < 64 && !fits) {
            PyErr_Format(PyExc_ValueError, "a value that %d bits do not hold: %lld", bits, (long long)told);
            return false;
        }
    }
    unsigned char octets[RPDO_OCTETS_MAX];
    for (int octet = 0; octet < RPDO_OCTETS_MAX; octet++)
        octets[octet] = (unsigned char)(raw >> 8 * octet);
    write_octets(self, field, octets, sizeof octets);
    return true;
}

static bool put_value(SetPointFrameObject *self, const ValueField *field, PyObject *value)
{
    double real;
    char *octets;
    Py_ssize_t length;
    switch (field->kind) {
    case OCTETS_VALUE:
        if (PyBytes_AsStringAndSize(value, &octets, &length) < 0)
            return false;
        write_octets(self, field, octets, (size_t)length);
        return true;
    case REAL_VALUE:
        if (!number(value, &real))
            return false;
        float narrow = (float)real;
        write_octets(self, field, field->octets == 4 ? (void *)&narrow : (void *)&real, (size_t)field->octets);
        return true;
    case UNSIGNED_VALUE:
    case SIGNED_VALUE:
        break;
    }
    return put_whole(self, field, value);
}

static PyObject *call_hold(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t place;
    if (!takes(count, 2, "hold") || !integer(arguments[0], &place))
        return NULL;
    if (place < 0 || place >= frame_of(self)->count)
        return PyErr_Format(PyExc_ValueError, "field %lld of %d", (long long)place, frame_of(self)->count);
    return put_value(frame_of(self), &frame_of(self)->fields[place], arguments[1]) ? nothing() : NULL;
}

static PyObject *call_send(PyObject *self, PyObject *none)
{
    (void)none;
    SetPointFrameObject *frame = frame_of(self);
    if (frame->link->port == NULL)
        return PyErr_Format(PyExc_ValueError, "the link has no port yet");
    PyObject *data = PyBytes_FromStringAndSize((const char *)frame->image, frame->octets);
    FrameObject *made = data == NULL ? NULL : make_frame(frame_type, frame->can_id, data);
    PyObject *at = made == NULL ? NULL : hand_over(frame->link, made);
    int64_t handed_at = 0;
    if (at != NULL && integer(at, &handed_at)) {
        PyObject *before = frame->sent_data;
        frame->sent_data = another(data);
        frame->sent_at = handed_at;
        forget(&before);
    }
    forget(&data);
    if (made != NULL)
        Py_DecRef((PyObject *)made);
    return at;
}

static PyObject *call_await_echo(PyObject *self, PyObject *command)
{
    SetPointFrameObject *frame = frame_of(self);
    if (frame->sent_data == NULL)
        return PyErr_Format(PyExc_ValueError, "nothing was sent");
    await_echo(&frame->awaited, frame->sent_data, command, frame->sent_at);
    return nothing();
}

static PyObject *call_given_up(PyObject *self, PyObject *handed_at)
{
    int64_t instant;
    return integer(handed_at, &instant) && give_up(&frame_of(self)->awaited, instant) ? nothing() : NULL;
}

static PyObject *call_echoed(PyObject *self, PyObject *arguments, PyObject *names)
{
    int64_t at, handed_at;
    if (!takes_between(arguments, names, 3, 3, "SetPointFrame")
        || !is_a(PyTuple_GetItem(arguments, 0), &PyBytes_Type, "octets")
        || !integer(PyTuple_GetItem(arguments, 1), &at) || !integer(PyTuple_GetItem(arguments, 2), &handed_at))
        return NULL;
    return take_echo(&frame_of(self)->awaited, PyTuple_GetItem(arguments, 0), at, handed_at) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"hold", (PyCFunction)(void (*)(void))call_hold, METH_FASTCALL, NULL},
    {"send", call_send, METH_NOARGS, NULL},
    {"await_echo", call_await_echo, METH_O, NULL},
    {"given_up", call_given_up, METH_O, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_frame},
    {Py_tp_clear, (void *)clear_frame},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_call, (void *)call_echoed},
    {Py_tp_methods, methods},
    {0},
};

PyType_Spec set_point_frame_spec = {
    .name = "servobench.drivers.core.native.SetPointFrame",
    .basicsize = sizeof(SetPointFrameObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
