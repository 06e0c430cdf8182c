/* Numbers as the integers of an object: whole ones, to the nearest, of two the even one, as Python's round.

   rint and fmod are exact (IEEE 754, 5.3.1 and 5.9): their bits are the same everywhere. */
#include "actual_values.h"

#include <assert.h>
#include <math.h>

#include "limits.h"

/* Into a signed integer of so many bits. What is no number stays none. */
double clipped(double value, int bits)
{
    assert(bits > 0 && bits <= 32);
    double most_negative = -ldexp(1.0, bits - 1);
    return rint(within(value, most_negative, -most_negative - 1.0));
}

/* A difference of encoder counts in position units, as the INTEGER32 that wraps (CiA 402-2, object 6064h). */
double user_position(double counts, double counts_per_position)
{
    static const double wrap = 4294967296.0;
    double position = fmod(rint(counts / counts_per_position), wrap);
    if (position >= wrap / 2.0)
        return position - wrap;
    return position < -wrap / 2.0 ? position + wrap : position;
}

double ranged_position(const UserScale *scale, double counts)
{
    double beyond = fmod(rint(counts / scale->counts_per_position) - scale->range_low, scale->range_span);
    return scale->range_low + (beyond < 0.0 ? beyond + scale->range_span : beyond);
}
