#include "hub_record.h"

#include <string.h>

#include "segment.h"
#include "types.h"

enum { HANDED_AT = 8, IDENTIFIER = 16, FLAGS = 20, LENGTH = 21, DATA = 22 };
enum { EXTENDED = 1, REMOTE = 2, OWN = 4 };

bool pack_record(PyObject *object, int64_t at, bool own, unsigned char *octets)
{
    WireFrame frame;
    if (!read_frame(object, &frame))
        return false;
    const FrameObject *read = (const FrameObject *)object;
    memset(octets, 0, HUB_FRAME_BYTES);
    memcpy(octets, &at, sizeof at);
    memcpy(octets + HANDED_AT, &read->handed_at, sizeof read->handed_at);
    memcpy(octets + IDENTIFIER, &frame.can_id, sizeof frame.can_id);
    octets[FLAGS] = (unsigned char)(EXTENDED * frame.extended | REMOTE * frame.remote | OWN * own);
    octets[LENGTH] = (unsigned char)(frame.remote ? read->remote_length : frame.length);
    memcpy(octets + DATA, frame.data, (size_t)frame.length);
    return true;
}

/* Only what a valid frame is packed to. */
bool unpack_record(const unsigned char *octets, Arrived *arrived)
{
    uint32_t can_id;
    memcpy(&can_id, octets + IDENTIFIER, sizeof can_id);
    bool extended = octets[FLAGS] & EXTENDED, remote = octets[FLAGS] & REMOTE;
    int length = octets[LENGTH];
    if (length > DATA_MAX || can_id >> (extended ? 29 : 11)) {
        PyErr_Format(PyExc_ValueError, "identifier 0x%x, DLC %d", (unsigned)can_id, length);
        return false;
    }
    PyObject *data = PyBytes_FromStringAndSize((const char *)octets + DATA, remote ? 0 : length);
    arrived->frame = data == NULL ? NULL : make_frame(frame_type, can_id, data);
    forget(&data);
    if (arrived->frame == NULL)
        return false;
    arrived->frame->extended = extended;
    arrived->frame->remote = remote;
    arrived->frame->remote_length = remote ? length : 0;
    memcpy(&arrived->frame->handed_at, octets + HANDED_AT, sizeof arrived->frame->handed_at);
    memcpy(&arrived->at, octets, sizeof arrived->at);
    arrived->own = octets[FLAGS] & OWN;
    return true;
}

PyObject *call_pack_frame(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    int64_t at;
    unsigned char octets[HUB_FRAME_BYTES];
    int own = takes(count, 3, "pack_frame") && integer(arguments[1], &at) ? PyObject_IsTrue(arguments[2]) : -1;
    if (own < 0 || !pack_record(arguments[0], at, own, octets))
        return NULL;
    return PyBytes_FromStringAndSize((const char *)octets, sizeof octets);
}

PyObject *call_unpack_frame(PyObject *module, PyObject *packet)
{
    (void)module;
    char *octets;
    Py_ssize_t length;
    Arrived arrived;
    if (PyBytes_AsStringAndSize(packet, &octets, &length) < 0)
        return NULL;
    if (length != HUB_FRAME_BYTES)
        return PyErr_Format(PyExc_ValueError, "%zd bytes are no frame", length);
    return unpack_record((const unsigned char *)octets, &arrived) ? received_tuple(&arrived) : NULL;
}
