/* What the power stage watches by itself: the link's voltage, the current, and how long it has been large. */
#ifndef CORE_PROTECTION_H
#define CORE_PROTECTION_H

#include <stdbool.h>

typedef enum Trip {
    TRIP_NONE,
    TRIP_OVER_VOLTAGE,
    TRIP_UNDER_VOLTAGE,
    TRIP_OVER_CURRENT,
    TRIP_OVERLOAD,
    TRIP_MOTOR_HOT,
    TRIP_ENCODER,
    TRIP_STAGE_HOT
} Trip;

typedef struct Protection {
    int active;
    double over_v, under_v, over_a2; /* V, V, A^2 */
    double continuous_a, continuous_a2;
    double overload_max_a2s; /* of I^2 t above the continuous current */
    double warning_a2s;
    double clear_a2s;   /* below it the continuous current is the limit no more */
    int overload_trips; /* else the current is limited to the continuous one */
    double winding_max_c;
    double missing_max; /* encoder counts between two index pulses */
    double period_s;
    int stage_heats; /* by its current, as the next seven say */
    double stage_share;   /* of the way to where it settles, that it goes in a period */
    double ambient_c, rise_k_a2; /* rise for ever by A^2 */
    double stage_max_c, stage_clear_c;
    double derate_from_c, derate_a_k; /* largest current for each kelvin below stage_max_c, from there on */
} Protection;

typedef struct ProtectionState {
    double overload_a2s;
    double limiting; /* 1: to the continuous current */
    double warning;
    double winding_c; /* as its sensor has it */
    double stage_c;
    double stage_hot; /* 1: was above its limit, and is not below where it clears */
    double derated;
    double limits, limit_a; /* 1: no current above that amplitude is let through */
    int trip; /* since the last reset: the first that opened the power stage, or an overload */
} ProtectionState;

/* At a tick, with the square of the measured current's amplitude, A^2, and the encoder counts that were missing at
   the last index pulse; true if the power stage must be off. */
bool watch(ProtectionState *state, const Protection *p, bool on, double link_v, double current_a2, double missing);

#endif
