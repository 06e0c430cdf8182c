/* Sine and cosine by +, - and * alone: the same bits on every IEEE 754 machine, whatever its library. */
#ifndef CORE_ROTATION_H
#define CORE_ROTATION_H

#include <math.h>
#include <stdint.h>

#include "pairs.h"

#define TURN_RAD 6.283185307179586

typedef struct SineCosine {
    double sine, cosine;
} SineCosine;

/* pi/2 in two parts: the high one has 33 bits, so that its product with a small whole number is exact. */
static const double HALF_PI_HIGH = 0x1.921fb544p+0;
static const double HALF_PI_LOW = 0x1.0b4611a626331p-34;
static const double PER_HALF_PI = 2.0 / 3.141592653589793;
/* More quarters of a turn than an integer counts, or no number. */
static const double QUARTERS_MAX = 0x1p62;

/* The error is below 4e-16 for magnitudes up to 1000: reduction to -pi/4..pi/4, then the Taylor polynomials
   to the 15th and 16th power. In the header: twice in each inner period, and a call costs a tenth of it. */
static inline SineCosine sine_cosine(double angle_rad)
{
    double turned = angle_rad * PER_HALF_PI + 0.5;
    if (!(fabs(turned) < QUARTERS_MAX))
        return (SineCosine){NAN, NAN};
    int64_t quarters = (int64_t)turned; /* towards zero; then down */
    quarters -= (double)quarters > turned;
    double quarter = (double)quarters;
    double x = angle_rad - quarter * HALF_PI_HIGH - quarter * HALF_PI_LOW;
    double y = x * x;
    double y2 = y * y;
    double y4 = y2 * y2;
    /* Estrin's scheme: half as many roundings wait for each other as in Horner's. Of the sine and the cosine. */
    Pair low = (Pair){-1.0 / 6.0, -0.5} + y * (Pair){1.0 / 120.0, 1.0 / 24.0};
    Pair middle = (Pair){-1.0 / 5040.0, -1.0 / 720.0} + y * (Pair){1.0 / 362880.0, 1.0 / 40320.0};
    Pair high = (Pair){-1.0 / 39916800.0, -1.0 / 3628800.0} + y * (Pair){1.0 / 6227020800.0, 1.0 / 479001600.0};
    Pair last = (Pair){1.0 / 1307674368000.0, 1.0 / 87178291200.0} - y * (Pair){0.0, 1.0 / 20922789888000.0};
    Pair both = low + y2 * middle;
    both = both + y4 * (high - y2 * last);
    both = (Pair){x, 1.0} + (Pair){x * y, y} * both;
    double s = both[0], c = both[1];
    switch (quarters & 3) {
    case 0:
        return (SineCosine){s, c};
    case 1:
        return (SineCosine){c, -s};
    case 2:
        return (SineCosine){-s, -c};
    default:
        return (SineCosine){-c, s};
    }
}

#endif
