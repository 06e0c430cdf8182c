#ifndef CORE_ROTATION_H
#define CORE_ROTATION_H

typedef struct SineCosine {
    double sine, cosine;
} SineCosine;

SineCosine sine_cosine(double angle_rad);

#define TURN_RAD 6.283185307179586

#endif
