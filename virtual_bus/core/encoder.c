/* Errors of an encoder, and three ways from counts to speed.

   The angle is that of a moment ago (the line's delay), swings once a turn (eccentricity of the disc), and once
   and twice a line (offsets, amplitudes and phase of sine and cosine). Within a period the shaft's path is a
   parabola through both its ends with the speeds there. Dirt on the disc hides edges: their counts are lost for good,
   and an index pulse once a turn tells how many. */
#include "encoder.h"

#include <math.h>
#include <stdbool.h>

#include "limits.h"
#include "rotation.h"

static const double PER_TURN = 1.0 / TURN_RAD;

/* atan for magnitudes up to 1, by +, -, *, / and sqrt: the angle halved twice where it is not small, then Taylor's
   polynomial, whose next term is below 1e-16. */
static double arc_tangent(double x)
{
    double times = 1.0;
    if (fabs(x) > 0.2) {
        x = x / (1.0 + sqrt(1.0 + x * x));
        x = x / (1.0 + sqrt(1.0 + x * x));
        times = 4.0;
    }
    double y = x * x;
    double sum = 1.0 / 17.0 - y * (1.0 / 19.0 - y * (1.0 / 21.0));
    sum = 1.0 / 9.0 - y * (1.0 / 11.0 - y * (1.0 / 13.0 - y * (1.0 / 15.0 - y * sum)));
    return times * x * (1.0 - y * (1.0 / 3.0 - y * (1.0 / 5.0 - y * (1.0 / 7.0 - y * sum))));
}

/* An error and its slope by the angle. */
typedef struct Course {
    double rad, slope;
} Course;

/* How far the angle that a line's two signals tell is ahead of the true one. */
static Course line_error(const Encoder *p, SineCosine at)
{
    double sine = p->sine_in_phase * at.sine + p->sine_across * at.cosine + p->sine_offset;
    double cosine = at.cosine + p->cosine_offset;
    double across = sine * at.cosine - cosine * at.sine, along = cosine * at.cosine + sine * at.sine;
    double turning = cosine * (p->sine_in_phase * at.cosine - p->sine_across * at.sine) + sine * at.sine;
    return (Course){arc_tangent(across / along), turning / (cosine * cosine + sine * sine) - 1.0};
}

/* Between two ends, with the slopes there: 2e-10 of the error is left out. `step`: rad of the angle. */
static void set_cubic(double *cubic, Course low, Course high, double step, double scale)
{
    double rise = high.rad - low.rad, from = step * low.slope, to = step * high.slope;
    cubic[0] = scale * low.rad;
    cubic[1] = scale * from;
    cubic[2] = scale * (3.0 * rise - 2.0 * from - to);
    cubic[3] = scale * (from + to - 2.0 * rise);
}

void tabulate_errors(Encoder *p)
{
    const double step = TURN_RAD / ERROR_PARTS;
    for (int part = 0; part < ERROR_PARTS; part++) {
        Course line[2], turn[2];
        for (int end = 0; end < 2; end++) {
            SineCosine at = sine_cosine((part + end) * step);
            SineCosine disc = sine_cosine((part + end) * step + p->eccentricity_phase_rad);
            line[end] = line_error(p, at);
            turn[end] = (Course){disc.sine, disc.cosine};
        }
        set_cubic(p->of_line.cubic[part], line[0], line[1], step, p->sines ? 1.0 / p->lines : 0.0);
        set_cubic(p->of_turn.cubic[part], turn[0], turn[1], step, p->eccentricity_rad);
    }
}

/* `periods`: the angle in periods of the error. */
static double error_at(const ErrorTable *table, double periods)
{
    double place = (periods - floor(periods)) * ERROR_PARTS;
    if (!(place < ERROR_PARTS)) /* rounded up, or no number */
        place = 0.0;
    int part = (int)place;
    const double *cubic = table->cubic[part];
    double x = place - part;
    return cubic[0] + x * (cubic[1] + x * (cubic[2] + x * cubic[3]));
}

static Place moved(Place from, double by_rad)
{
    double angle = from.angle_rad + by_rad;
    double turns = floor(angle * PER_TURN);
    return (Place){from.turns + turns, most(angle - turns * TURN_RAD, 0.0)};
}

/* rad from one place to another, near by. */
static double way(Place from, Place to)
{
    return (to.turns - from.turns) * TURN_RAD + (to.angle_rad - from.angle_rad);
}

/* How much a parabola of length `way` bends; at the share x of the period it is at way x - bend x (1 - x). */
static double bend(double speed_before, double speed, double period_s)
{
    return 0.5 * (speed - speed_before) * period_s;
}

Place encoder_sees(EncoderState *state, const Encoder *p, Place shaft, double speed_rad_s, double period_s)
{
    double before_rad_s = state->shaft_speed_rad_s;
    Place before = state->shaft;
    state->shaft = shaft;
    state->shaft_speed_rad_s = speed_rad_s;
    if (!p->distorted)
        return shaft;
    double back = p->delay_share;
    double late = back * (way(before, shaft) + bend(before_rad_s, speed_rad_s, period_s) * (1.0 - back));
    double turns = (shaft.angle_rad - late) * PER_TURN, error = 0.0;
    if (p->eccentricity_rad != 0.0)
        error = error_at(&p->of_turn, turns);
    if (p->sines)
        error += error_at(&p->of_line, p->lines * turns);
    return moved(shaft, error - late);
}

/* Of the counts from 0 to `count` those that the dirt covers. */
static double counts_in_dirt(const Encoder *p, const Resolution *resolution, double count)
{
    double turns = floor(count / resolution->counts);
    return turns * p->dirt_width + within(count - turns * resolution->counts - p->dirt_from, 0.0, p->dirt_width);
}

double count_seen(EncoderState *state, const Encoder *p, const Resolution *resolution, double count)
{
    if (p->dirt_width > 0.0) {
        double dirty = counts_in_dirt(p, resolution, count);
        if (state->soiled != 0.0)
            state->lost += dirty - state->dirty;
        state->dirty = dirty;
        state->soiled = 1.0;
    } else {
        state->soiled = 0.0;
    }
    double turn = floor(count / resolution->counts);
    if (turn != state->turn) {
        state->turn = turn;
        state->missing = state->lost - state->lost_by_turn;
        state->lost_by_turn = state->lost;
    }
    return count - state->lost;
}

/* The share of a period at which a path of length `passed` with that bend is `ahead` of its start. */
static double share_at(double ahead, double passed, double bent)
{
    double slope = passed - bent;
    double root = slope * slope + 4.0 * bent * ahead;
    if (!(root >= 0.0 && slope * passed > 0.0)) /* it turns back on its way: as if it were straight */
        return within(ahead / passed, 0.0, 1.0);
    return within(2.0 * ahead / (slope + (slope > 0.0 ? sqrt(root) : -sqrt(root))), 0.0, 1.0);
}

/* When the edge was passed, s since power-on, as the timer has it. */
static double edge_time(const EncoderState *state, const Encoder *p, const Resolution *resolution, double edge,
                        Place seen, double tick, double period_s)
{
    double turned = edge + state->lost - state->seen.turns * resolution->counts;
    double ahead = turned * resolution->rad_per_count - state->seen.angle_rad;
    double bent = bend(state->seen_speed_rad_s, state->shaft_speed_rad_s, period_s);
    double at_s = (tick - 1.0 + share_at(ahead, way(state->seen, seen), bent)) * period_s;
    return p->timer_hz > 0.0 ? floor(at_s * p->timer_hz) / p->timer_hz : at_s;
}

/* The way between the last edges of two ticks over the time between them. Without a new edge: at most what one
   that comes now would make. */
static double speed_by_edges(EncoderState *state, const Encoder *p, const Resolution *resolution, double count,
                             double before, Place seen, double tick, double period_s)
{
    if (count == before) {
        double most_rad_s = resolution->rad_per_count / (tick * period_s - state->edge_s);
        return within(state->speed_rad_s, -most_rad_s, most_rad_s);
    }
    double edge = count > before ? count : count + 1.0;
    double at_s = edge_time(state, p, resolution, edge, seen, tick, period_s);
    double passed = (edge - state->edge) * resolution->rad_per_count, passed_s = at_s - state->edge_s;
    bool first = state->edges == 0.0;
    state->edge = edge;
    state->edge_s = at_s;
    state->edges = 1.0;
    if (first)
        return 0.0;
    return passed_s > 0.0 ? passed / passed_s : state->speed_rad_s;
}

/* A loop of second order that follows the count, and rests where it is inside of it. */
static double speed_by_observer(EncoderState *state, const Encoder *p, const Resolution *resolution,
                                double moved_counts, double period_s)
{
    double ahead = state->observer_ahead - moved_counts + period_s * state->observer_speed;
    double error = -floor(ahead);
    state->observer_ahead = ahead + period_s * p->observer_position_gain * error;
    state->observer_speed += period_s * p->observer_speed_gain * error;
    return state->observer_speed * resolution->rad_per_count;
}

double encoder_speed(EncoderState *state, const Encoder *p, const Resolution *resolution, double count, double before,
                     Place seen, double tick, double period_s)
{
    double speed = (count - before) * resolution->rad_per_count / period_s;
    if (p->method == SPEED_BY_EDGES)
        speed = speed_by_edges(state, p, resolution, count, before, seen, tick, period_s);
    else if (p->method == SPEED_BY_OBSERVER)
        speed = speed_by_observer(state, p, resolution, count - before, period_s);
    state->seen = seen;
    state->seen_speed_rad_s = state->shaft_speed_rad_s;
    state->speed_rad_s = speed;
    return speed;
}
