/* Two masses with a coupling between them, by Runge-Kutta, with each contact and each rest where it happens.

   The torque of the coupling is k p + d dp/dt in its deflection p, the twist beyond the backlash. A flank can
   only push: it lets go where that torque falls to zero, and takes hold again where the twist crosses the
   backlash or the torque rises anew. What is in contact and what is at rest is told by the state alone, and a
   step is cut where that changes. An end stop is such a flank, between the load and the machine's bed.

   Friction at the speed w: (c + (b - c) / (1 + (w / w_s)^2)) sign w, Coulomb's c, breakaway b: Stribeck's curve
   without an exponential, so that its bits are the same everywhere. A mass at rest stays until what pulls at it
   exceeds b. With bristles (LuGre) that curve, g, is what they bear while they slip:
   dz/dt = w - k |w| / g(w) z, friction k z + d dz/dt; then nothing rests, and no step is cut for it. */
#include "mechanism.h"

#include <math.h>
#include <stdbool.h>

#include "limits.h"
#include "machine_equations.h"
#include "rotation.h"

static const double PER_TURN = 1.0 / TURN_RAD;
static const double BELOW_TURN_RAD = 0x1.921fb54442d17p+2; /* the next double below 2 pi */
static const double SIXTH = 1.0 / 6.0, THIRD = 1.0 / 3.0, TWO_THIRDS = 2.0 / 3.0;

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
    Pair speed;            /* of rotor and load */
    Pair place;            /* angle of the rotor, from the start of the period; twist */
} Motion;

enum { ANGLE, TWIST };

/* Which equations hold until the next change. */
typedef struct Phase {
    double way[MASSES]; /* 1 or -1: the friction is against that; 0: at rest */
    double flank;       /* 1 or -1: the one in contact; 0: none */
    double stop;        /* the same of the end stops */
    /* What follows of these. */
    Pair rub_nm, falling_nm; /* friction against the way: Coulomb's, and what breakaway is above it */
    Pair per_inertia;        /* 0: at rest */
    double stiffness_nm_rad, damping_nm_s, flank_rad;
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
    bool bristles; /* of the mass `brushed`; they bear `bristled` */
    int brushed;
    Friction bristled;
    bool changes; /* something can come to rest, or let go */
    bool falls;   /* friction with the speed */
    bool placed;  /* the place of the load asks for a torque, or its end stops do */
    bool sited;   /* where rotor and load are, a torque depends on */
    Pair viscous, per_inertia, load_nm;
    double live, turning, angle_rad;
    LoadSide *load;
    double turns;                      /* of the load at the start of the period */
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

/* The angle of the rotor is within a turn at the start of a period, and seldom far beyond it at the end. */
static double cogging_nm(const Machine *s, double angle)
{
    double points = s->m->cogging_points, place = (s->angle_rad + angle) * s->m->cogging_per_rad;
    if (!(place >= 0.0 && place < points)) {
        double turns = place / points;
        place = (turns - floor(turns)) * points;
        if (!(place < points)) /* rounded up, or no number */
            place = 0.0;
    }
    int point = (int)place;
    double low = s->m->cogging_nm[point], high = s->m->cogging_nm[point + 1];
    return low + (place - point) * (high - low);
}

/* Of the load, from the start of the period. */
static double load_angle(const Machine *s, const Motion *x)
{
    return s->m->coupled ? x->place[ANGLE] - (x->place[TWIST] - s->twist_rad) : x->place[ANGLE];
}

static double load_speed(const Machine *s, const Motion *x) { return x->speed[s->m->coupled ? LOAD : ROTOR]; }

/* Of the load beyond an end stop, 1 or -1, towards which angles count here; negative before it. */
static double beyond_stop(const Machine *s, const Motion *x, double stop)
{
    return stop * (load_angle(s, x) - (stop > 0.0 ? s->positive_rad : s->negative_rad));
}

/* Onto rotor and load, N m. */
static Pair onto(const Machine *s, double rotor_nm, double load_nm)
{
    return s->m->coupled ? (Pair){rotor_nm, load_nm} : (Pair){rotor_nm + load_nm, 0.0};
}

/* What goes by the places of rotor and load, and by the speed of a load in a table. */
typedef struct Sited {
    double cogs_nm;     /* of the rotor */
    Asked asked;        /* of the load */
    double bristle_rad; /* of the friction: goes by all the way before */
} Sited;

/* At an angle of the rotor and one of the load, both from the start of the period. */
static Sited sited_at(const Machine *s, double angle, double load_rad, double load_rad_s)
{
    Sited sited = {0};
    if (s->m->cogging_points > 0)
        sited.cogs_nm = cogging_nm(s, angle);
    if (s->m->placed.active)
        sited.asked = placed_load(&s->m->placed, &s->load->place, s->turns + load_rad * PER_TURN, load_rad_s);
    return sited;
}

static double asked_nm(const Machine *s, const Sited *sited)
{
    return sited->asked.rest_nm + s->m->placed.arm_nm * sited->asked.arm_sine;
}

static Pair sited_nm(const Machine *s, const Sited *sited) { return onto(s, sited->cogs_nm, -asked_nm(s, sited)); }

/* How fast bent bristles slip at a speed, 1/s: what they bear is never 0. */
static double slipping(const Machine *s, double speed)
{
    const Friction *f = &s->bristled;
    double slip = speed * s->m->per_stribeck, coulomb_nm = speed > 0.0 ? f->forward_nm : f->backward_nm;
    return s->m->bristle_nm_rad * fabs(speed) / (coulomb_nm + f->breakaway_more_nm / (1.0 + slip * slip));
}

/* By which bristles are bent after h seconds at a mean speed: the exponential of their equation as a ratio of
   polynomials, which is stable however fast they slip. */
static double bent(const Machine *s, double bristle_rad, double speed, double h)
{
    double x = slipping(s, speed) * h;
    double rest = (1.0 - THIRD * x) * bristle_rad + (1.0 + SIXTH * x) * h * speed;
    return rest / (1.0 + x * (TWO_THIRDS + SIXTH * x));
}

/* Torques with what bristles bent so far bear. */
static Pair brushed_nm(const Machine *s, Pair sited, double bristle_rad, const Motion *x)
{
    double speed = x->speed[s->brushed], bends = speed - slipping(s, speed) * bristle_rad;
    sited[s->brushed] -= s->m->bristle_nm_rad * bristle_rad + s->m->bristle_nm_s * bends;
    return sited;
}

/* Of the end stop that the load is at. */
static __attribute__((noinline)) Pair stop_nm(const Machine *s, const Phase *phase, const Motion *x)
{
    double torque_nm = phase->stop * s->m->stops.stiffness_nm_rad * beyond_stop(s, x, phase->stop)
                       + s->m->stops.damping_nm_s * load_speed(s, x);
    return onto(s, 0.0, -torque_nm);
}

/* Torques on rotor and load but friction, N m. `sited`: those of their places. */
ALWAYS_INLINE Pair pull(const Machine *s, const Phase *phase, const Motion *x, Pair sited, bool saturates)
{
    double made = electric_torque(s->p, saturates, x->current), twisting = x->speed[ROTOR] - x->speed[LOAD];
    double passed = phase->stiffness_nm_rad * (x->place[TWIST] - phase->flank_rad) + phase->damping_nm_s * twisting;
    Pair net = sited + (Pair){made - passed, passed} - s->load_nm - s->viscous * x->speed;
    return phase->stop == 0.0 ? net : net + stop_nm(s, phase, x);
}

ALWAYS_INLINE Pair acceleration(const Machine *s, const Phase *phase, const Motion *x, Pair sited, bool saturates)
{
    Pair net = pull(s, phase, x, sited, saturates) - phase->rub_nm;
    if (s->falls) {
        Pair slip = x->speed * s->m->per_stribeck;
        net -= phase->falling_nm / (1.0 + slip * slip);
    }
    return net * phase->per_inertia;
}

ALWAYS_INLINE Motion slopes(const Machine *s, const Phase *phase, const Motion *x, Pair sited, bool saturates)
{
    double electrical = s->p->pole_pairs * x->speed[ROTOR];
    return (Motion){
        .current = current_slopes(s->p, saturates, x->voltage, x->current, electrical, s->live),
        .voltage = voltage_slopes(x->voltage, s->turning * electrical),
        .speed = acceleration(s, phase, x, sited, saturates),
        .place = {x->speed[ROTOR], x->speed[ROTOR] - x->speed[LOAD]},
    };
}

/* Torques of the places at the start of a step, in its middle and at its end, N m. */
typedef struct Sites {
    Pair start, middle, end;
} Sites;

/* Of a step from x, h seconds, where a parabola has rotor and load: what that leaves out of their way is of third order.
   `sited`: those at the start, then at the end. */
static __attribute__((noinline)) void look_ahead(const Machine *s, const Phase *phase, const Motion *x, double h,
                                                 Sited *sited, Sites *sites)
{
    Sited from = *sited, middle = {0};
    sites->start = sited_nm(s, &from);
    Pair start = s->bristles ? brushed_nm(s, sites->start, from.bristle_rad, x) : sites->start;
    Pair faster = acceleration(s, phase, x, start, s->p->saturation.active);
    Pair way = h * (x->speed + 0.5 * h * faster), half = 0.5 * h * (x->speed + 0.25 * h * faster);
    int last = s->m->coupled ? LOAD : ROTOR;
    double load_rad = load_angle(s, x);
    *sited = sited_at(s, x->place[ANGLE] + way[ROTOR], load_rad + way[last], x->speed[last] + h * faster[last]);
    if (s->m->cogging_points > 0)
        middle.cogs_nm = cogging_nm(s, x->place[ANGLE] + half[ROTOR]);
    if (s->m->placed.active)
        middle.asked = asked_between(&s->m->placed, from.asked, sited->asked, way[last], half[last]);
    sites->middle = sited_nm(s, &middle);
    sites->end = sited_nm(s, sited);
}

/* x + h k */
ALWAYS_INLINE Motion ahead(const Motion *x, const Motion *k, double h)
{
    return (Motion){
        .current = x->current + h * k->current,
        .voltage = x->voltage + h * k->voltage,
        .speed = x->speed + h * k->speed,
        .place = x->place + h * k->place,
    };
}

/* x + h times the mean of Runge's and Kutta's slopes */
ALWAYS_INLINE Motion after(const Motion *x, const Motion k[4], double h)
{
    double w = h * SIXTH;
    return (Motion){
        .current = x->current + w * (k[0].current + 2.0 * (k[1].current + k[2].current) + k[3].current),
        .voltage = x->voltage + w * (k[0].voltage + 2.0 * (k[1].voltage + k[2].voltage) + k[3].voltage),
        .speed = x->speed + w * (k[0].speed + 2.0 * (k[1].speed + k[2].speed) + k[3].speed),
        .place = x->place + w * (k[0].place + 2.0 * (k[1].place + k[2].place) + k[3].place),
    };
}

/* One classical step of fourth order, h seconds. */
ALWAYS_INLINE void step_of(const Machine *s, const Phase *phase, const Motion *x, double h, const Sites *sites,
                           bool saturates, Motion *new)
{
    Motion k[4];
    k[0] = slopes(s, phase, x, sites->start, saturates);
    Motion x2 = ahead(x, &k[0], 0.5 * h);
    k[1] = slopes(s, phase, &x2, sites->middle, saturates);
    Motion x3 = ahead(x, &k[1], 0.5 * h);
    k[2] = slopes(s, phase, &x3, sites->middle, saturates);
    Motion x4 = ahead(x, &k[2], h);
    k[3] = slopes(s, phase, &x4, sites->end, saturates);
    *new = after(x, k, h);
}

/* The same with bristles: at each stage they are as bent as the speed up to there makes them. Returns by how much at
   the end. */
static __attribute__((noinline)) double step_brushed(const Machine *s, const Phase *phase, const Motion *x, double h,
                                                     const Sites *sites, double bristle_rad, Motion *new)
{
    bool saturates = s->p->saturation.active;
    int mass = s->brushed;
    double speed = x->speed[mass];
    Motion k[4];
    k[0] = slopes(s, phase, x, brushed_nm(s, sites->start, bristle_rad, x), saturates);
    Motion x2 = ahead(x, &k[0], 0.5 * h);
    double half_rad = bent(s, bristle_rad, 0.5 * (speed + x2.speed[mass]), 0.5 * h);
    k[1] = slopes(s, phase, &x2, brushed_nm(s, sites->middle, half_rad, &x2), saturates);
    Motion x3 = ahead(x, &k[1], 0.5 * h);
    half_rad = bent(s, bristle_rad, 0.5 * (speed + x3.speed[mass]), 0.5 * h);
    k[2] = slopes(s, phase, &x3, brushed_nm(s, sites->middle, half_rad, &x3), saturates);
    Motion x4 = ahead(x, &k[2], h);
    double end_rad = bent(s, bristle_rad, x3.speed[mass], h);
    k[3] = slopes(s, phase, &x4, brushed_nm(s, sites->end, end_rad, &x4), saturates);
    *new = after(x, k, h);
    return bent(s, bristle_rad, SIXTH * (speed + 4.0 * x3.speed[mass] + new->speed[mass]), h);
}

static __attribute__((noinline)) void runge_kutta(const Machine *s, const Phase *phase, const Motion *x, double h,
                                                  Sited *sited, Motion *new)
{
    Sites sites = {{0.0, 0.0}, {0.0, 0.0}, {0.0, 0.0}};
    double bristle_rad = sited->bristle_rad;
    if (s->sited)
        look_ahead(s, phase, x, h, sited, &sites);
    if (s->bristles)
        sited->bristle_rad = step_brushed(s, phase, x, h, &sites, bristle_rad, new);
    else if (s->p->saturation.active)
        step_of(s, phase, x, h, &sites, true, new);
    else
        step_of(s, phase, x, h, &sites, false, new);
}

/* How far a flank or a stop is pressed in, rad, where it takes hold: what it is beyond, once that grows or where
   the spring pushes harder than the damper pulls. `rate`: at which it is pressed in. */
static double hold_rad(double beyond, double rate, double yield_s) { return beyond + yield_s * least(0.0, rate); }

static double flank_hold_rad(const Mechanism *m, double flank, const Motion *x)
{
    double rate = flank * (x->speed[ROTOR] - x->speed[LOAD]);
    return hold_rad(flank * x->place[TWIST] - m->half_backlash_rad, rate, m->yield_s);
}

static double stop_hold_rad(const Machine *s, double stop, const Motion *x)
{
    return hold_rad(beyond_stop(s, x, stop), stop * load_speed(s, x), s->m->stops.yield_s);
}

/* What pulls at a mass at rest. `sited`: at x. */
static double pull_nm(const Machine *s, const Phase *phase, const Motion *x, const Sited *sited, int mass)
{
    Pair places = sited_nm(s, sited);
    if (s->bristles)
        places = brushed_nm(s, places, sited->bristle_rad, x);
    return pull(s, phase, x, places, s->p->saturation.active)[mass];
}

/* By how much the friction at rest exceeds what pulls at a mass. */
static double hold_nm(const Machine *s, int mass, double pull_nm)
{
    return friction_nm(s, mass, pull_nm > 0.0 ? 1.0 : -1.0, 0.0) - fabs(pull_nm);
}

static void touch(const Machine *s, Phase *phase, const Motion *x)
{
    if (s->m->half_backlash_rad > 0.0) {
        double flank = x->place[TWIST] > 0.0 ? 1.0 : -1.0;
        if (flank_hold_rad(s->m, flank, x) < 0.0)
            return;
        phase->flank = flank;
        phase->flank_rad = flank * s->m->half_backlash_rad;
    }
    phase->stiffness_nm_rad = s->m->stiffness_nm_rad;
    phase->damping_nm_s = s->m->damping_nm_s;
}

/* What friction does to a mass. */
typedef struct Rubbing {
    double way, rub_nm, falling_nm, per_inertia;
} Rubbing;

static Rubbing rubbing(const Machine *s, const Phase *phase, const Motion *x, const Sited *sited, int mass,
                       double speed, double per_inertia)
{
    double way = speed > 0.0 ? 1.0 : -1.0;
    if (!s->rubs[mass])
        return (Rubbing){way, 0.0, 0.0, per_inertia};
    if (speed == 0.0) {
        double pulled_nm = pull_nm(s, phase, x, sited, mass);
        if (hold_nm(s, mass, pulled_nm) >= 0.0)
            return (Rubbing){0.0, 0.0, 0.0, 0.0};
        way = pulled_nm > 0.0 ? 1.0 : -1.0;
    }
    const Friction *f = &s->friction[mass];
    return (Rubbing){way, way > 0.0 ? f->forward_nm : -f->backward_nm, way * f->breakaway_more_nm, per_inertia};
}

/* The equations that hold at x. */
static void set_phase(Phase *phase, const Machine *s, const Motion *x, const Sited *sited)
{
    phase->flank = phase->stop = phase->flank_rad = phase->stiffness_nm_rad = phase->damping_nm_s = 0.0;
    if (s->m->coupled)
        touch(s, phase, x);
    if (s->m->stops.active)
        phase->stop = stop_hold_rad(s, 1.0, x) >= 0.0 ? 1.0 : stop_hold_rad(s, -1.0, x) >= 0.0 ? -1.0 : 0.0;
    phase->rub_nm = phase->falling_nm = (Pair){0.0, 0.0};
    phase->per_inertia = s->per_inertia;
    phase->way[ROTOR] = phase->way[LOAD] = 0.0;
    if (s->rubs[ROTOR] || s->rubs[LOAD]) {
        Rubbing rotor = rubbing(s, phase, x, sited, ROTOR, x->speed[ROTOR], s->per_inertia[ROTOR]);
        Rubbing load = rubbing(s, phase, x, sited, LOAD, x->speed[LOAD], s->per_inertia[LOAD]);
        phase->way[ROTOR] = rotor.way;
        phase->way[LOAD] = load.way;
        phase->rub_nm = (Pair){rotor.rub_nm, load.rub_nm};
        phase->falling_nm = (Pair){rotor.falling_nm, load.falling_nm};
        phase->per_inertia = (Pair){rotor.per_inertia, load.per_inertia};
    }
}

/* Negative once the phase is over at x; which one of its parts ended is in the state. */
static double margin(const Machine *s, const Phase *phase, const Motion *x, const Sited *sited)
{
    double least_yet = INFINITY;
    if (s->m->coupled && s->m->half_backlash_rad > 0.0) {
        double flank = phase->flank, twisting = x->speed[ROTOR] - x->speed[LOAD];
        if (flank != 0.0)
            least_yet = flank * x->place[TWIST] - s->m->half_backlash_rad + s->m->yield_s * flank * twisting;
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
            double left = way != 0.0 ? way * x->speed[mass] : hold_nm(s, mass, pull_nm(s, phase, x, sited, mass));
            least_yet = least(least_yet, left);
        }
    }
    return least_yet;
}

/* The length of a step from x that ends just beyond the phase's end, which comes within h; `over`: the margin
   there. By secants, each weighed towards the bound that stood still, and halves where the start has no margin. */
static double length_of_phase(const Machine *s, const Phase *phase, const Motion *x, const Sited *sited, double h,
                              double over)
{
    double low = 0.0, high = h;
    double at_low = margin(s, phase, x, sited), at_high = over;
    for (int tries = 0; tries < TRIES_MAX && high - low > FOUND * h; tries++) {
        double length = 0.5 * (low + high);
        if (at_low > 0.0) {
            double share = at_low / (at_low - at_high);
            length = low + within(share, 0.25 * FOUND, 1.0 - 0.25 * FOUND) * (high - low);
        }
        Sited there_sited = *sited;
        Motion there;
        runge_kutta(s, phase, x, length, &there_sited, &there);
        double found = margin(s, phase, &there, &there_sited);
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

static void substep(const Machine *s, Motion *x, Sited *sited, double h)
{
    if (!s->changes) {
        Phase only;
        set_phase(&only, s, x, sited);
        runge_kutta(s, &only, x, h, sited, x);
        return;
    }
    for (int cut = 0; h > 0.0; cut++) {
        Phase phase;
        set_phase(&phase, s, x, sited);
        if (s->m->stops.active)
            note_stop(s->load, phase.stop, load_speed(s, x));
        Sited before = *sited;
        Motion new;
        runge_kutta(s, &phase, x, h, sited, &new);
        double over = margin(s, &phase, &new, sited);
        double length = h;
        if (over < 0.0 && cut < CUTS_MAX) {
            length = length_of_phase(s, &phase, x, &before, h, over);
            *sited = before;
            runge_kutta(s, &phase, x, length, sited, &new);
        }
        *x = new;
        for (int mass = ROTOR; mass <= s->m->coupled; mass++) {
            if (s->rubs[mass] && phase.way[mass] * x->speed[mass] < 0.0)
                x->speed[mass] = 0.0;
        }
        h -= length;
    }
}

/* What rubs on rotor and load. `brake_nm`: on the rotor; `rubs_nm`: by what the load asks. */
static void rub(Machine *s, double brake_nm, double rubs_nm, int side)
{
    const MotorParameters *p = s->p;
    const Mechanism *m = s->m;
    s->friction[ROTOR] = (Friction){brake_nm, brake_nm, 0.0};
    s->friction[LOAD] = (Friction){0.0, 0.0, 0.0};
    s->brushed = side;
    s->bristled = (Friction){0.0, 0.0, 0.0};
    Friction *f = s->bristles ? &s->bristled : &s->friction[side];
    f->forward_nm += p->coulomb_friction_nm;
    f->backward_nm += p->coulomb_friction_nm + m->backward_more_nm;
    f->breakaway_more_nm = m->breakaway_more_nm;
    f->forward_nm += rubs_nm;
    f->backward_nm += rubs_nm;
    for (int mass = ROTOR; mass < MASSES; mass++) {
        f = &s->friction[mass];
        s->rubs[mass] = f->forward_nm != 0.0 || f->backward_nm != 0.0 || f->breakaway_more_nm != 0.0;
    }
}

static void make_machine(Machine *s, const MotorParameters *p, const Mechanism *m, double load_nm, double brake_nm)
{
    double viscous = p->viscous_friction_nm_s;
    bool on_load = m->coupled && m->friction_on_load, placed = m->placed.active, stops = m->stops.active;
    s->p = p;
    s->m = m;
    s->per_inertia = (Pair){m->per_inertia_rotor, m->coupled ? m->per_inertia_load : 0.0};
    s->viscous = on_load ? (Pair){0.0, viscous} : (Pair){viscous, 0.0};
    s->load_nm = onto(s, 0.0, load_nm);
    s->rubs[ROTOR] = s->rubs[LOAD] = false;
    s->bristles = m->bristle_nm_rad != 0.0;
    double rubs_nm = 0.0;
    if (m->rubs_per_load != 0.0) {
        const Sited at = {.cogs_nm = s->load->cogs_nm, .asked = s->load->asked}; /* of the last period's end */
        rubs_nm = m->rubs_per_load * fabs(load_nm + asked_nm(s, &at));
    }
    if (brake_nm != 0.0 || p->coulomb_friction_nm != 0.0 || m->backward_more_nm != 0.0 || m->breakaway_more_nm != 0.0
        || rubs_nm != 0.0)
        rub(s, brake_nm, rubs_nm, on_load ? LOAD : ROTOR);
    s->falls = m->breakaway_more_nm != 0.0;
    s->placed = placed || stops;
    s->sited = placed || m->cogging_points > 0;
    s->changes = s->rubs[ROTOR] || s->rubs[LOAD] || (m->coupled && m->half_backlash_rad > 0.0) || stops;
}

static void place_load(Machine *s, const MotorState *state)
{
    s->twist_rad = s->m->coupled ? s->load->twist_rad : 0.0;
    double ahead_rad = state->angle_rad - s->twist_rad; /* of the turns */
    s->turns = state->turns + ahead_rad * PER_TURN;
    s->negative_rad = (s->m->stops.negative_turns - state->turns) * TURN_RAD - ahead_rad;
    s->positive_rad = (s->m->stops.positive_turns - state->turns) * TURN_RAD - ahead_rad;
}

/* As it was at the end of the last period, if rotor and load are where they were then. */
static Sited sited_at_start(const Machine *s, const MotorState *state, const Motion *x)
{
    const LoadSide *load = s->load;
    if (load->sited != 0.0 && load->sited_rad == state->angle_rad && load->sited_turns == state->turns
        && load->sited_rad_s == x->speed[ROTOR])
        return (Sited){.cogs_nm = load->cogs_nm, .asked = load->asked};
    return sited_at(s, 0.0, 0.0, load_speed(s, x));
}

static void keep_sited(LoadSide *load, const MotorState *state, const Sited *sited)
{
    load->sited = 1.0;
    load->sited_rad = state->angle_rad;
    load->sited_turns = state->turns;
    load->sited_rad_s = state->speed_rad_s;
    load->cogs_nm = sited->cogs_nm;
    load->asked = sited->asked;
}

/* One period of the motor and what it turns. */
void advance_machine(MotorState *state, LoadSide *load, const MotorParameters *p, const Mechanism *mechanism,
                     Voltage voltage, double load_nm, double brake_nm)
{
    if (!mechanism->active) {
        advance_motor(state, p, voltage, load_nm, brake_nm);
        return;
    }
    Machine s;
    s.load = load;
    make_machine(&s, p, mechanism, load_nm, brake_nm);
    s.live = voltage.live;
    s.turning = voltage.turning;
    s.angle_rad = state->angle_rad;
    if (s.placed)
        place_load(&s, state);
    Motion x = {
        .current = electric_state(state, p),
        .voltage = {voltage.d, voltage.q},
        .speed = {state->speed_rad_s, load->speed_rad_s},
        .place = {0.0, load->twist_rad},
    };
    Sited sited = {0};
    if (s.sited)
        sited = sited_at_start(&s, state, &x);
    sited.bristle_rad = load->bristle_rad;
    for (int step = 0; step < (int)p->substeps; step++)
        substep(&s, &x, &sited, p->step_s);
    double angle = state->angle_rad + x.place[ANGLE];
    double turned = angle * PER_TURN;
    double turns = turned >= 0.0 ? floor_of_positive(turned) : floor(turned);
    take_electric_state(state, p, x.current);
    state->speed_rad_s = x.speed[ROTOR];
    load->speed_rad_s = mechanism->coupled ? x.speed[LOAD] : x.speed[ROTOR];
    load->twist_rad = mechanism->coupled ? x.place[TWIST] : 0.0;
    load->bristle_rad = sited.bristle_rad;
    /* Rounding may leave the angle a hair outside of its turn. */
    state->angle_rad = least(most(angle - turns * TURN_RAD, 0.0), BELOW_TURN_RAD);
    state->turns += turns;
    if (s.sited)
        keep_sited(load, state, &sited);
}
