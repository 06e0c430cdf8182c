/* The frames of one TPDO: Python's Inlet. */
#ifndef CORE_INLET_H
#define CORE_INLET_H

#include "frames.h"
#include "reception.h"

/* Objects with a use; all others are skipped. */
typedef enum Told { STATUS, MODE, TORQUE, POSITION, VELOCITY, STAMP, DEMAND, WATCHED, TOLD_COUNT } Told;

/* A whole number in a PDO, little-endian (CiA 301, 7.1.4). */
typedef struct OctetField {
    int place, octets; /* 0 octets: not mapped */
    bool is_signed;
} OctetField;

typedef struct InletObject {
    PyObject head;
    ReceptionObject *reception;
    bool keeps;
    KeptFrame *kept; /* since they were taken last */
    Py_ssize_t kept_count, kept_room;
    OctetField fields[TOLD_COUNT];
    int octets;     /* of a frame as mapped */
    bool on_change; /* a torque demand and its stamp, sent when the demand changes */
} InletObject;

extern PyTypeObject *inlet_type;

bool take_pdo(InletObject *self, PyObject *data, int64_t at);

#endif
