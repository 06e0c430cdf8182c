/* What the place and the speed of the load ask of the shaft: a hanging weight, an arm, a table, end stops. */
#ifndef CORE_PLACED_LOAD_H
#define CORE_PLACED_LOAD_H

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

/* Where in the table a load was at last. */
typedef struct TablePlace {
    int place, speed;
} TablePlace;

/* What is asked at a place: the arm's sine, and the torque of all the rest, N m. */
typedef struct Asked {
    double arm_sine, rest_nm;
} Asked;

/* Of a load at that place and speed. */
Asked placed_load(const PlacedLoad *load, TablePlace *last, double turns, double speed_rad_s);
/* On the way between two of them that are `way_rad` apart, `ahead_rad` beyond the first. */
Asked asked_between(const PlacedLoad *load, Asked from, Asked to, double way_rad, double ahead_rad);

#endif
