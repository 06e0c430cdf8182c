/* What is done phase by phase: the drive's current sensors, and the dead time of its inverter. */
#ifndef CORE_PHASES_H
#define CORE_PHASES_H

#include <stdint.h>

#include "pairs.h"
#include "rotation.h"

/* Sensors in phases a and b; the third current is what these two leave. */
typedef struct CurrentSensors {
    int active; /* 0: the currents are known as they are */
    double scale_a, scale_b;
    double offset_a, offset_b; /* A */
    double range_a;            /* A; larger currents are told as that */
    double step_a;             /* of the converter, A; 0: none */
    double noise_a;            /* rms, A */
    double delay_share; /* of an inner period: straight between the currents of two ticks */
    int64_t seed;
} CurrentSensors;

/* The current at the last tick, in the stator's frame, A. */
typedef struct SensorState {
    double alpha_a, beta_a;
} SensorState;

typedef struct Inverter {
    double dead_share;  /* what dead time takes of a period, after the drive's compensation; 0: none */
    double zero_band_a; /* within it a current changes its sign in the period, and the error is in proportion */
    double output_share; /* of the voltage circle; 1: all of it */
} Inverter;

/* What the sensors tell of a current in d and q at the rotor's electrical angle, in the stator's frame, A. */
Pair sensed_current(const CurrentSensors *p, SensorState *state, Pair current, SineCosine rotor, double amplitude,
                    int64_t tick);

/* What dead time adds to the voltage at that current, V in d and q. */
Pair dead_time_voltage(const Inverter *p, Pair current, SineCosine rotor, double amplitude, double link_v);

#endif
