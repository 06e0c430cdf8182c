/* Makes a reading from every frame that carries the speed; all other values are the last known.
   servobench.drivers.cia402.readings says how a position is carried on. */
#include "reception.h"

#include "attributes.h"
#include "statusword.h"
#include "whole_numbers.h"

enum { POSITION_BITS = 32, NS_PER_US = 1000 };

static bool append(PyObject *rows, const void *row, size_t size)
{
    PyObject *octets = PyBytes_FromStringAndSize(row, (Py_ssize_t)size);
    bool well = octets != NULL && PyList_Append(rows, octets) == 0;
    forget(&octets);
    return well;
}

/* The time of the last SYNC sent, us, where a drive has no stamp. */
static bool time_of_sync(ReceptionObject *self, int64_t *us)
{
    static Attribute sync_count = {.spelt = "sync_count"};
    PyObject *read = attribute(&sync_count, self->syncs);
    int64_t count;
    bool well = read != NULL && integer(read, &count);
    forget(&read);
    if (well)
        *us = times(count, self->state.period_us);
    return well;
}

/* The time, us, of the whole SYNCs between two frames by their arrival; frames of one SYNC come within half a
   period. */
static int64_t time_between(const Reception *self, int64_t from, int64_t to)
{
    int64_t syncs = floored(plus(minus(to, from), self->period_ns / 2), self->period_ns);
    return times(syncs, self->period_us);
}

/* The stamp, unwrapped from the last reading's: 1013h wraps after 71.6 minutes. */
static int64_t unwrapped(const Reception *self, int64_t stamp_raw)
{
    int64_t way = way_between(self->stamp_raw, stamp_raw, self->stamp_bits);
    return self->stamp_known ? plus(self->count, way) : stamp_raw;
}

/* 6064h is an INTEGER32: at 65536 counts per turn it wraps after 22 minutes of 1500 rev/min. */
static int64_t unwrapped_position(const Reception *self, int64_t raw)
{
    int64_t way = way_between(self->position_raw, raw, POSITION_BITS);
    return self->position_known ? plus(self->position, way) : raw;
}

/* A raw position near the last one, on the scale of the readings; NULL: the last one. */
double position_rad(const Reception *self, const int64_t *raw)
{
    int64_t counted = raw == NULL || !self->position_known ? self->position : unwrapped_position(self, *raw);
    return (double)counted * self->rad_per_count;
}

/* 6064h as read at `at`, from which positions are extrapolated. */
bool anchor_position(ReceptionObject *self, int64_t raw, int64_t at)
{
    Reception *state = &self->state;
    state->position = unwrapped_position(state, raw);
    state->position_raw = raw;
    state->position_known = true;
    state->position_told_at = at;
    state->carried_rad = 0.0;
    if (state->leads)
        state->anchored_at = at;
    else if (state->stamped) /* of the SYNC of the last reading; or of one whose speed was lost on the way */
        state->carried_to_us = plus(state->last_us, time_between(state, state->last_at, at));
    else
        return time_of_sync(self, &state->carried_to_us);
    return true;
}

/* 6077h, or the current used in its place. */
void torque_told(Reception *self, int64_t raw, int64_t at)
{
    self->torque_nm = (double)raw * self->nm_per_raw;
    self->torque_told_at = at;
}

/* 6074h of a SYNC, from the frame of the last reading or from another. */
bool demand_told(ReceptionObject *self, int64_t raw, int64_t at, bool in_reading)
{
    int64_t row[] = {raw, at, self->state.readings_made, in_reading};
    return append(self->readbacks, row, sizeof row);
}

/* 6074h sent on change; `stamp_raw`: 1013h of that moment. */
bool demand_changed(ReceptionObject *self, int64_t raw, int64_t stamp_raw, int64_t at)
{
    int64_t row[] = {raw, times(unwrapped(&self->state, stamp_raw), self->state.count_ns), at};
    return append(self->changes, row, sizeof row);
}

/* Pass a demand or torque to the watch. A drive that itself reports not following needs no watch. */
void tell_watch(ReceptionObject *self, CommandWatch *watch, int64_t raw)
{
    if (self->follow->lapsed)
        command_excused(watch);
    else
        command_told(watch, raw, (self->told->statusword & INTERNAL_LIMIT_ACTIVE) != 0);
}

/* The angle that the shaft has turned since the last position frame until `us`, rad. An overtaken reading, older than
   the last extrapolation, moves nothing. */
static double carry(Reception *self, int64_t us, double velocity_rad_s, int64_t at)
{
    if (self->anchored_at >= 0) {
        self->carried_to_us = minus(us, time_between(self, self->anchored_at, at));
        self->anchored_at = NEVER_TOLD;
    }
    int64_t passed_us = minus(us, self->carried_to_us);
    if (passed_us < -self->reach_us || passed_us > self->reach_us) {
        self->carried_to_us = us;
        passed_us = 0;
    }
    double mean_rad_s = 0.5 * (self->velocity_rad_s + velocity_rad_s);
    double carried_rad = self->carried_rad + mean_rad_s * (double)passed_us * 1e-6;
    if (passed_us >= 0) {
        self->carried_rad = carried_rad;
        self->carried_to_us = us;
        self->velocity_rad_s = velocity_rad_s;
    }
    return carried_rad;
}

/* 606Ch with its stamp 1013h, or NO_STAMP: a reading. */
bool speed_told(ReceptionObject *self, int64_t raw, int64_t stamp_raw, int64_t at)
{
    Reception *state = &self->state;
    int64_t device_time_ns = INT64_MIN, us;
    if (stamp_raw >= 0) {
        state->count = unwrapped(state, stamp_raw);
        state->stamp_raw = stamp_raw;
        state->stamp_known = true;
        device_time_ns = times(state->count, state->count_ns);
        us = floored(device_time_ns, NS_PER_US);
    } else if (!time_of_sync(self, &us)) {
        return false;
    }
    state->last_us = us;
    state->last_at = at;
    state->readings_made++;
    double velocity_rad_s = (double)raw * state->rad_s_per_raw;
    double position = (double)state->position * state->rad_per_count + carry(state, us, velocity_rad_s, at);
    struct {
        double velocity_rad_s, position_rad, torque_nm;
        int64_t device_time_ns, received_at, position_told_at, torque_told_at, statusword, status_told_at;
    } row = {velocity_rad_s,        position, state->torque_nm,        device_time_ns,
             at,                    state->position_told_at, state->torque_told_at, self->told->statusword,
             self->told->at};
    return append(self->readings, &row, sizeof row);
}
