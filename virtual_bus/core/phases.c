/* Clarke's transform and its inverse around what each phase has of its own. `amplitude`: A of a phase over A of the
   motor's transform. */
#include "phases.h"

#include <math.h>

#include "limits.h"
#include "scattered.h"

#define SQRT_3 1.7320508075688772
static const double PER_SQRT_3 = 1.0 / SQRT_3;
static const double TWO_THIRDS = 2.0 / 3.0;

typedef struct Phases {
    double a, b, c;
} Phases;

/* From the rotor's frame into the stator's: alpha and beta. */
static Pair in_stator(Pair dq, SineCosine rotor)
{
    return (Pair){rotor.cosine * dq[0] - rotor.sine * dq[1], rotor.sine * dq[0] + rotor.cosine * dq[1]};
}

static Phases phases_of(Pair stator, double amplitude)
{
    double a = amplitude * stator[0], half = 0.5 * a, across = 0.5 * SQRT_3 * amplitude * stator[1];
    return (Phases){a, across - half, -across - half};
}

/* Of variance 1: four even numbers of 16 bits, whose sum is bell-shaped up to 3.46. */
static double noise(uint64_t counter)
{
    const uint64_t evens = 0x0000FFFF0000FFFFu;
    uint64_t bits = scattered(counter), pairs = (bits & evens) + (bits >> 16 & evens);
    int64_t sum = (int64_t)((pairs & 0xFFFFFFFFu) + (pairs >> 32));
    return ((double)sum - 2.0 * 65535.0) * (SQRT_3 / 65536.0);
}

static double sensed(const CurrentSensors *p, double current_a, double scale, double offset_a, uint64_t counter)
{
    double told = scale * current_a + offset_a;
    if (p->noise_a != 0.0)
        told += p->noise_a * noise(counter);
    told = within(told, -p->range_a, p->range_a);
    return p->step_a == 0.0 ? told : p->step_a * floor(told / p->step_a + 0.5);
}

static Pair delayed(const CurrentSensors *p, SensorState *state, Pair stator)
{
    Pair before = {state->alpha_a, state->beta_a};
    state->alpha_a = stator[0];
    state->beta_a = stator[1];
    return stator + p->delay_share * (before - stator);
}

Pair sensed_current(const CurrentSensors *p, SensorState *state, Pair current, SineCosine rotor, double amplitude,
                    int64_t tick)
{
    Pair stator = in_stator(current, rotor);
    if (p->delay_share != 0.0)
        stator = delayed(p, state, stator);
    Phases phases = phases_of(stator, amplitude);
    uint64_t counter = 2 * ((uint64_t)p->seed + (uint64_t)tick);
    double a = sensed(p, phases.a, p->scale_a, p->offset_a, counter);
    double b = sensed(p, phases.b, p->scale_b, p->offset_b, counter + 1);
    double per_amplitude = 1.0 / amplitude;
    return (Pair){per_amplitude * a, per_amplitude * PER_SQRT_3 * (a + 2.0 * b)};
}

static double sign(double current_a, double band_a)
{
    if (band_a > 0.0)
        return within(current_a / band_a, -1.0, 1.0);
    return current_a > 0.0 ? 1.0 : current_a < 0.0 ? -1.0 : 0.0;
}

Pair dead_time_voltage(const Inverter *p, Pair current, SineCosine rotor, double amplitude, double link_v)
{
    Phases phases = phases_of(in_stator(current, rotor), amplitude);
    double a = sign(phases.a, p->zero_band_a), b = sign(phases.b, p->zero_band_a), c = sign(phases.c, p->zero_band_a);
    double lost_v = p->dead_share * link_v / amplitude;
    Pair stator = {-lost_v * TWO_THIRDS * (a - 0.5 * (b + c)), -lost_v * PER_SQRT_3 * (b - c)};
    return in_stator(stator, (SineCosine){-rotor.sine, rotor.cosine});
}
