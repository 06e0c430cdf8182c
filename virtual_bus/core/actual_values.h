/* What the drive tells of its motion and torque, in the units of its master. */
#ifndef CORE_ACTUAL_VALUES_H
#define CORE_ACTUAL_VALUES_H

/* The factor group of CiA 402-2 as it is in force. */
typedef struct UserScale {
    double origin; /* encoder count of the master's position 0 */
    double counts_per_position, velocity_per_rad_s, torque_unit_nm;
    double range_low, range_span; /* 607Bh, user units; span 0: positions wrap as an INTEGER32 */
} UserScale;

double clipped(double value, int bits);
double user_position(double counts, double counts_per_position);
double ranged_position(const UserScale *scale, double counts);

#endif
