/* One RPDO, its present values and the echoes of its frames: Python's SetPointFrame. */
#ifndef CORE_SET_POINT_FRAME_H
#define CORE_SET_POINT_FRAME_H

#include "awaited.h"
#include "link.h"

enum { RPDO_OCTETS_MAX = 8 };

typedef enum ValueKind { UNSIGNED_VALUE, SIGNED_VALUE, REAL_VALUE, OCTETS_VALUE } ValueKind;

typedef struct ValueField {
    int place, octets;
    ValueKind kind;
} ValueField;

typedef struct SetPointFrameObject {
    PyObject head;
    LinkObject *link;
    int64_t can_id;
    int count; /* of fields */
    ValueField fields[RPDO_OCTETS_MAX];
    int octets;
    unsigned char image[RPDO_OCTETS_MAX];
    PyObject *sent_data; /* of the last frame sent, or NULL */
    int64_t sent_at;
    Awaited awaited;
} SetPointFrameObject;

extern PyTypeObject *set_point_frame_type;

#endif
