/* What the drive makes of a torque: currents of the least amplitude, and a weaker field at speed. */
#ifndef CORE_FIELD_H
#define CORE_FIELD_H

#include "pairs.h"

enum { FIELD_POINTS_MAX = 65 };

/* Of the motor as the drive believes it. */
typedef struct FieldControl {
    int active;      /* 0: i_d stays at zero */
    int points;      /* 0: no table, i_d is that of the weakening alone */
    double per_step; /* of the table, 1/(N m) */
    double least_d_a[FIELD_POINTS_MAX]; /* d current of the least amplitude, from torque 0 on */
    double voltage_share; /* of the voltage circle, above which the field is weakened; 0: never */
    double gain;          /* A per V and period, times rad/s */
    double speed_min_rad_s; /* electrical; slower, the gain grows no more */
    double floor_a;         /* least i_d */
    double weakest_a;       /* least i_d of the weakening, beside the largest of the table */
    double torque_per_wb;   /* N m per A and Wb: torque factor times pole pairs */
    double calm_rad_s;      /* faster, a period of the motor takes more steps */
    double calm_steps, fast_steps;
} FieldControl;

/* The motor as the drive believes it. */
typedef struct Believed {
    double flux_linkage_wb, saliency_h, resistance_ohm, inductance_q_h, inertia_kg_m2;
} Believed;

/* d and q currents for a torque, inside the circle of `limit_a`; `weaker_a`: i_d of the weakening, 0 or less;
   `circle_v`: the largest voltage, `electrical`: rad/s. */
Pair field_currents(const FieldControl *p, const Believed *motor, double torque_nm, double limit_a, double weaker_a,
                    double circle_v, double electrical);
/* i_d of the weakening for the next period. */
double weaken(const FieldControl *p, double weaker_a, double voltage_v, double circle_v, double electrical);

#endif
