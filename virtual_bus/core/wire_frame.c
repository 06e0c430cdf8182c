/* A frame of Python's as it is on the wire. */
#include <string.h>

#include "frames.h"
#include "objects.h"
#include "segment.h"
#include "types.h"

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

/* `frame` borrows the reference to `object`. */
bool read_frame(PyObject *object, WireFrame *frame)
{
    char *octets;
    Py_ssize_t length;
    if (!is_a(object, frame_type, "a WireFrame"))
        return false;
    const FrameObject *read = (const FrameObject *)object;
    if (PyBytes_AsStringAndSize(read->data, &octets, &length) < 0)
        return false;
    if (length > DATA_MAX) {
        PyErr_Format(PyExc_ValueError, "%zd octets in a frame: at most %d expected", length, DATA_MAX);
        return false;
    }
    int64_t dlc = read->remote ? read->remote_length : length;
    int id_bits = read->extended ? 29 : 11;
    if (read->can_id < 0 || read->can_id >= 1 << id_bits || dlc < 0 || dlc > 15) {
        PyErr_Format(PyExc_ValueError, "identifier %lld, DLC %lld: %d and 4 bits expected", (long long)read->can_id,
                     (long long)dlc, id_bits);
        return false;
    }
    frame->object = object;
    frame->can_id = (uint32_t)read->can_id;
    frame->extended = read->extended;
    frame->remote = read->remote;
    frame->length = (int)length;
    memcpy(frame->data, octets, (size_t)length);
    frame->field = arbitration_field(frame->can_id, frame->extended, frame->remote) << 4 | (uint64_t)dlc;
    return true;
}
