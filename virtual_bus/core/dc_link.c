/* The link over a period, in steps: half of what is linear, all of the inverter's power, the other half.

   The trapezoidal rule and a capacitor that gives exactly the energy asked for leave no energy unaccounted:
   C/2 v^2 changes by what source, chopper and inverter exchange, to rounding. Only +, -, *, / and sqrt. */
#include "dc_link.h"

#include <math.h>
#include <stdbool.h>

#include "limits.h"

/* Source and chopper over h seconds. */
static void advance_resistors(LinkState *state, const DcLink *p, double source_v, double h)
{
    bool conducts = p->feeds_back || state->volts < source_v;
    double source = conducts ? p->source_siemens : 0.0;
    double chopper = state->chopping * p->chopper_siemens;
    double a = 0.5 * h * (source + chopper) / p->capacitance_f;
    double before = state->volts;
    double volts = ((1.0 - a) * before + h * source * source_v / p->capacitance_f) / (1.0 + a);
    double middle = 0.5 * (before + volts);
    state->supplied_j += h * source * (source_v - middle) * middle;
    state->chopped_j += h * chopper * middle * middle;
    state->volts = volts;
}

void advance_link(LinkState *state, const DcLink *p, double watts)
{
    double taken = 2.0 * (watts + p->idle_w) * p->step_s / p->capacitance_f;
    if (state->volts >= p->chopper_on_v)
        state->chopping = 1.0;
    else if (state->volts <= p->chopper_off_v)
        state->chopping = 0.0;
    for (int step = 0; step < (int)p->steps; step++) {
        advance_resistors(state, p, p->source_v, 0.5 * p->step_s);
        state->volts = sqrt(most(state->volts * state->volts - taken, 0.0));
        advance_resistors(state, p, p->source_v, 0.5 * p->step_s);
    }
}
