/* Whole numbers as Python divides them, and 32-bit counts that wrap. */
#ifndef CORE_WHOLE_NUMBERS_H
#define CORE_WHOLE_NUMBERS_H

#include <stdint.h>

/* `divisor` is above 0. */
static inline int64_t floored(int64_t number, int64_t divisor)
{
    return number / divisor - (number % divisor < 0);
}

/* Instants and counts that a peer can set to anything: what does not fit wraps. */
static inline int64_t plus(int64_t one, int64_t other) { return (int64_t)((uint64_t)one + (uint64_t)other); }
static inline int64_t minus(int64_t one, int64_t other) { return (int64_t)((uint64_t)one - (uint64_t)other); }
static inline int64_t times(int64_t one, int64_t other) { return (int64_t)((uint64_t)one * (uint64_t)other); }

/* The shorter way, to either side, from `from` to `to` for a count of `bits` bits: it wraps. */
static inline int64_t way_between(int64_t from, int64_t to, int bits)
{
    uint64_t wrap = (uint64_t)1 << bits, half = wrap >> 1;
    return (int64_t)(((uint64_t)to - (uint64_t)from + half) & (wrap - 1)) - (int64_t)half;
}

#endif
