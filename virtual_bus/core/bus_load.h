/* Bus load over any past interval, from a bounded number of checkpoints. */
#ifndef CORE_BUS_LOAD_H
#define CORE_BUS_LOAD_H

#include "stable_abi.h"

/* Ends of frames, 64 kB: a second of a full bus at 500 kbit/s is in them frame by frame. */
enum { CHECKPOINTS_MAX = 4096 };

/* Cumulated busy time, remembered at the end of every stride-th frame. */
typedef struct BusLoad {
    int64_t busy_ns, stride, countdown;
    int count;
    int64_t ends[CHECKPOINTS_MAX], busy[CHECKPOINTS_MAX];
} BusLoad;

typedef struct LoadObject {
    PyObject head;
    BusLoad load;
    int64_t bitrate_bit_s, last_end; /* of the frames shown to it; 0: it counts none */
} LoadObject;

extern PyTypeObject *load_type;

void start_load(BusLoad *self);
void add_load(BusLoad *self, int64_t duration_ns, int64_t end);
double load_percent(const BusLoad *self, int64_t since, int64_t until);
int64_t busy_until(const BusLoad *self, int64_t when);

#endif
