/* The motor and the mechanics: state, parameters, one period of them. */
#ifndef CORE_MOTOR_H
#define CORE_MOTOR_H

typedef struct MotorState {
    double current_d_a, current_q_a, speed_rad_s;
    double angle_rad; /* 0 <= angle < 2 pi */
    double turns;     /* whole ones */
} MotorState;

typedef struct MotorParameters {
    double resistance_ohm, inductance_d_h, inductance_q_h, flux_linkage_wb, pole_pairs, torque_factor;
    double inertia_kg_m2, viscous_friction_nm_s, coulomb_friction_nm, voltage_max_v;
    double period_s, substeps, step_s; /* of the integration */
    double torque_constant_nm_a;
    /* Reciprocals: a division costs as much as ten products. */
    double per_inductance_d, per_inductance_q, per_inertia, per_torque_constant, rate_hz;
} MotorParameters;

/* The voltage, V, in the rotor's frame at the start of a period. */
typedef struct Voltage {
    double d, q;
    double live;    /* 0 freezes the currents */
    double turning; /* 1: stands still in the stator's frame, so turns backwards in the rotor's; 0: does not */
} Voltage;

/* N m */
double motor_torque(const MotorParameters *p, double current_d_a, double current_q_a);
void advance_motor(MotorState *state, const MotorParameters *p, Voltage voltage, double load_nm, double brake_nm);

#endif
