/* The motor and the mechanics: state, parameters, one period of them. */
#ifndef CORE_MOTOR_H
#define CORE_MOTOR_H

#include "saturation.h"

typedef struct MotorState {
    double current_d_a, current_q_a, speed_rad_s;
    double angle_rad; /* 0 <= angle < 2 pi */
    double turns;     /* whole ones */
    /* Of iron that saturates: the fluxes, Wb, and the currents that they belong to. */
    double flux_d_wb, flux_q_wb, fluxed_d_a, fluxed_q_a;
    double fluxed; /* 0: not told yet */
} MotorState;

typedef struct MotorParameters {
    double resistance_ohm, inductance_d_h, inductance_q_h, flux_linkage_wb, pole_pairs, torque_factor;
    double inertia_kg_m2, viscous_friction_nm_s, coulomb_friction_nm, voltage_max_v;
    double period_s, substeps, step_s; /* of the integration */
    double torque_constant_nm_a;
    /* Reciprocals: a division costs as much as ten products. */
    double per_inductance_d, per_inductance_q, per_inertia, per_torque_constant, rate_hz;
    Saturation saturation;
} MotorParameters;

/* The voltage, V, in the rotor's frame at the start of a period. */
typedef struct Voltage {
    double d, q;
    double live;    /* 0 freezes the currents */
    double turning; /* 1: stands still in the stator's frame, so turns backwards in the rotor's; 0: does not */
} Voltage;

/* What is integrated of d and q: currents, A; of iron that saturates fluxes, Wb. */
Pair electric_state(const MotorState *state, const MotorParameters *p);
void take_electric_state(MotorState *state, const MotorParameters *p, Pair x);
void advance_motor(MotorState *state, const MotorParameters *p, Voltage voltage, double load_nm, double brake_nm);

#endif
