/* Trips open the power stage at the tick that sees them, as a comparator beside the processor does; the drive
   tells of them afterwards. A hot motor or stage does not, nor an overload: I^2 t above the continuous current adds up, and when the sum
   is full the drive fails, or limits the current to the continuous one until the sum has fallen. */
#include "protection.h"

#include <math.h>

#include "limits.h"

static bool opens(int trip)
{
    return trip != TRIP_NONE && trip != TRIP_OVERLOAD && trip != TRIP_MOTOR_HOT && trip != TRIP_STAGE_HOT;
}

static Trip first_trip(const Protection *p, bool on, double link_v, double current_a2, double missing)
{
    if (link_v > p->over_v)
        return TRIP_OVER_VOLTAGE;
    if (!on)
        return TRIP_NONE;
    if (link_v < p->under_v)
        return TRIP_UNDER_VOLTAGE;
    if (fabs(missing) > p->missing_max)
        return TRIP_ENCODER;
    return current_a2 > p->over_a2 ? TRIP_OVER_CURRENT : TRIP_NONE;
}

static void add_up(ProtectionState *state, const Protection *p, double current_a2)
{
    double sum = state->overload_a2s + (current_a2 - p->continuous_a2) * p->period_s;
    state->overload_a2s = within(sum, 0.0, p->overload_max_a2s);
    state->warning = state->overload_a2s >= p->warning_a2s ? 1.0 : 0.0;
    if (state->overload_a2s >= p->overload_max_a2s) {
        state->limiting = 1.0;
        if (p->overload_trips && state->trip == TRIP_NONE)
            state->trip = TRIP_OVERLOAD;
    } else if (state->overload_a2s < p->clear_a2s) {
        state->limiting = 0.0;
    }
}

/* A heat sink of first order; from derate_from_c on the current that it lets through falls to 0 at its limit. */
static void heat_stage(ProtectionState *state, const Protection *p, double current_a2)
{
    state->stage_c += p->stage_share * (p->ambient_c + p->rise_k_a2 * current_a2 - state->stage_c);
    bool hot = state->stage_c > (state->stage_hot != 0.0 ? p->stage_clear_c : p->stage_max_c);
    state->stage_hot = hot ? 1.0 : 0.0;
    if (hot && state->trip == TRIP_NONE)
        state->trip = TRIP_STAGE_HOT;
    state->derated = state->stage_c > p->derate_from_c ? 1.0 : 0.0;
}

static void limit(ProtectionState *state, const Protection *p)
{
    state->limit_a = state->limiting != 0.0 ? p->continuous_a : INFINITY;
    if (state->derated != 0.0)
        state->limit_a = least(state->limit_a, most(0.0, p->derate_a_k * (p->stage_max_c - state->stage_c)));
    state->limits = state->limit_a < INFINITY ? 1.0 : 0.0;
}

bool watch(ProtectionState *state, const Protection *p, bool on, double link_v, double current_a2, double missing)
{
    add_up(state, p, current_a2);
    if (p->stage_heats)
        heat_stage(state, p, current_a2);
    limit(state, p);
    if (state->trip == TRIP_NONE && state->winding_c > p->winding_max_c)
        state->trip = TRIP_MOTOR_HOT;
    if (!opens(state->trip)) {
        Trip found = first_trip(p, on, link_v, current_a2, missing);
        if (found == TRIP_NONE)
            return false;
        state->trip = found;
    }
    return true;
}
