/* What turns and what conducts: the electrical half of the equations of design/motor.py, of the rigid shaft
   (motor.c) and of the one with a coupling (mechanism.c). */
#ifndef CORE_MACHINE_EQUATIONS_H
#define CORE_MACHINE_EQUATIONS_H

#include "motor.h"
#include "pairs.h"

/* A/s of d and q at a voltage, V, in the rotor's frame and an electrical speed, rad/s; `live`: 0 freezes them. */
static inline Pair current_slopes(const MotorParameters *p, Pair voltage, Pair current, double electrical, double live)
{
    Pair crossed = {p->inductance_q_h, p->inductance_d_h}, rotating = {electrical, -electrical};
    Pair magnet = {-0.0, p->flux_linkage_wb}; /* to add -0 changes nothing, not even a sign */
    Pair per_inductance = {p->per_inductance_d, p->per_inductance_q};
    Pair flux = crossed * swapped(current) + magnet;
    return live * (voltage - p->resistance_ohm * current + rotating * flux) * per_inductance;
}

/* V/s of a voltage that turns in the rotor's frame, at rad/s. */
static inline Pair voltage_slopes(Pair voltage, double backwards)
{
    return (Pair){backwards, -backwards} * swapped(voltage);
}

#endif
