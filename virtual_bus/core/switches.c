/* An edge is crossed where the cubic through place and speed at both ends of a period meets it: below 1 ns off, but
   where the speed has a corner within the period. From there on the contact changes twice for each bounce, once in
   each of as many equal parts of its time, and rests on what the place says. */
#include "switches.h"

#include "scattered.h"

enum { HALVINGS = 40 };
static const double PER_32_BITS = 0x1p-32;

/* The share of a period, of `place` from 0 to `way`, at which it is `edge`; the slopes are those at both ends. */
static double crossing(double way, double slope_before, double slope_after, double edge)
{
    double low = 0.0, high = 1.0, sign = way > 0.0 ? 1.0 : -1.0;
    for (int halving = 0; halving < HALVINGS; halving++) {
        double x = 0.5 * (low + high), rest = 1.0 - x;
        double place = way * x * x * (3.0 - 2.0 * x) + slope_before * x * rest * rest - slope_after * x * x * rest;
        if (sign * (place - edge) < 0.0)
            low = x;
        else
            high = x;
    }
    return high;
}

void watch_switches(SwitchState *state, const Switches *switches, double turns, double turns_s, double now_s,
                    double period_s)
{
    for (int which = 0; which < SWITCHES; which++) {
        double low = switches->low_turns[which], high = switches->high_turns[which];
        bool made = low <= turns && turns < high;
        if (state->watched && made != state->made[which]) {
            bool at_low = (state->turns < low) != (turns < low);
            double edge = (at_low ? low : high) - state->turns, way = turns - state->turns;
            double share = crossing(way, state->turns_s * period_s, turns_s * period_s, edge);
            state->crossed_s[which] = now_s - (1.0 - share) * period_s;
            state->crossings[which] += 1.0;
        }
        state->made[which] = made;
    }
    state->watched = 1;
    state->turns = turns;
    state->turns_s = turns_s;
}

/* When the contact changes for the `number`-th time after a crossing, s. */
static double change_s(const SwitchState *state, const Switches *switches, int which, int number)
{
    if (number == 0)
        return 0.0;
    uint64_t crossing = (uint64_t)state->crossings[which] * SWITCHES + (uint64_t)which;
    uint64_t counter = (uint64_t)switches->seed + crossing * (2 * BOUNCES_MAX) + (uint64_t)number;
    double place = (double)(scattered(counter) >> 32) * PER_32_BITS;
    return switches->bounce_s * (number - 1 + place) / (2 * switches->bounces);
}

bool switch_seen(const SwitchState *state, const Switches *switches, int which, double now_s)
{
    bool made = state->made[which];
    if (state->crossings[which] == 0.0)
        return made;
    bool seen = !made, contact = made;
    int changes = switches->bounce_s > 0.0 ? 2 * switches->bounces : 0;
    double since_s = now_s - state->crossed_s[which], from_s = 0.0;
    for (int number = 0; number <= changes && from_s + switches->filter_s <= since_s; number++) {
        double until_s = number < changes ? change_s(state, switches, which, number + 1) : from_s;
        if (number == changes || until_s - from_s >= switches->filter_s)
            seen = contact;
        contact = !contact;
        from_s = until_s;
    }
    return seen;
}
