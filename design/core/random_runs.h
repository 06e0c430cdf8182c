/* Runs of the sampled loop with random losses, delays and plants. */
#ifndef CORE_RANDOM_RUNS_H
#define CORE_RANDOM_RUNS_H

#include <stdbool.h>
#include <stdint.h>

/* The order of servobench.design.speed.monte_carlo. */
enum { ON_ARRIVAL, BY_STAMP, BY_HISTORY };

typedef struct Figures {
    double current_rate_rad_s, inductance, inertia_kg_m2, friction_nm_s, torque_constant_nm_a;
    double uncertainty; /* of these five, each drawn evenly */
    double gains[3];    /* of e_q, e and q */
    double period_s, delay_max_s, offset_s, loss_probability, load_nm;
    double limit; /* rad/s: whose error is larger has diverged */
} Figures;

typedef struct RandomRuns {
    Figures figures;
    int64_t strategy, losses_max;
    int64_t behind; /* periods from a sample to its action */
    int64_t steps;
} RandomRuns;

/* Largest |e| of `count` runs from number `first` on, infinite where one diverged; false: no memory. */
bool run_randomly(const RandomRuns *self, uint64_t seed, uint64_t first, int64_t count, double *peaks);

#endif
