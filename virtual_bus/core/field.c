/* Only +, -, *, / and sqrt, as in the rest of the core. */
#include "field.h"

#include <math.h>

#include "limits.h"

static double least_d(const FieldControl *p, double torque_nm)
{
    double place = fabs(torque_nm) * p->per_step;
    int last = p->points - 1;
    if (!(place < last)) /* beyond the table, or no number */
        return p->least_d_a[last];
    int point = (int)place;
    double low = p->least_d_a[point], high = p->least_d_a[point + 1];
    return low + (place - point) * (high - low);
}

Pair field_currents(const FieldControl *p, const Believed *motor, double torque_nm, double limit_a, double weaker_a,
                    double circle_v, double electrical)
{
    double i_d = p->points > 0 ? least_d(p, torque_nm) : 0.0;
    i_d = within(i_d + weaker_a, most(p->floor_a, -limit_a), limit_a);
    double per_ampere = p->torque_per_wb * (motor->flux_linkage_wb + motor->saliency_h * i_d);
    double i_q = torque_nm / per_ampere;
    double most_q = sqrt(most(limit_a * limit_a - i_d * i_d, 0.0));
    if (weaker_a < 0.0) {
        double reactance = fabs(electrical) * motor->inductance_q_h;
        double left_v = most(p->voltage_share * circle_v - fabs(motor->resistance_ohm * i_d), 0.0);
        if (reactance * most_q > left_v)
            most_q = left_v / reactance;
    }
    return (Pair){i_d, within(i_q, -most_q, most_q)};
}

double weaken(const FieldControl *p, double weaker_a, double voltage_v, double circle_v, double electrical)
{
    double left_v = p->voltage_share * circle_v - voltage_v;
    double faster = most(fabs(electrical), p->speed_min_rad_s);
    return within(weaker_a + p->gain * left_v / faster, p->weakest_a, 0.0);
}
