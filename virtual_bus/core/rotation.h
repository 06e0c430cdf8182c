#ifndef CORE_ROTATION_H
#define CORE_ROTATION_H

typedef struct SineCosine {
    double sine, cosine;
} SineCosine;

SineCosine sine_cosine(double angle_rad);

/* As Python's: the first one where they are equal, or where one is no number. */
static inline double least(double a, double b) { return b < a ? b : a; }
static inline double most(double a, double b) { return b > a ? b : a; }
static inline double within(double value, double low, double high) { return least(most(value, low), high); }

#define TURN_RAD 6.283185307179586

#endif
