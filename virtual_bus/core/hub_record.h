/* A frame on its way between a hub's broker and a client, two processes of one machine: numbers in its order.

    place   0                8            16          20     21   22
            end of frame     hand-over    identifier  flags  DLC  data, 0 beyond the DLC */
#ifndef CORE_HUB_RECORD_H
#define CORE_HUB_RECORD_H

#include "frames.h"

enum {
    HUB_FRAME_BYTES = 30, /* no other packet is as long, or a multiple of it */
    /* Some 17 frames: a packet of the size that the kernel allocates for it in one piece. */
    HUB_PACKET_BYTES_MAX = 512,
};

bool pack_record(PyObject *frame, int64_t at, bool own, unsigned char *octets);
bool unpack_record(const unsigned char *octets, Arrived *arrived);

PyObject *call_pack_frame(PyObject *module, PyObject *const *arguments, Py_ssize_t count);
PyObject *call_unpack_frame(PyObject *module, PyObject *packet);

#endif
