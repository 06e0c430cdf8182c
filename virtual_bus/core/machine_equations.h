/* What turns and what conducts: the electrical half of the equations of design/motor.py, of the rigid shaft
   (motor.c) and of the one with a coupling (mechanism.c). */
#ifndef CORE_MACHINE_EQUATIONS_H
#define CORE_MACHINE_EQUATIONS_H

#include "motor.h"

/* A/s at a voltage in the rotor's frame and an electrical speed, rad/s; `live`: 0 freezes it. As scalars: a
   structure that is handed about costs the step 2 of its 90 ns. */
static inline double slope_d(const MotorParameters *p, double v_d, double i_d, double i_q, double electrical,
                             double live)
{
    double flux_q = p->inductance_q_h * i_q;
    return live * (v_d - p->resistance_ohm * i_d + electrical * flux_q) * p->per_inductance_d;
}

static inline double slope_q(const MotorParameters *p, double v_q, double i_d, double i_q, double electrical,
                             double live)
{
    double flux_d = p->inductance_d_h * i_d + p->flux_linkage_wb;
    return live * (v_q - p->resistance_ohm * i_q - electrical * flux_d) * p->per_inductance_q;
}

#endif
