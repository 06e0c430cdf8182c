#include "placed_load.h"

#include <math.h>

#include "limits.h"
#include "rotation.h"

static const double PER_TURN = 1.0 / TURN_RAD;

/* The last of `count` rising points that is not beyond `at`, but the last one; of no number the first. `share`:
   how far it is to the next, held at both ends. */
static int point_before(const double *points, int count, double at, double *share)
{
    int low = 0, high = count - 1;
    while (high - low > 1) {
        int middle = low + (high - low) / 2;
        if (points[middle] <= at)
            low = middle;
        else
            high = middle;
    }
    *share = high == low ? 0.0 : within((at - points[low]) / (points[high] - points[low]), 0.0, 1.0);
    return low;
}

/* Straight between two points of a row. */
static double between(const double *row, int point, double share)
{
    return share == 0.0 ? row[point] : row[point] + share * (row[point + 1] - row[point]);
}

static double table_nm(const PlacedLoad *load, double turns, double speed_rad_s)
{
    const double *places = load->table, *speeds = places + load->places, *torques = speeds + load->speeds;
    double along, faster;
    if (load->repeats_turns > 0.0)
        turns -= load->repeats_turns * floor((turns - places[0]) / load->repeats_turns);
    int place = point_before(places, load->places, turns, &along);
    int speed = point_before(speeds, load->speeds, speed_rad_s, &faster);
    const double *row = torques + (long)place * load->speeds;
    double here = between(row, speed, faster);
    return along == 0.0 ? here : here + along * (between(row + load->speeds, speed, faster) - here);
}

LoadPlace place_of(const PlacedLoad *load, double turns)
{
    LoadPlace place = {.turns = turns};
    if (load->arm_nm != 0.0) {
        double arm = turns * load->arm_per_turn + load->arm_turns;
        place.arm = sine_cosine(TURN_RAD * (arm - floor(arm)));
    }
    return place;
}

/* The sine of the arm's angle. Within a period an arm turns little: there the Taylor polynomials to the 5th and
   6th power are below 2e-8 off, and at 0.1 rad below 2e-11. */
static double arm_sine(SineCosine from, double turned_rad)
{
    SineCosine turn;
    double square = turned_rad * turned_rad;
    if (square < 0.0625) {
        turn.sine = turned_rad * (1.0 + square * (-1.0 / 6.0 + square * (1.0 / 120.0)));
        turn.cosine = 1.0 + square * (-0.5 + square * (1.0 / 24.0 - square * (1.0 / 720.0)));
    } else {
        turn = sine_cosine(turned_rad);
    }
    return from.sine * turn.cosine + from.cosine * turn.sine;
}

double placed_load_nm(const PlacedLoad *load, const LoadPlace *from, double turned_rad, double speed_rad_s)
{
    double torque_nm = load->hanging_nm;
    if (load->arm_nm != 0.0)
        torque_nm += load->arm_nm * arm_sine(from->arm, turned_rad * load->arm_per_turn);
    if (load->places > 0)
        torque_nm += table_nm(load, from->turns + turned_rad * PER_TURN, speed_rad_s);
    return torque_nm;
}
