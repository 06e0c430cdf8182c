/* A frame of Python's as it is on the wire. */
#include <string.h>

#include "objects.h"
#include "segment.h"

/* The arbitration field as a number: the smaller one wins, as a dominant bit is a 0.

   Bits in their order on the wire (ISO 11898-1; Bosch CAN 2.0 part B, 3.2.1): 11 bits of base identifier, RTR
   (standard) or SRR (extended, recessive), IDE, then 18 bits of identifier extension and RTR. Hence standard before
   extended of the same base, and data before remote of the same identifier. */
static uint64_t arbitration_field(uint64_t can_id, bool extended, bool remote)
{
    if (extended)
        return can_id >> 18 << 21 | 3 << 19 | (can_id & 0x3FFFF) << 1 | remote;
    return can_id << 21 | (uint64_t)remote << 20;
}

enum { WIRE_ID, DATA, REMOTE_LENGTH, ATTRIBUTES };

static PyObject *attribute(PyObject *object, int which)
{
    static const char *const spelt[ATTRIBUTES] = {"wire_id", "data", "remote_length"};
    static PyObject *names[ATTRIBUTES];
    if (names[which] == NULL && (names[which] = PyUnicode_InternFromString(spelt[which])) == NULL)
        return NULL;
    return PyObject_GetAttr(object, names[which]);
}

static bool read_integer(PyObject *object, int which, int64_t *value)
{
    PyObject *read = attribute(object, which);
    bool well = read != NULL && integer(read, value);
    if (read != NULL)
        Py_DecRef(read);
    return well;
}

static bool read_data(PyObject *object, WireFrame *frame)
{
    PyObject *data = attribute(object, DATA);
    char *octets;
    Py_ssize_t length;
    if (data == NULL)
        return false;
    bool well = PyBytes_AsStringAndSize(data, &octets, &length) == 0;
    if (well && length > DATA_MAX) {
        PyErr_Format(PyExc_ValueError, "%zd octets in a frame: at most %d expected", length, DATA_MAX);
        well = false;
    }
    if (well) {
        frame->length = (int)length;
        memcpy(frame->data, octets, (size_t)length);
    }
    Py_DecRef(data);
    return well;
}

/* `frame` borrows the reference to `object`. */
bool read_frame(PyObject *object, WireFrame *frame)
{
    int64_t wire_id, dlc;
    frame->object = object;
    if (!read_integer(object, WIRE_ID, &wire_id) || !read_data(object, frame))
        return false;
    int64_t can_id = wire_id < 0 ? -1 : wire_id >> 2;
    frame->remote = wire_id & 2;
    frame->extended = wire_id & 1;
    if (!frame->remote)
        dlc = frame->length;
    else if (!read_integer(object, REMOTE_LENGTH, &dlc))
        return false;
    if (can_id < 0 || can_id >= 1 << 29 || dlc < 0 || dlc > 15) {
        PyErr_Format(PyExc_ValueError, "identifier %lld, DLC %lld: 29 and 4 bits expected", (long long)can_id,
                     (long long)dlc);
        return false;
    }
    frame->can_id = (uint32_t)can_id;
    frame->field = arbitration_field((uint64_t)can_id, frame->extended, frame->remote) << 4 | (uint64_t)dlc;
    return true;
}
