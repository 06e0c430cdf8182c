/* Python's Ring (native.pyi). */
#include <string.h>

#include "frame_row.h"
#include "objects.h"
#include "ring.h"
#include "types.h"

typedef struct RingObject {
    PyObject head;
    PyObject *on_full;
    Ring ring;
} RingObject;

PyTypeObject *ring_type;

static Ring *ring_of(PyObject *self) { return &((RingObject *)self)->ring; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    int64_t descriptor, row_bytes, capacity;
    if (!takes(PyTuple_Size(arguments), 4, "Ring") || !integer(PyTuple_GetItem(arguments, 0), &descriptor)
        || !integer(PyTuple_GetItem(arguments, 1), &row_bytes) || !integer(PyTuple_GetItem(arguments, 2), &capacity))
        return NULL;
    if (capacity <= 0 || capacity > CAPACITY_MAX || capacity & (capacity - 1))
        return PyErr_Format(PyExc_ValueError, "capacity %lld is no power of two up to %d", (long long)capacity,
                            CAPACITY_MAX);
    if (row_bytes <= 0 || row_bytes > ROW_BYTES_MAX || row_bytes % 4 || descriptor < 0 || descriptor > INT32_MAX)
        return PyErr_Format(PyExc_ValueError, "rows of %lld octets, descriptor %lld: whole words and a file expected",
                            (long long)row_bytes, (long long)descriptor);
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    ((RingObject *)self)->on_full = another(PyTuple_GetItem(arguments, 3));
    if (open_ring(ring_of(self), (int)descriptor, (uint64_t)row_bytes, (uint64_t)capacity))
        return self;
    PyErr_SetFromErrno(PyExc_OSError);
    Py_DecRef(self);
    return NULL;
}

static int visit_ring(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_one(((RingObject *)self)->on_full, visit, argument);
}

static int clear_ring(PyObject *self)
{
    forget(&((RingObject *)self)->on_full);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_ring(self);
    close_ring(ring_of(self));
    end_object(self);
}

/* Whether the ring is open; what waits for room may have closed it. */
static bool is_open(const Ring *self)
{
    if (self->memory == NULL)
        PyErr_Format(PyExc_ValueError, "the ring is closed");
    return self->memory != NULL;
}

/* 1: a row has room; 0: it is refused; -1: an error. `on_full` is asked while there is none. */
static int make_room(PyObject *self)
{
    Ring *ring = ring_of(self);
    while (is_open(ring)) {
        if (has_room(ring))
            return 1;
        PyObject *on_full = another(((RingObject *)self)->on_full);
        PyObject *answer = PyObject_Vectorcall(on_full, NULL, 0, NULL);
        Py_DecRef(on_full);
        int again = answer == NULL ? -1 : PyObject_IsTrue(answer);
        forget(&answer);
        if (again < 0)
            return -1;
        if (!again && is_open(ring)) {
            count_refused(ring);
            return 0;
        }
    }
    return -1;
}

static PyObject *call_push(PyObject *self, PyObject *row)
{
    Ring *ring = ring_of(self);
    char *octets;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(row, &octets, &length) < 0)
        return NULL;
    if ((uint64_t)length != ring->row_bytes)
        return PyErr_Format(PyExc_ValueError, "%zd octets: a row of %lld expected", length,
                            (long long)ring->row_bytes);
    int room = make_room(self);
    if (room < 0)
        return NULL;
    if (room) {
        memcpy(next_row(ring), octets, ring->row_bytes);
        publish_row(ring);
    }
    return PyBool_FromLong(room);
}

/* Arguments at, can_id, sent, data. */
static bool read_frame(PyObject *const *arguments, RawFrame *frame)
{
    int64_t can_id, sent;
    char *octets;
    Py_ssize_t length;
    if (!integer(arguments[0], &frame->at) || !integer(arguments[1], &can_id) || !integer(arguments[2], &sent)
        || PyBytes_AsStringAndSize(arguments[3], &octets, &length) < 0)
        return false;
    if (can_id < 0 || can_id > UINT32_MAX || sent < 0 || sent > UINT8_MAX || length > FRAME_DATA_MAX) {
        PyErr_Format(PyExc_ValueError, "identifier %lld, sent %lld, %zd octets: 32 bits, 8 bits, at most %d expected",
                     (long long)can_id, (long long)sent, length, FRAME_DATA_MAX);
        return false;
    }
    frame->can_id = (uint32_t)can_id;
    frame->sent = (uint8_t)sent;
    frame->length = (int)length;
    frame->data = octets;
    return true;
}

/* 1: stored, 0: refused, -1: an error. */
int push_raw_frame(PyObject *self, const RawFrame *frame)
{
    Ring *ring = ring_of(self);
    if (ring->row_bytes != FRAME_ROW_BYTES) {
        PyErr_Format(PyExc_ValueError, "rows of %lld octets: those of frames, of %d, expected",
                     (long long)ring->row_bytes, FRAME_ROW_BYTES);
        return -1;
    }
    int room = make_room(self);
    if (room > 0) {
        pack_frame(frame, next_row(ring));
        publish_row(ring);
    }
    return room;
}

PyObject *call_frame_row(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    RawFrame frame;
    unsigned char row[FRAME_ROW_BYTES];
    if (!takes(count, 4, "frame_row") || !read_frame(arguments, &frame))
        return NULL;
    pack_frame(&frame, row);
    return PyBytes_FromStringAndSize((const char *)row, FRAME_ROW_BYTES);
}

static PyObject *call_close(PyObject *self, PyObject *none)
{
    (void)none;
    close_ring(ring_of(self));
    return nothing();
}

static PyObject *get_counter(PyObject *self, int at)
{
    return is_open(ring_of(self)) ? PyLong_FromLongLong((long long)counter(ring_of(self), at)) : NULL;
}

static PyObject *get_refused(PyObject *self, void *closure)
{
    (void)closure;
    return get_counter(self, REFUSED_AT);
}

static PyObject *get_taken(PyObject *self, void *closure)
{
    (void)closure;
    return get_counter(self, READ_AT);
}

static PyMethodDef methods[] = {
    {"push", call_push, METH_O, NULL},
    {"close", call_close, METH_NOARGS, NULL},
    {0},
};

static PyGetSetDef getset[] = {
    {"refused", get_refused, NULL, NULL, NULL},
    {"taken", get_taken, NULL, NULL, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_ring},
    {Py_tp_clear, (void *)clear_ring},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_getset, getset},
    {0},
};

PyType_Spec ring_spec = {
    .name = "servobench.hil.core.native.Ring",
    .basicsize = sizeof(RingObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
