/* A frame, and what C of one room offers C of another: a port to receive from and transmit on, a sink that sees frames.

   An object offers such a way by its attribute `way`, a capsule of one of these names; its functions are given the
   object itself. */
#ifndef CORE_FRAMES_H
#define CORE_FRAMES_H

#include <stdbool.h>

#include "objects.h"

#define PORT_WAY "servobench port"
#define SINK_WAY "servobench sink"

/* servobench.drivers.core.native.WireFrame, which native.pyi documents. */
typedef struct FrameObject {
    PyObject head;
    PyObject *data; /* octets */
    int64_t can_id, remote_length, handed_at;
    bool extended, remote;
} FrameObject;

typedef struct Arrived {
    FrameObject *frame; /* the reference is the receiver's */
    int64_t at;
    bool own;
} Arrived;

/* Frame, instant, whether it is an own one; the reference to the frame goes into it. */
static inline PyObject *received_tuple(const Arrived *arrived)
{
    PyObject *received = PyTuple_New(3), *at = PyLong_FromLongLong(arrived->at);
    if (received == NULL || at == NULL) {
        Py_DecRef((PyObject *)arrived->frame);
        forget(&received);
        forget(&at);
        return NULL;
    }
    PyTuple_SetItem(received, 0, (PyObject *)arrived->frame);
    PyTuple_SetItem(received, 1, at);
    PyTuple_SetItem(received, 2, PyBool_FromLong(arrived->own));
    return received;
}

typedef struct PortWay {
    /* 1: a frame came by `until`, 0: none, -1: an error. Lets time pass. */
    int (*receive)(PyObject *self, int64_t until, Arrived *arrived);
    bool (*transmit)(PyObject *self, FrameObject *frame);
} PortWay;

typedef struct SinkWay {
    bool (*take)(PyObject *self, const FrameObject *frame, bool sent, int64_t at);
} SinkWay;

enum { UNTOLD = -1 };

/* `data`: octets, or NULL for none. */
static inline FrameObject *make_frame(PyTypeObject *frame_type, int64_t can_id, PyObject *data)
{
    FrameObject *frame = (FrameObject *)PyType_GenericAlloc(frame_type, 0);
    if (frame == NULL)
        return NULL;
    frame->can_id = can_id;
    frame->handed_at = UNTOLD;
    frame->data = data == NULL ? PyBytes_FromStringAndSize(NULL, 0) : another(data);
    if (frame->data != NULL)
        return frame;
    Py_DecRef((PyObject *)frame);
    return NULL;
}

/* A data frame that was kept: a row of the octets in which one room gives another its frames. */
enum { FRAME_OCTETS_MAX = 8 };
typedef struct KeptFrame {
    int64_t at;
    unsigned char data[FRAME_OCTETS_MAX]; /* 0 beyond the length */
    int64_t length;
} KeptFrame;

/* An identifier as Python's integer; those of 11 bits are made once. The reference is the caller's. */
static inline PyObject *identifier(int64_t can_id)
{
    enum { COUNT = 0x800 };
    static PyObject *made[COUNT];
    if (can_id < 0 || can_id >= COUNT)
        return PyLong_FromLongLong(can_id);
    if (made[can_id] == NULL && (made[can_id] = PyLong_FromLongLong(can_id)) == NULL)
        return NULL;
    return another(made[can_id]);
}

/* Arguments table, identifier, entry: entered by the identifier's one object, which a dictionary finds without a
   comparison of numbers, in a third of the time. */
static inline PyObject *call_enter(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t can_id;
    (void)module;
    if (!takes(count, 3, "enter") || !is_a(arguments[0], &PyDict_Type, "a dictionary")
        || !integer(arguments[1], &can_id))
        return NULL;
    PyObject *key = identifier(can_id);
    bool well = key != NULL && PyDict_SetItem(arguments[0], key, arguments[2]) == 0;
    forget(&key);
    return well ? nothing() : NULL;
}

/* The frame's type, with a reference as long as the process is there; NULL for an error. */
static inline PyTypeObject *find_frame_type(void)
{
    PyObject *drivers = PyImport_ImportModule("servobench.drivers.core.native");
    PyObject *type = drivers == NULL ? NULL : PyObject_GetAttrString(drivers, "WireFrame");
    forget(&drivers);
    return (PyTypeObject *)type;
}

#endif
