/* Between rotor and load: a coupling that twists, its backlash, friction that depends on the speed, cogging; and
   what the load's place asks. */
#ifndef CORE_MECHANISM_H
#define CORE_MECHANISM_H

#include "motor.h"
#include "placed_load.h"

typedef struct Mechanism {
    int active;  /* 0: a rigid shaft with constant friction, motor.c alone */
    int coupled; /* two masses; 0: rotor and load are one */
    int encoder_on_load;
    int friction_on_load; /* both kinds of it; an unpowered drive's brake holds the rotor */
    double per_inertia_rotor, per_inertia_load;
    double stiffness_nm_rad, damping_nm_s;
    double half_backlash_rad;
    double yield_s;           /* damping over stiffness */
    double backward_more_nm;  /* Coulomb friction at negative speed, above that at positive */
    double breakaway_more_nm; /* friction at rest, above Coulomb's */
    double per_stribeck;      /* s/rad */
    double bristle_nm_rad;    /* friction goes by bristles that bend; 0: by the speed alone */
    double bristle_nm_s;
    double rubs_per_load;     /* Coulomb friction that each N m of the load adds */
    const double *cogging_nm; /* over a turn of the rotor, the first point once more behind the last */
    int cogging_points;       /* 0: no cogging */
    double cogging_per_rad;   /* points */
    PlacedLoad placed;        /* as are the stops: at the load's side */
    EndStops stops;
} Mechanism;

/* The load behind the coupling. */
typedef struct LoadSide {
    double speed_rad_s;
    double twist_rad; /* rotor's angle less the load's */
    double stop;      /* 1 or -1: the load is at an end stop */
    double hits;      /* of end stops, and the speed at the last one */
    double hit_rad_s;
    double bristle_rad; /* by which the bristles of the friction are bent */
    /* What goes by the places of rotor and load, at the end of the last period, and where and at which speed the rotor
       was there. */
    double sited; /* 1: that is known */
    double sited_rad, sited_turns, sited_rad_s, cogs_nm;
    Asked asked;
    TablePlace place;
} LoadSide;

void advance_machine(MotorState *state, LoadSide *load, const MotorParameters *p, const Mechanism *mechanism,
                     Voltage voltage, double load_nm, double brake_nm);

#endif
