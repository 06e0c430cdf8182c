/* The plant is solved exactly from switching to switching, so the step is the sampling period's and there is no
   integration error:

       e_q' = a (u - e_q)      e' = c e_q - b e + g d      q' = e

   Each run has a random stream of its own, made from the seed and its number. */
#include "random_runs.h"

#include <math.h>
#include <stdlib.h>

#include "limits.h"

/* Of b t: the series leave 1e-9 of the integrals there; the differences of doubles leave 3e-10, and 1e-7 at a
   tenth of it. */
static const double SMALL = 1e-4;
static const uint64_t GOLDEN = 0x9E3779B97F4A7C15u;

typedef struct Plant {
    double a, b, c, g;
} Plant;

typedef struct State {
    double e_q, e, q;
} State;

typedef struct Sample {
    double value;
    bool came;
} Sample;

/* The finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014). */
static uint64_t mixed(uint64_t x)
{
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9u;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
    return x ^ (x >> 31);
}

/* The next number of a stream, in [0, 1). */
static double even(uint64_t *stream)
{
    *stream += GOLDEN;
    return (double)(mixed(*stream) >> 11) * 0x1p-53;
}

/* (1 - e^{-bt})/b, with E = e^{-bt}, and its limit t for b = 0. */
static double rest(double b, double t, double E)
{
    double x = b * t;
    return x < SMALL ? t * (1.0 - x * (0.5 - x / 6.0)) : (1.0 - E) / b;
}

/* e^{-x}; friction is slow, so x nearly always is small and the series exact to rounding. */
static double decayed(double x)
{
    return x < 1e-3 ? 1.0 - x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0))) : exp(-x);
}

/* |e| where its slope, `slope` at the start, passes through zero before t. */
static double summit(State x, const Plant *p, double u, double d, double t, double slope)
{
    double low = 0.0, high = t, top = x.e;
    double off = x.e_q - u, drive = p->c * u + p->g * d;
    for (int k = 0; k < 40; k++) {
        double middle = 0.5 * (low + high);
        double E_a = exp(-p->a * middle), E_b = exp(-p->b * middle);
        top = x.e * E_b + drive * rest(p->b, middle, E_b) + p->c * off / (p->b - p->a) * (E_a - E_b);
        if (slope * (p->c * (u + off * E_a) - p->b * top + p->g * d) > 0.0)
            low = middle;
        else
            high = middle;
    }
    return fabs(top);
}

/* The state after t with u and d held; the largest |e| on the way. E_a = e^{-at}, E_b = e^{-bt}. */
static double flow(State *x, const Plant *p, double u, double d, double t, double E_a, double E_b)
{
    double a = p->a, b = p->b, c = p->c, g = p->g;
    State start = *x;
    double slope = c * start.e_q - b * start.e + g * d, off = start.e_q - u;
    double phi = rest(b, t, E_b);
    double bt = b * t;
    double psi = bt < SMALL ? t * t * (0.5 - bt / 6.0) : (t - phi) / b;
    double drive = c * u + g * d;
    double mix = c * off / (b - a);
    x->q += start.e * phi + drive * psi + mix * ((1.0 - E_a) / a - phi);
    x->e = start.e * E_b + drive * phi + mix * (E_a - E_b);
    x->e_q = u + off * E_a;
    double top = most(fabs(start.e), fabs(x->e));
    if (slope * (c * x->e_q - b * x->e + g * d) < 0.0)
        top = most(top, summit(start, p, u, d, t, slope));
    return top;
}

static double drawn(double nominal, double uncertainty, uint64_t *stream)
{
    return nominal * (1.0 + uncertainty * (2.0 * even(stream) - 1.0));
}

static Plant drawn_plant(const Figures *f, uint64_t *stream)
{
    double current_rate = drawn(f->current_rate_rad_s, f->uncertainty, stream);
    double inductance = drawn(f->inductance, f->uncertainty, stream);
    double inertia = drawn(f->inertia_kg_m2, f->uncertainty, stream);
    double friction = drawn(f->friction_nm_s, f->uncertainty, stream);
    double torque_constant = drawn(f->torque_constant_nm_a, f->uncertainty, stream);
    Plant p = {current_rate / inductance, friction / inertia, torque_constant / inertia, 1.0 / inertia};
    if (fabs(p.b - p.a) < 1e-9 * p.a)
        p.b = p.a * (1.0 - 1e-9);
    return p;
}

/* One run: largest |e|. `samples`: room for those that have not acted yet, none of which has come. */
static double run(const RandomRuns *self, uint64_t stream, Sample *samples)
{
    const Figures *f = &self->figures;
    Plant p = drawn_plant(f, &stream);
    double h = f->period_s, offset = f->offset_s, load = f->load_nm;
    double E_ah = exp(-p.a * h), E_bh = exp(-p.b * h);
    double E_ao = exp(-p.a * offset), E_bo = exp(-p.b * offset);
    State x = {0};
    double held = 0.0;
    int64_t lost = 0, room = self->behind + 1;
    /* The load steps somewhere in the first period; at rest nothing else has happened before. */
    double late = h * even(&stream), left = h - late;
    double peak = flow(&x, &p, 0.0, load, left, exp(-p.a * left), exp(-p.b * left));
    for (int64_t k = 0; k < self->steps; k++) {
        Sample *newest = &samples[k % room], *oldest = &samples[(k + 1) % room];
        newest->value = f->gains[0] * x.e_q + f->gains[1] * x.e + f->gains[2] * x.q;
        double chance = even(&stream);
        bool delivered = lost >= self->losses_max || chance >= f->loss_probability;
        lost = delivered ? 0 : lost + 1;
        newest->came = delivered || self->strategy == BY_HISTORY;
        double at = self->strategy == ON_ARRIVAL ? f->delay_max_s * even(&stream) : offset;
        if (self->strategy == ON_ARRIVAL ? !delivered : k < self->behind || !oldest->came) {
            peak = most(peak, flow(&x, &p, held, load, h, E_ah, E_bh));
        } else {
            double E_a = E_ao, E_b = E_bo;
            if (self->strategy == ON_ARRIVAL) {
                E_a = exp(-p.a * at);
                E_b = decayed(p.b * at);
            }
            peak = most(peak, flow(&x, &p, held, load, at, E_a, E_b));
            held = self->strategy == ON_ARRIVAL ? newest->value : oldest->value;
            peak = most(peak, flow(&x, &p, held, load, h - at, E_ah / E_a, E_bh / E_b));
        }
        if (!(peak < f->limit))
            return INFINITY;
    }
    return peak;
}

bool run_randomly(const RandomRuns *self, uint64_t seed, uint64_t first, int64_t count, double *peaks)
{
    Sample *samples = calloc((size_t)self->behind + 1, sizeof *samples);
    if (samples == NULL)
        return false;
    for (int64_t k = 0; k < count; k++) {
        for (int64_t slot = 0; slot <= self->behind; slot++)
            samples[slot] = (Sample){0};
        peaks[k] = run(self, mixed(mixed(seed) + first + (uint64_t)k), samples);
    }
    free(samples);
    return true;
}
