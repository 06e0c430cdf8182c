/* What the place and the speed of the load ask of the shaft: a hanging weight, an arm, a table, end stops. */
#ifndef CORE_PLACED_LOAD_H
#define CORE_PLACED_LOAD_H

#include "rotation.h"

/* Torques against positive speed, N m; places are turns of the motor since power-on, at the load's side. */
typedef struct PlacedLoad {
    int active;
    double hanging_nm;
    double arm_nm;                  /* of an arm that lies level */
    double arm_per_turn, arm_turns; /* of the arm: for each turn of the motor; at power-on, 0 hangs down */
    double repeats_turns;           /* the table goes round; 0: it ends */
    int places, speeds;             /* of the table; 0: none */
    const double *table;            /* places, turns, rising; speeds, rad/s, rising; torques, place by place */
} PlacedLoad;

/* Springs with dampers at the ends of the way, which push and never pull. */
typedef struct EndStops {
    int active;
    double negative_turns, positive_turns; /* where they are touched; no end: infinite */
    double stiffness_nm_rad, damping_nm_s;
    double yield_s; /* damping over stiffness */
} EndStops;

/* Where the load is at the start of a period. */
typedef struct LoadPlace {
    double turns;
    SineCosine arm;
} LoadPlace;

LoadPlace place_of(const PlacedLoad *load, double turns);
/* Of a load that has turned so far from there. */
double placed_load_nm(const PlacedLoad *load, const LoadPlace *from, double turned_rad, double speed_rad_s);

#endif
