/* Two masses with a coupling between them, by Runge-Kutta, with each contact and each rest where it happens.

   The torque of the coupling is k p + d dp/dt in its deflection p, the twist beyond the backlash. A flank can
   only push: it lets go where that torque falls to zero, and takes hold again where the twist crosses the
   backlash or the torque rises anew. What is in contact and what is at rest is told by the state alone, and a
   step is cut where that changes. An end stop is such a flank, between the load and the machine's bed.

   Friction at the speed w: (c + (b - c) / (1 + (w / w_s)^2)) sign w, Coulomb's c, breakaway b: Stribeck's curve
   without an exponential, so that its bits are the same everywhere. A mass at rest stays until what pulls at it
   exceeds b. */
#include "mechanism.h"

#include <math.h>
#include <stdbool.h>

#include "limits.h"
#include "machine_equations.h"
#include "rotation.h"

static const double PER_TURN = 1.0 / TURN_RAD;
static const double BELOW_TURN_RAD = 0x1.921fb54442d17p+2; /* the next double below 2 pi */
static const double SIXTH = 1.0 / 6.0;

/* A step is cut at most so often: then it is finished as it is. */
enum { CUTS_MAX = 16 };
/* A change is found to 2^-12 of the step: 15 ns of 62.5 us. */
static const double FOUND = 0x1p-12;
enum { TRIES_MAX = 24 };

enum { ROTOR, LOAD, MASSES };

/* What a step calls four times: as calls they would cost a tenth of it. */
#define ALWAYS_INLINE static inline __attribute__((always_inline))

typedef struct Motion {
    Pair current, voltage; /* of d and q: A, and V that turn in the rotor's frame */
    double speed[MASSES];
    double angle; /* of the rotor, from the start of the period */
    double twist;
} Motion;

/* Which equations hold until the next change. */
typedef struct Phase {
    double way[MASSES]; /* 1 or -1: the friction is against that; 0: at rest */
    double flank;       /* 1 or -1: the one in contact; 0: none */
    double stop;        /* the same of the end stops */
} Phase;

typedef struct Friction {
    double forward_nm, backward_nm; /* Coulomb */
    double breakaway_more_nm;
} Friction;

/* What does not change within a period. */
typedef struct Machine {
    const MotorParameters *p;
    const Mechanism *m;
    Friction friction[MASSES];
    bool rubs[MASSES];
    bool changes; /* something can come to rest, or let go */
    bool placed;  /* the place of the load counts */
    double viscous[MASSES];
    double live, turning, load_nm, angle_rad;
    LoadSide *load;
    LoadPlace from;                    /* of the load at the start of the period */
    double twist_rad;                  /* of the coupling, there */
    double negative_rad, positive_rad; /* from there to the end stops */
} Machine;

static double friction_nm(const Machine *s, int mass, double way, double speed)
{
    const Friction *f = &s->friction[mass];
    double coulomb_nm = way > 0.0 ? f->forward_nm : f->backward_nm;
    if (f->breakaway_more_nm == 0.0)
        return coulomb_nm;
    double slip = speed * s->m->per_stribeck;
    return coulomb_nm + f->breakaway_more_nm / (1.0 + slip * slip);
}

static double cogging_nm(const Machine *s, double angle)
{
    double turns = (s->angle_rad + angle) * PER_TURN;
    double place = (turns - floor(turns)) * s->m->cogging_points;
    if (!(place < s->m->cogging_points)) /* rounded up, or no number */
        place = 0.0;
    int point = (int)place;
    double low = s->m->cogging_nm[point], high = s->m->cogging_nm[point + 1];
    return low + (place - point) * (high - low);
}

static double flank_torque(const Mechanism *m, double flank, double twist, double twisting)
{
    return m->stiffness_nm_rad * (twist - flank * m->half_backlash_rad) + m->damping_nm_s * twisting;
}

/* Of the load, from the start of the period. */
static double load_angle(const Machine *s, const Motion *x)
{
    return s->m->coupled ? x->angle - (x->twist - s->twist_rad) : x->angle;
}

static double load_speed(const Machine *s, const Motion *x) { return x->speed[s->m->coupled ? LOAD : ROTOR]; }

/* Of the load beyond an end stop, 1 or -1, towards which angles count here; negative before it. */
static double beyond_stop(const Machine *s, const Motion *x, double stop)
{
    return stop * (load_angle(s, x) - (stop > 0.0 ? s->positive_rad : s->negative_rad));
}

/* What the load's place, speed and end stop put against it, N m. */
static __attribute__((noinline)) double placed_nm(const Machine *s, const Phase *phase, const Motion *x)
{
    double torque_nm = 0.0, speed = load_speed(s, x);
    if (s->m->placed.active)
        torque_nm = placed_load_nm(&s->m->placed, &s->from, load_angle(s, x), speed);
    if (phase->stop != 0.0)
        torque_nm += phase->stop * s->m->stops.stiffness_nm_rad * beyond_stop(s, x, phase->stop)
                     + s->m->stops.damping_nm_s * speed;
    return torque_nm;
}

/* Torques on each mass but friction, N m. */
ALWAYS_INLINE void pull(const Machine *s, const Phase *phase, const Motion *x, double *net)
{
    double made = electric_torque(s->p, s->p->saturation.active, x->current), load_nm = s->load_nm;
    if (s->m->cogging_points > 0)
        made += cogging_nm(s, x->angle);
    if (s->placed)
        load_nm += placed_nm(s, phase, x);
    if (!s->m->coupled) {
        net[ROTOR] = made - load_nm - s->viscous[ROTOR] * x->speed[ROTOR];
        net[LOAD] = 0.0;
        return;
    }
    double twisting = x->speed[ROTOR] - x->speed[LOAD];
    bool free = phase->flank == 0.0 && s->m->half_backlash_rad > 0.0;
    double passed = free ? 0.0 : flank_torque(s->m, phase->flank, x->twist, twisting);
    net[ROTOR] = made - passed - s->viscous[ROTOR] * x->speed[ROTOR];
    net[LOAD] = passed - load_nm - s->viscous[LOAD] * x->speed[LOAD];
}

ALWAYS_INLINE double acceleration(const Machine *s, const Phase *phase, int mass, double speed, double net_nm,
                                  double per_inertia)
{
    if (!s->rubs[mass])
        return net_nm * per_inertia;
    double way = phase->way[mass];
    return way == 0.0 ? 0.0 : (net_nm - way * friction_nm(s, mass, way, speed)) * per_inertia;
}

ALWAYS_INLINE Motion slopes(const Machine *s, const Phase *phase, const Motion *x)
{
    double net[MASSES];
    pull(s, phase, x, net);
    double electrical = s->p->pole_pairs * x->speed[ROTOR];
    Motion k = {
        .current = current_slopes(s->p, s->p->saturation.active, x->voltage, x->current, electrical, s->live),
        .voltage = voltage_slopes(x->voltage, s->turning * electrical),
        .angle = x->speed[ROTOR],
        .twist = x->speed[ROTOR] - x->speed[LOAD],
    };
    k.speed[ROTOR] = acceleration(s, phase, ROTOR, x->speed[ROTOR], net[ROTOR], s->m->per_inertia_rotor);
    if (s->m->coupled)
        k.speed[LOAD] = acceleration(s, phase, LOAD, x->speed[LOAD], net[LOAD], s->m->per_inertia_load);
    return k;
}

/* x + h k */
ALWAYS_INLINE Motion ahead(const Motion *x, const Motion *k, double h)
{
    return (Motion){
        .current = x->current + h * k->current,
        .voltage = x->voltage + h * k->voltage,
        .speed = {x->speed[ROTOR] + h * k->speed[ROTOR], x->speed[LOAD] + h * k->speed[LOAD]},
        .angle = x->angle + h * k->angle,
        .twist = x->twist + h * k->twist,
    };
}

/* One classical step of fourth order, h seconds. */
static Motion runge_kutta(const Machine *s, const Phase *phase, const Motion *x, double h)
{
    Motion k1 = slopes(s, phase, x);
    Motion x2 = ahead(x, &k1, 0.5 * h);
    Motion k2 = slopes(s, phase, &x2);
    Motion x3 = ahead(x, &k2, 0.5 * h);
    Motion k3 = slopes(s, phase, &x3);
    Motion x4 = ahead(x, &k3, h);
    Motion k4 = slopes(s, phase, &x4);
    Motion sum = ahead(&k2, &k3, 1.0);
    Motion ends = ahead(&k1, &k4, 1.0);
    sum = ahead(&ends, &sum, 2.0);
    return ahead(x, &sum, h * SIXTH);
}

/* How far a flank or a stop is pressed in, rad, where it takes hold: what it is beyond, once that grows or where
   the spring pushes harder than the damper pulls. `rate`: at which it is pressed in. */
static double hold_rad(double beyond, double rate, double yield_s) { return beyond + yield_s * least(0.0, rate); }

static double flank_hold_rad(const Mechanism *m, double flank, const Motion *x)
{
    double rate = flank * (x->speed[ROTOR] - x->speed[LOAD]);
    return hold_rad(flank * x->twist - m->half_backlash_rad, rate, m->yield_s);
}

static double stop_hold_rad(const Machine *s, double stop, const Motion *x)
{
    return hold_rad(beyond_stop(s, x, stop), stop * load_speed(s, x), s->m->stops.yield_s);
}

/* By how much the friction at rest exceeds what pulls at a mass. */
static double hold_nm(const Machine *s, const Phase *phase, const Motion *x, int mass)
{
    double net[MASSES];
    pull(s, phase, x, net);
    return friction_nm(s, mass, net[mass] > 0.0 ? 1.0 : -1.0, 0.0) - fabs(net[mass]);
}

/* 0: it stays at rest. */
static double way_from_rest(const Machine *s, const Phase *phase, const Motion *x, int mass)
{
    double net[MASSES];
    if (hold_nm(s, phase, x, mass) >= 0.0)
        return 0.0;
    pull(s, phase, x, net);
    return net[mass] > 0.0 ? 1.0 : -1.0;
}

/* The equations that hold at x. */
static Phase phase_at(const Machine *s, const Motion *x)
{
    Phase phase = {{0.0, 0.0}, 0.0, 0.0};
    if (s->m->coupled && s->m->half_backlash_rad > 0.0) {
        double flank = x->twist > 0.0 ? 1.0 : -1.0;
        phase.flank = flank_hold_rad(s->m, flank, x) >= 0.0 ? flank : 0.0;
    }
    if (s->m->stops.active)
        phase.stop = stop_hold_rad(s, 1.0, x) >= 0.0 ? 1.0 : stop_hold_rad(s, -1.0, x) >= 0.0 ? -1.0 : 0.0;
    for (int mass = ROTOR; mass <= s->m->coupled; mass++) {
        phase.way[mass] = x->speed[mass] > 0.0 ? 1.0 : -1.0;
        if (x->speed[mass] == 0.0 && s->rubs[mass])
            phase.way[mass] = way_from_rest(s, &phase, x, mass);
    }
    return phase;
}

/* Negative once the phase is over at x; which one of its parts ended is in the state. */
static double margin(const Machine *s, const Phase *phase, const Motion *x)
{
    double least_yet = INFINITY;
    if (s->m->coupled && s->m->half_backlash_rad > 0.0) {
        double flank = phase->flank, twisting = x->speed[ROTOR] - x->speed[LOAD];
        if (flank != 0.0)
            least_yet = flank * x->twist - s->m->half_backlash_rad + s->m->yield_s * flank * twisting;
        else
            least_yet = -most(flank_hold_rad(s->m, 1.0, x), flank_hold_rad(s->m, -1.0, x));
    }
    if (s->m->stops.active) {
        double stop = phase->stop;
        if (stop != 0.0)
            least_yet =
                least(least_yet, beyond_stop(s, x, stop) + s->m->stops.yield_s * stop * load_speed(s, x));
        else
            least_yet = least(least_yet, -most(stop_hold_rad(s, 1.0, x), stop_hold_rad(s, -1.0, x)));
    }
    for (int mass = ROTOR; mass <= s->m->coupled; mass++) {
        if (s->rubs[mass]) {
            double way = phase->way[mass];
            least_yet = least(least_yet, way != 0.0 ? way * x->speed[mass] : hold_nm(s, phase, x, mass));
        }
    }
    return least_yet;
}

/* The length of a step from x that ends just beyond the phase's end, which comes within h; `over`: the margin
   there. By secants, each weighed towards the bound that stood still, and halves where the start has no margin. */
static double length_of_phase(const Machine *s, const Phase *phase, const Motion *x, double h, double over)
{
    double low = 0.0, high = h;
    double at_low = margin(s, phase, x), at_high = over;
    for (int tries = 0; tries < TRIES_MAX && high - low > FOUND * h; tries++) {
        double length = 0.5 * (low + high);
        if (at_low > 0.0) {
            double share = at_low / (at_low - at_high);
            length = low + within(share, 0.25 * FOUND, 1.0 - 0.25 * FOUND) * (high - low);
        }
        Motion there = runge_kutta(s, phase, x, length);
        double found = margin(s, phase, &there);
        if (found < 0.0) {
            high = length;
            at_high = found;
            at_low *= 0.5;
        } else {
            low = length;
            at_low = found;
            at_high *= 0.5;
        }
    }
    return high;
}

/* For who asks whether a stop was hit. */
static void note_stop(LoadSide *load, double stop, double speed)
{
    if (stop != 0.0 && load->stop == 0.0) {
        load->hits += 1.0;
        load->hit_rad_s = speed;
    }
    load->stop = stop;
}

static void substep(const Machine *s, Motion *x, double h)
{
    if (!s->changes) {
        Phase only = {{0.0, 0.0}, 0.0, 0.0};
        *x = runge_kutta(s, &only, x, h);
        return;
    }
    for (int cut = 0; h > 0.0; cut++) {
        Phase phase = phase_at(s, x);
        if (s->m->stops.active)
            note_stop(s->load, phase.stop, load_speed(s, x));
        Motion new = runge_kutta(s, &phase, x, h);
        double over = margin(s, &phase, &new);
        double length = h;
        if (over < 0.0 && cut < CUTS_MAX) {
            length = length_of_phase(s, &phase, x, h, over);
            new = runge_kutta(s, &phase, x, length);
        }
        *x = new;
        for (int mass = ROTOR; mass <= s->m->coupled; mass++) {
            if (s->rubs[mass] && phase.way[mass] * x->speed[mass] < 0.0)
                x->speed[mass] = 0.0;
        }
        h -= length;
    }
}

static Machine machine_of(const MotorParameters *p, const Mechanism *m, double brake_nm)
{
    int side = m->coupled && m->friction_on_load ? LOAD : ROTOR;
    Machine s = {.p = p, .m = m};
    s.friction[ROTOR].forward_nm = s.friction[ROTOR].backward_nm = brake_nm;
    s.friction[side].forward_nm += p->coulomb_friction_nm;
    s.friction[side].backward_nm += p->coulomb_friction_nm + m->backward_more_nm;
    s.friction[side].breakaway_more_nm = m->breakaway_more_nm;
    s.viscous[side] = p->viscous_friction_nm_s;
    for (int mass = ROTOR; mass < MASSES; mass++) {
        const Friction *f = &s.friction[mass];
        s.rubs[mass] = f->forward_nm != 0.0 || f->backward_nm != 0.0 || f->breakaway_more_nm != 0.0;
    }
    s.placed = m->placed.active || m->stops.active;
    s.changes = s.rubs[ROTOR] || s.rubs[LOAD] || (m->coupled && m->half_backlash_rad > 0.0) || m->stops.active;
    return s;
}

static void place_load(Machine *s, const MotorState *state, LoadSide *load)
{
    s->load = load;
    s->twist_rad = s->m->coupled ? load->twist_rad : 0.0;
    double ahead_rad = state->angle_rad - s->twist_rad; /* of the turns */
    s->from = place_of(&s->m->placed, state->turns + ahead_rad * PER_TURN);
    s->negative_rad = (s->m->stops.negative_turns - state->turns) * TURN_RAD - ahead_rad;
    s->positive_rad = (s->m->stops.positive_turns - state->turns) * TURN_RAD - ahead_rad;
}

/* One period of the motor and what it turns. */
void advance_machine(MotorState *state, LoadSide *load, const MotorParameters *p, const Mechanism *mechanism,
                     Voltage voltage, double load_nm, double brake_nm)
{
    if (!mechanism->active) {
        advance_motor(state, p, voltage, load_nm, brake_nm);
        return;
    }
    Machine s = machine_of(p, mechanism, brake_nm);
    s.live = voltage.live;
    s.turning = voltage.turning;
    s.load_nm = load_nm;
    s.angle_rad = state->angle_rad;
    if (s.placed)
        place_load(&s, state, load);
    Motion x = {
        .current = electric_state(state, p),
        .voltage = {voltage.d, voltage.q},
        .speed = {state->speed_rad_s, load->speed_rad_s},
        .twist = load->twist_rad,
    };
    for (int step = 0; step < (int)p->substeps; step++)
        substep(&s, &x, p->step_s);
    double angle = state->angle_rad + x.angle;
    double turns = floor(angle * PER_TURN);
    take_electric_state(state, p, x.current);
    state->speed_rad_s = x.speed[ROTOR];
    load->speed_rad_s = mechanism->coupled ? x.speed[LOAD] : x.speed[ROTOR];
    load->twist_rad = mechanism->coupled ? x.twist : 0.0;
    /* Rounding may leave the angle a hair outside of its turn. */
    state->angle_rad = least(most(angle - turns * TURN_RAD, 0.0), BELOW_TURN_RAD);
    state->turns += turns;
}
