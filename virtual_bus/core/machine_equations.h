/* What turns and what conducts: the electrical half of the equations of design/motor.py, of the rigid shaft
   (motor.c) and of the one with a coupling (mechanism.c). */
#ifndef CORE_MACHINE_EQUATIONS_H
#define CORE_MACHINE_EQUATIONS_H

#include "motor.h"

/* A, and V that turn in the rotor's frame; or their slopes. */
typedef struct Electric {
    double i_d, i_q, v_d, v_q;
} Electric;

static inline Electric electric_slopes(const MotorParameters *p, Electric x, double speed, double live, double turning)
{
    double electrical = p->pole_pairs * speed;
    double flux_d = p->inductance_d_h * x.i_d + p->flux_linkage_wb;
    double flux_q = p->inductance_q_h * x.i_q;
    double backwards = turning * electrical;
    return (Electric){
        .i_d = live * (x.v_d - p->resistance_ohm * x.i_d + electrical * flux_q) * p->per_inductance_d,
        .i_q = live * (x.v_q - p->resistance_ohm * x.i_q - electrical * flux_d) * p->per_inductance_q,
        .v_d = backwards * x.v_q,
        .v_q = -backwards * x.v_d,
    };
}

#endif
