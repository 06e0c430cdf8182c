#include "placed_load.h"

#include <math.h>

#include "limits.h"
#include "rotation.h"

/* A shorter way has no slope but rounding. */
static const double NO_WAY_RAD = 1e-9;

/* The last of `count` rising points that is not beyond `at`, but the last one; of no number the first. `last`: the
   one that it was. `share`: how far it is to the next, held at both ends. */
static int point_before(const double *points, int count, double at, int last, double *share)
{
    int low = last, high = last + 1;
    if (count < 2) {
        *share = 0.0;
        return 0;
    }
    if (!(points[low] <= at && at < points[high])) {
        low = 0;
        high = count - 1;
        while (high - low > 1) {
            int middle = low + (high - low) / 2;
            if (points[middle] <= at)
                low = middle;
            else
                high = middle;
        }
    }
    *share = within((at - points[low]) / (points[high] - points[low]), 0.0, 1.0);
    return low;
}

/* Straight between two points of a row. */
static double between(const double *row, int point, double share)
{
    return share == 0.0 ? row[point] : row[point] + share * (row[point + 1] - row[point]);
}

static double table_nm(const PlacedLoad *load, TablePlace *last, double turns, double speed_rad_s)
{
    const double *places = load->table, *speeds = places + load->places, *torques = speeds + load->speeds;
    double along, faster;
    if (load->repeats_turns > 0.0)
        turns -= load->repeats_turns * floor((turns - places[0]) / load->repeats_turns);
    last->place = point_before(places, load->places, turns, last->place, &along);
    last->speed = point_before(speeds, load->speeds, speed_rad_s, last->speed, &faster);
    const double *row = torques + (long)last->place * load->speeds;
    double here = between(row, last->speed, faster);
    return along == 0.0 ? here : here + along * (between(row + load->speeds, last->speed, faster) - here);
}

Asked placed_load(const PlacedLoad *load, TablePlace *last, double turns, double speed_rad_s)
{
    Asked asked = {0.0, load->hanging_nm};
    if (load->arm_nm != 0.0) {
        double arm = turns * load->arm_per_turn + load->arm_turns;
        asked.arm_sine = sine_cosine(TURN_RAD * (arm - floor(arm))).sine;
    }
    if (load->places > 0)
        asked.rest_nm += table_nm(load, last, turns, speed_rad_s);
    return asked;
}

/* Straight; and an arm's sine bulges by the square of its small way. */
Asked asked_between(const PlacedLoad *load, Asked from, Asked to, double way_rad, double ahead_rad)
{
    if (fabs(way_rad) < NO_WAY_RAD)
        return from;
    double share = ahead_rad / way_rad, arm_rad = way_rad * load->arm_per_turn;
    double bulge = 1.0 + 0.5 * share * (1.0 - share) * arm_rad * arm_rad;
    return (Asked){bulge * (from.arm_sine + share * (to.arm_sine - from.arm_sine)),
                   from.rest_nm + share * (to.rest_nm - from.rest_nm)};
}
