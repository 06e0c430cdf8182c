/* What turns and what conducts: the electrical half of the equations of design/motor.py, of the rigid shaft
   (motor.c) and of the one with a coupling (mechanism.c). `saturates`: of the iron, what is integrated then are
   fluxes; a constant where it is called, as no step asks for it four times. */
#ifndef CORE_MACHINE_EQUATIONS_H
#define CORE_MACHINE_EQUATIONS_H

#include <stdbool.h>

#include "motor.h"
#include "pairs.h"

/* Wb/s of d and q; the rest as below. */
static inline Pair flux_slopes(const MotorParameters *p, Pair voltage, Pair flux, double electrical, double live)
{
    Pair rotating = {electrical, -electrical};
    Pair current = currents_of_flux(&p->saturation, flux);
    return live * (voltage - p->resistance_ohm * current + rotating * swapped(flux));
}

/* N m, of constant inductances. */
static inline double motor_torque(const MotorParameters *p, double i_d, double i_q)
{
    double saliency = p->inductance_d_h - p->inductance_q_h;
    return p->torque_factor * p->pole_pairs * (p->flux_linkage_wb + saliency * i_d) * i_q;
}

/* What the windings make, N m, of currents or fluxes. */
static inline double electric_torque(const MotorParameters *p, bool saturates, Pair x)
{
    if (!saturates)
        return motor_torque(p, x[0], x[1]);
    Pair current = currents_of_flux(&p->saturation, x);
    return p->torque_factor * p->pole_pairs * (x[0] * current[1] - x[1] * current[0]);
}

/* A/s of d and q at a voltage, V, in the rotor's frame and an electrical speed, rad/s; `live`: 0 freezes them.
   Of iron that saturates, Wb/s of fluxes. */
static inline Pair current_slopes(const MotorParameters *p, bool saturates, Pair voltage, Pair current,
                                  double electrical, double live)
{
    if (saturates)
        return flux_slopes(p, voltage, current, electrical, live);
    Pair crossed = {p->inductance_q_h, -p->inductance_d_h}; /* with the sign of what turns it, as has the magnet */
    Pair magnet = {-0.0, -p->flux_linkage_wb};              /* to add -0 changes nothing, not even a sign */
    Pair per_inductance = {p->per_inductance_d, p->per_inductance_q};
    Pair turned = crossed * swapped(current) + magnet;
    return live * (voltage - p->resistance_ohm * current + electrical * turned) * per_inductance;
}

/* V/s of a voltage that turns in the rotor's frame, at rad/s. */
static inline Pair voltage_slopes(Pair voltage, double backwards)
{
    return backwards * swapped(voltage) * (Pair){1.0, -1.0};
}

#endif
