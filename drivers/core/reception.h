/* What the TPDOs of one drive tell, frame by frame, as readings: Python's Reception. */
#ifndef CORE_RECEPTION_H
#define CORE_RECEPTION_H

#include "command_watch.h"
#include "follow_reports.h"

enum { NEVER_TOLD = -1, NO_STAMP = -1 };

/* The last statusword of a drive: Python's LastStatusword. */
typedef struct LastStatuswordObject {
    PyObject head;
    int64_t statusword, at, by_pdo;
    int64_t bits, wanted, silence_ns; /* what is expected of it */
} LastStatuswordObject;

typedef struct Reception {
    double rad_s_per_raw, nm_per_raw, rad_per_count;
    int64_t period_ns, period_us, reach_us;
    int64_t count_ns; /* one count of the drive's stamp */
    int stamp_bits;
    bool leads;   /* a position comes before the speed of its SYNC */
    bool stamped; /* the speed's frame carries a stamp */
    int64_t malformed, readings_made;
    double torque_nm;
    int64_t torque_told_at, position_told_at;
    double velocity_rad_s; /* of the last reading */
    int64_t last_at, last_us;
    int64_t position, position_raw; /* unwrapped, and as it came */
    bool position_known, stamp_known;
    double carried_rad; /* turned since the last position, by `carried_to_us` */
    int64_t carried_to_us, anchored_at;
    int64_t stamp_raw, count; /* the last stamp, as it came and unwrapped */
} Reception;

typedef struct ReceptionObject {
    PyObject head;
    Reception state;
    PyObject *readings, *readbacks, *changes; /* lists of rows, each the octets of its numbers */
    LastStatuswordObject *told;
    FollowReportsObject *follow;
    PyObject *syncs; /* has sync_count */
    PyObject *watch; /* CommandWatch, or None */
} ReceptionObject;

extern PyTypeObject *reception_type;

bool anchor_position(ReceptionObject *self, int64_t raw, int64_t at);
void torque_told(Reception *self, int64_t raw, int64_t at);
bool speed_told(ReceptionObject *self, int64_t raw, int64_t stamp_raw, int64_t at);
bool demand_told(ReceptionObject *self, int64_t raw, int64_t at, bool in_reading);
bool demand_changed(ReceptionObject *self, int64_t raw, int64_t stamp_raw, int64_t at);
void tell_watch(ReceptionObject *self, CommandWatch *watch, int64_t raw);
double position_rad(const Reception *self, const int64_t *raw);

#endif
