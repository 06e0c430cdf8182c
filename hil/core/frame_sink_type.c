/* Python's FrameSink (native.pyi). */
#include "frames.h"
#include "types.h"

enum { EXTENDED_FLAG = 0x80000000, REMOTE_FLAG = 0x40000000 }; /* servobench.drivers.wire.frame_port */

typedef struct SinkObject {
    PyObject head;
    PyObject *ring;                /* NULL: nothing is kept */
    uint8_t received_as, sent_as; /* a row's number of segment and direction */
} SinkObject;

static SinkObject *sink_of(PyObject *self) { return (SinkObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t segment;
    if (!takes_between(arguments, names, 2, 2, "FrameSink") || !integer(PyTuple_GetItem(arguments, 1), &segment))
        return NULL;
    PyObject *ring = PyTuple_GetItem(arguments, 0);
    if (segment < 0 || 2 * segment + 1 > UINT8_MAX)
        return PyErr_Format(PyExc_ValueError, "segment %lld: a row tells 128 of them apart", (long long)segment);
    if (ring != Py_None && !is_a(ring, ring_type, "a Ring"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    sink_of(self)->ring = ring == Py_None ? NULL : another(ring);
    sink_of(self)->received_as = (uint8_t)(2 * segment);
    sink_of(self)->sent_as = (uint8_t)(2 * segment + 1);
    return self;
}

static int visit_sink(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_one(sink_of(self)->ring, visit, argument);
}

static int clear_sink(PyObject *self)
{
    forget(&sink_of(self)->ring);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_sink(self);
    end_object(self);
}

static bool take(PyObject *self, const FrameObject *frame, bool sent, int64_t at)
{
    char *octets;
    Py_ssize_t length;
    const SinkObject *sink = sink_of(self);
    if (sink->ring == NULL)
        return true;
    if (PyBytes_AsStringAndSize(frame->data, &octets, &length) < 0)
        return false;
    if (frame->can_id < 0 || frame->can_id > UINT32_MAX || length > FRAME_DATA_MAX) {
        PyErr_Format(PyExc_ValueError, "identifier %lld, %zd octets: 32 bits, at most %d expected",
                     (long long)frame->can_id, length, FRAME_DATA_MAX);
        return false;
    }
    uint32_t flags = (frame->extended ? EXTENDED_FLAG : 0) | (frame->remote ? REMOTE_FLAG : 0);
    RawFrame raw = {at, (uint32_t)frame->can_id | flags, sent ? sink->sent_as : sink->received_as, (int)length, octets};
    PyObject *ring = another(sink->ring); /* what waits for room may forget it */
    int stored = push_raw_frame(ring, &raw);
    Py_DecRef(ring);
    return stored >= 0;
}

static const SinkWay way = {take};

static PyObject *get_way(PyObject *self, void *none)
{
    (void)self, (void)none;
    return PyCapsule_New((void *)&way, SINK_WAY, NULL);
}

static PyObject *call_show(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t at;
    if (!takes(count, 3, "show") || !is_a(arguments[0], frame_type, "a WireFrame") || !integer(arguments[2], &at))
        return NULL;
    int sent = PyObject_IsTrue(arguments[1]);
    return sent >= 0 && take(self, (const FrameObject *)arguments[0], sent != 0, at) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"show", (PyCFunction)(void (*)(void))call_show, METH_FASTCALL, NULL},
    {0},
};

static PyGetSetDef attributes[] = {
    {"way", get_way, NULL, NULL, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_sink},
    {Py_tp_clear, (void *)clear_sink},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {0},
};

PyType_Spec sink_spec = {
    .name = "servobench.hil.core.native.FrameSink",
    .basicsize = sizeof(SinkObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
