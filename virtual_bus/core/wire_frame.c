/* A frame of Python's as it is on the wire. */
#include <string.h>

#include "attributes.h"
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

static bool read_integer(PyObject *object, Attribute *which, int64_t *value)
{
    PyObject *read = attribute(which, object);
    bool well = read != NULL && integer(read, value);
    forget(&read);
    return well;
}

static bool read_data(PyObject *object, WireFrame *frame)
{
    static Attribute name = {.spelt = "data"};
    PyObject *data = attribute(&name, object);
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
    static Attribute wire_id_name = {.spelt = "wire_id"}, length_name = {.spelt = "remote_length"};
    int64_t wire_id, dlc;
    frame->object = object;
    if (!read_integer(object, &wire_id_name, &wire_id) || !read_data(object, frame))
        return false;
    int64_t can_id = wire_id < 0 ? -1 : wire_id >> 2;
    frame->remote = wire_id & 2;
    frame->extended = wire_id & 1;
    if (!frame->remote)
        dlc = frame->length;
    else if (!read_integer(object, &length_name, &dlc))
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
