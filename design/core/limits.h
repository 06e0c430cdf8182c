/* Python's min and max: the first of two that are equal, or of which one is no number. */
#ifndef CORE_LIMITS_H
#define CORE_LIMITS_H

#include <stdint.h>

static inline double least(double a, double b) { return b < a ? b : a; }
static inline double most(double a, double b) { return b > a ? b : a; }
static inline double within(double value, double low, double high) { return least(most(value, low), high); }

/* A third of what `floor` takes without SSE 4.1. No number stays none. */
static inline double floor_of_positive(double value) { return value < 0x1p62 ? (double)(int64_t)value : value; }

#endif
