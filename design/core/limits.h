/* Python's min and max: the first of two that are equal, or of which one is no number. */
#ifndef CORE_LIMITS_H
#define CORE_LIMITS_H

static inline double least(double a, double b) { return b < a ? b : a; }
static inline double most(double a, double b) { return b > a ? b : a; }
static inline double within(double value, double low, double high) { return least(most(value, low), high); }

#endif
