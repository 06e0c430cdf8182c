/* Equations of the machine in the rotor's dq frame (design/motor.py), with the mechanics, by Runge-Kutta.

   Only +, -, *, / and sqrt occur, and the compiler may neither fuse nor reorder them: a run gives the same
   bits on every IEEE 754 machine. */
#include "motor.h"

#include <math.h>
#include <stdbool.h>

#include "limits.h"
#include "machine_equations.h"
#include "rotation.h"

static const double PER_TURN = 1.0 / TURN_RAD;
static const double BELOW_TURN_RAD = 0x1.921fb54442d17p+2; /* the next double below 2 pi */
static const double SIXTH = 1.0 / 6.0;

/* What is integrated, of d and q: A (or Wb), and V that turn in the rotor's frame. */
typedef struct Motion {
    Pair current, voltage;
    double speed;
} Motion;

/* What does not change within a step: constants where one is called. */
typedef struct Forcing {
    bool saturates;       /* the iron */
    double live, turning; /* as in Voltage */
    double resisting;     /* N m of load and Coulomb friction */
    double moving;        /* 0 holds the shaft */
} Forcing;

Pair electric_state(const MotorState *state, const MotorParameters *p)
{
    Pair current = {state->current_d_a, state->current_q_a};
    if (!p->saturation.active)
        return current;
    if (state->fluxed != 0.0 && current[0] == state->fluxed_d_a && current[1] == state->fluxed_q_a)
        return (Pair){state->flux_d_wb, state->flux_q_wb};
    return flux_of_currents(&p->saturation, current);
}

void take_electric_state(MotorState *state, const MotorParameters *p, Pair x)
{
    Pair current = x;
    if (p->saturation.active) {
        current = currents_of_flux(&p->saturation, x);
        state->flux_d_wb = x[0];
        state->flux_q_wb = x[1];
        state->fluxed_d_a = current[0];
        state->fluxed_q_a = current[1];
        state->fluxed = 1.0;
    }
    state->current_d_a = current[0];
    state->current_q_a = current[1];
}

/* What a step calls four times: as calls, or with what is constant asked for anew, it would take half as long again. */
#define ALWAYS_INLINE static inline __attribute__((always_inline))

ALWAYS_INLINE Motion slopes(const MotorParameters *p, const Motion *x, Forcing f)
{
    double electrical = p->pole_pairs * x->speed;
    double made = electric_torque(p, f.saturates, x->current);
    double net = made - p->viscous_friction_nm_s * x->speed - f.resisting;
    return (Motion){
        .current = current_slopes(p, f.saturates, x->voltage, x->current, electrical, f.live),
        .voltage = voltage_slopes(x->voltage, f.turning * electrical),
        .speed = f.moving * net * p->per_inertia,
    };
}

ALWAYS_INLINE Motion ahead(const Motion *x, const Motion *k, double h)
{
    return (Motion){x->current + h * k->current, x->voltage + h * k->voltage, x->speed + h * k->speed};
}

/* One classical step of fourth order, h seconds; returns the angle travelled. */
ALWAYS_INLINE double runge_kutta(const MotorParameters *p, const Motion *x, Forcing f, double h, Motion *new)
{
    Motion k1 = slopes(p, x, f);
    Motion x2 = ahead(x, &k1, 0.5 * h);
    Motion k2 = slopes(p, &x2, f);
    Motion x3 = ahead(x, &k2, 0.5 * h);
    Motion k3 = slopes(p, &x3, f);
    Motion x4 = ahead(x, &k3, h);
    Motion k4 = slopes(p, &x4, f);
    double w = h * SIXTH;
    double travelled = w * (x->speed + 2.0 * (x2.speed + x3.speed) + x4.speed);
    *new = (Motion){
        x->current + w * (k1.current + 2.0 * (k2.current + k3.current) + k4.current),
        x->voltage + w * (k1.voltage + 2.0 * (k2.voltage + k3.voltage) + k4.voltage),
        x->speed + w * (k1.speed + 2.0 * (k2.speed + k3.speed) + k4.speed),
    };
    return travelled;
}

static __attribute__((noinline)) double step_any(const MotorParameters *p, const Motion *x, Forcing f, double h,
                                                 Motion *new)
{
    return runge_kutta(p, x, f, h, new);
}

/* A step of the moving shaft: fast where the inverter is on and the iron does not saturate. */
ALWAYS_INLINE double step_moving(const MotorParameters *p, const Motion *x, Forcing f, double h, Motion *new)
{
    f.moving = 1.0;
    if (f.saturates || f.live != 1.0 || f.turning != 1.0)
        return step_any(p, x, f, h, new);
    return runge_kutta(p, x, (Forcing){.live = 1.0, .turning = 1.0, .resisting = f.resisting, .moving = 1.0}, h, new);
}

/* h seconds with Coulomb friction: the step is cut where the shaft comes to rest, and there it stays as long
   as the friction holds it. Returns the angle travelled. */
static __attribute__((noinline)) double step_with_friction(const MotorParameters *p, Motion *x, Forcing f, double load_nm,
                                                           double friction_nm, double h)
{
    Motion new;
    double travelled = 0.0;
    for (int cut = 0; cut < 4; cut++) {
        double sign;
        if (x->speed != 0.0) {
            sign = x->speed > 0.0 ? 1.0 : -1.0;
        } else {
            double net = electric_torque(p, f.saturates, x->current) - load_nm;
            if (fabs(net) <= friction_nm)
                break;
            sign = net > 0.0 ? 1.0 : -1.0;
        }
        f.resisting = load_nm + sign * friction_nm;
        double angle = step_moving(p, x, f, h, &new);
        if (new.speed * sign >= 0.0) {
            *x = new;
            return travelled + angle;
        }
        if (x->speed == 0.0)
            break;
        double fraction = x->speed / (x->speed - new.speed);
        f.moving = 1.0;
        travelled += step_any(p, x, f, fraction * h, &new);
        *x = new;
        x->speed = 0.0;
        h *= 1.0 - fraction;
    }
    f.resisting = f.moving = 0.0;
    step_any(p, x, f, h, &new);
    *x = new;
    return travelled;
}

void advance_motor(MotorState *state, const MotorParameters *p, Voltage voltage, double load_nm, double brake_nm)
{
    Forcing f = {.saturates = p->saturation.active, .live = voltage.live, .turning = voltage.turning};
    double friction_nm = p->coulomb_friction_nm + brake_nm;
    Motion x = {electric_state(state, p), {voltage.d, voltage.q}, state->speed_rad_s};
    double angle = state->angle_rad;
    for (double step = 0.0; step < p->substeps; step++) {
        if (friction_nm != 0.0) {
            angle += step_with_friction(p, &x, f, load_nm, friction_nm, p->step_s);
            continue;
        }
        f.resisting = load_nm;
        angle += step_moving(p, &x, f, p->step_s, &x);
    }
    double turned = angle * PER_TURN;
    double turns = turned >= 0.0 ? floor_of_positive(turned) : floor(turned);
    take_electric_state(state, p, x.current);
    state->speed_rad_s = x.speed;
    /* Rounding may leave the angle a hair outside of its turn. */
    state->angle_rad = least(most(angle - turns * TURN_RAD, 0.0), BELOW_TURN_RAD);
    state->turns += turns;
}
