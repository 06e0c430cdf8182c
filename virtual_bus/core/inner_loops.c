/* The firmware at one tick of the inner grid, and the grid in time.

   Tick k is at k / rate_hz after power-on. At a tick the firmware samples the currents and the encoder and
   computes the next voltage, which the inverter applies from the next tick on. */
#include "inner_loops.h"

#include <assert.h>
#include <math.h>

#include "limits.h"
#include "machine_equations.h"
#include "rotation.h"

static const int64_t NS_PER_S = 1000000000;
static const double PER_TURN = 1.0 / TURN_RAD;

static double link_voltage(const InnerLoops *self)
{
    return self->dc_link.active ? self->link.volts : self->dc_link.source_v;
}

/* One inner period of the motor under the inverter's present output.

   Inverter off: the diodes drive the current down against the DC link, far faster than R or the back-EMF
   would, so both are left out; back-EMF above the DC link would rectify and is not modelled. */
static void turn_motor(InnerLoops *self, double load_nm)
{
    const MotorParameters *p = &self->motor;
    const Output *out = &self->state.now;
    MotorState *shaft = &self->shaft;
    double brake_nm = self->loop.brake_drag_nm + self->state.brake_holds * self->loop.brake_nm;
    if (out->on != 0.0) {
        double told_rad = out->angle_rad, told_q_v = out->voltage_q_v;
        if (self->commutation.mirrored) {
            told_rad = -told_rad;
            told_q_v = -told_q_v;
        }
        SineCosine turn = sine_cosine(told_rad - p->pole_pairs * shaft->angle_rad);
        Voltage voltage = {
            .d = turn.cosine * out->voltage_d_v - turn.sine * told_q_v,
            .q = turn.sine * out->voltage_d_v + turn.cosine * told_q_v,
            .live = 1.0,
            .turning = 1.0,
        };
        if (self->inverter.dead_share != 0.0) {
            Pair current = {shaft->current_d_a, shaft->current_q_a};
            double electrical = p->pole_pairs * shaft->angle_rad;
            SineCosine rotor = electrical == self->rotor_rad ? self->rotor : sine_cosine(electrical);
            Pair error = dead_time_voltage(&self->inverter, current, rotor, self->phase_amplitude, link_voltage(self));
            voltage.d += error[0];
            voltage.q += error[1];
        }
        advance_machine(shaft, &self->load_side, p, &self->mechanism, voltage, load_nm, brake_nm);
        return;
    }
    double i_d = shaft->current_d_a, i_q = shaft->current_q_a;
    double magnitude = sqrt(i_d * i_d + i_q * i_q);
    double fall = p->voltage_max_v * p->period_s / most(p->inductance_d_h, p->inductance_q_h);
    double keep = magnitude > fall ? 1.0 - fall / magnitude : 0.0;
    shaft->current_d_a = keep * i_d;
    shaft->current_q_a = keep * i_q;
    advance_machine(shaft, &self->load_side, p, &self->mechanism, (Voltage){0}, load_nm, brake_nm);
}

/* A^2; the energy of a winding is half of its inductance times its current's. */
static double square(double value) { return value * value; }

/* J in the windings, and W that the motor turns into heat and motion. */
static void ask_motor(const InnerLoops *self, double *stored_j, double *consumed_w)
{
    const MotorParameters *p = &self->motor;
    const MotorState *x = &self->shaft;
    Pair state = electric_state(x, p);
    double d2 = square(x->current_d_a), q2 = square(x->current_q_a);
    double heat = p->torque_factor * p->resistance_ohm * (d2 + q2);
    if (p->saturation.active)
        *stored_j = p->torque_factor * saturated_energy(&p->saturation, state);
    else
        *stored_j = 0.5 * p->torque_factor * (p->inductance_d_h * d2 + p->inductance_q_h * q2);
    *consumed_w = heat + electric_torque(p, p->saturation.active, state) * x->speed_rad_s;
}

/* One inner period of the motor, and of the DC link that it is fed from. */
static void drive_motor(InnerLoops *self, double load_nm)
{
    if (!self->dc_link.active) {
        turn_motor(self, load_nm);
        return;
    }
    /* What it was at the end of the last period is what it is at the start of this one. */
    LinkState *link = &self->link;
    if (link->asked == 0.0)
        ask_motor(self, &link->stored_j, &link->consumed_w);
    double stored = link->stored_j, before = link->consumed_w;
    turn_motor(self, load_nm);
    ask_motor(self, &link->stored_j, &link->consumed_w);
    link->asked = 1.0;
    double watts = (link->stored_j - stored) * self->motor.rate_hz + 0.5 * (before + link->consumed_w);
    advance_link(link, &self->dc_link, watts);
}

/* Of the encoder at the load, or of one with errors: its count and, of it, the speed before the filter, rad/s. */
static double count_encoder(InnerLoops *self)
{
    const Resolution *resolution = &self->resolution;
    const MotorState *shaft = &self->shaft;
    LoopState *state = &self->state;
    Place place = {shaft->turns, shaft->angle_rad};
    double before = state->count, turning_rad_s = shaft->speed_rad_s;
    if (self->mechanism.encoder_on_load) {
        double angle = shaft->angle_rad - self->load_side.twist_rad, turns = floor(angle * PER_TURN);
        place = (Place){shaft->turns + turns, angle - turns * TURN_RAD};
        turning_rad_s = self->load_side.speed_rad_s;
    }
    if (self->encoder.active)
        place = encoder_sees(&self->sensed, &self->encoder, place, turning_rad_s, self->motor.period_s);
    if (!self->loop.encoder_held) {
        double count = place.turns * resolution->counts + floor(place.angle_rad * resolution->counts_per_rad);
        state->count = self->encoder.loses ? count_seen(&self->sensed, &self->encoder, resolution, count) : count;
    }
    if (self->encoder.active)
        return encoder_speed(&self->sensed, &self->encoder, resolution, state->count, before, place,
                             (double)(self->ticks + 1), self->motor.period_s);
    return (state->count - before) * resolution->rad_per_count * self->motor.rate_hz;
}

/* What the drive takes its currents for, N m. */
static double believed_torque(const InnerLoops *self, double i_d, double i_q)
{
    const Believed *believed = &self->believed;
    double flux = believed->flux_linkage_wb + believed->saliency_h * i_d;
    return self->motor.torque_factor * self->motor.pole_pairs * flux * i_q;
}

/* The electrical angle, rad, by which the drive commutates, of the encoder's within its turn. */
static double commutated(const Commutation *p, double encoder_rad, double pole_pairs)
{
    if (!p->active)
        return encoder_rad * pole_pairs;
    return p->forced ? p->forced_rad : encoder_rad * p->pole_pairs + p->ahead_rad;
}

/* Electrical angle by mechanical one, as the drive reckons: none where the angle is not its own. */
static double ratio_of_angles(const InnerLoops *self)
{
    const Commutation *p = &self->commutation;
    if (!p->active)
        return self->motor.pole_pairs;
    return p->forced ? 0.0 : p->pole_pairs;
}

/* What the firmware sees at the start of a period: encoder count, filtered speed, dq currents in the frame of
   the encoder's angle, torque. Returns that electrical angle, rad. A rotor whose load has the encoder has one of
   its own, by which the currents turn. */
static double sample(InnerLoops *self)
{
    const LoopParameters *p = &self->loop;
    const Resolution *resolution = &self->resolution;
    const MotorState *shaft = &self->shaft;
    LoopState *state = &self->state;
    double within_turn = floor_of_positive(shaft->angle_rad * resolution->counts_per_rad), raw_speed;
    if (self->encoder.active || self->encoder.loses || self->mechanism.encoder_on_load || p->encoder_held) {
        raw_speed = count_encoder(self);
        if (p->encoder_held || !self->mechanism.encoder_on_load)
            within_turn = state->count - resolution->counts * floor(state->count / resolution->counts);
    } else {
        double count = shaft->turns * resolution->counts + within_turn;
        raw_speed = (count - state->count) * resolution->rad_per_count * self->motor.rate_hz;
        state->count = count;
    }
    state->speed_measured_rad_s += p->speed_filter * (raw_speed - state->speed_measured_rad_s);
    double encoder_rad = (within_turn + 0.5) * resolution->rad_per_count;
    double angle = commutated(&self->commutation, encoder_rad, self->motor.pole_pairs);
    Pair current = {shaft->current_d_a, shaft->current_q_a};
    double electrical = self->motor.pole_pairs * shaft->angle_rad;
    if (self->sensors.active) {
        self->rotor_rad = electrical;
        self->rotor = sine_cosine(electrical);
        current = sensed_current(&self->sensors, &self->sensor_state, current, self->rotor, self->phase_amplitude,
                                 self->ticks);
        electrical = 0.0; /* in the stator's frame */
    }
    if (self->commutation.mirrored) {
        current[1] = -current[1];
        electrical = -electrical;
    }
    SineCosine turn = sine_cosine(electrical - angle);
    state->current_d_measured_a = turn.cosine * current[0] - turn.sine * current[1];
    state->current_q_measured_a = turn.sine * current[0] + turn.cosine * current[1];
    state->torque_measured_nm =
        believed_torque(self, state->current_d_measured_a, state->current_q_measured_a);
    return angle;
}

/* Torque demand of the speed loop: ramped reference with inertia feed-forward, PI without wind-up. */
static double speed_loop(InnerLoops *self, double least_nm, double most_nm)
{
    const LoopParameters *p = &self->loop;
    const Demand *demand = &self->demand;
    LoopState *state = &self->state;
    double step = demand->acceleration_rad_s2 * self->motor.period_s;
    double wanted = demand->speed_rad_s - state->speed_demand_rad_s;
    double change = within(wanted, -step, step);
    state->speed_demand_rad_s += change;
    double error = state->speed_demand_rad_s - state->speed_measured_rad_s;
    double proportional = p->speed_gain * error + self->believed.inertia_kg_m2 * change * self->motor.rate_hz;
    double torque = proportional + state->speed_integral_nm + demand->torque_feed_nm;
    double limited = within(torque, least_nm, most_nm);
    if (torque != limited)
        state->limited = 1.0;
    else
        state->speed_integral_nm += p->speed_integral_gain * self->motor.period_s * error;
    bool at_rest = fabs(state->speed_measured_rad_s) < p->rest_speed_rad_s && state->speed_demand_rad_s == 0.0;
    state->rest_ticks = at_rest ? state->rest_ticks + 1.0 : 0.0;
    return limited;
}

static double current_limit(const InnerLoops *self)
{
    double current = self->demand.current_max_a;
    return self->watched.limits != 0.0 ? least(current, self->watched.limit_a) : current;
}

/* The torque set-point, N m, as far as its slope has come. */
static double sloped(const InnerLoops *self)
{
    double step = self->path.step_nm, before = self->state.torque_demand_nm;
    return step == 0.0 ? self->demand.torque_nm : within(self->demand.torque_nm, before - step, before + step);
}

/* The torque to be made, N m, inside every limit; for a torque set-point the state stays as it is.

   The speed limit is a proportional controller on the distance to it, so it bounds the torque towards the
   limit and lets every torque away from it pass. */
static double torque_demand(InnerLoops *self)
{
    const Demand *demand = &self->demand;
    LoopState *state = &self->state;
    double current = current_limit(self);
    double up = demand->torque_up_nm, down = demand->torque_down_nm;
    if (!self->field.active) {
        up = least(up, self->motor.torque_constant_nm_a * current);
        down = least(down, self->motor.torque_constant_nm_a * current);
    }
    if (demand->control == CONTROL_SPEED) {
        if (state->control != CONTROL_SPEED) {
            state->speed_demand_rad_s = state->speed_measured_rad_s;
            state->speed_integral_nm = within(state->torque_demand_nm, -down, up);
            state->rest_ticks = 0.0;
        }
        return speed_loop(self, -down, up);
    }
    double faster = self->loop.speed_limit_gain * (demand->speed_max_rad_s - state->speed_measured_rad_s);
    double slower = -self->loop.speed_limit_gain * (demand->speed_max_rad_s + state->speed_measured_rad_s);
    return within(within(sloped(self), slower, faster), -down, up);
}

/* The voltage of one axis before decoupling: PI, or the controller's. */
static double axis_voltage(const CurrentController *p, const double *x, double error, double gain, double integral)
{
    if (p->order < 0)
        return gain * error + integral;
    double voltage = p->d * error;
    for (int k = 0; k < p->order; k++)
        voltage += p->c[k] * x[k];
    return voltage;
}

static void advance_controller(const CurrentController *p, double *x, double error, double cut)
{
    double old[CONTROLLER_ORDER_MAX];
    for (int k = 0; k < p->order; k++)
        old[k] = x[k];
    for (int k = 0; k < p->order; k++) {
        double value = p->b[k] * error + p->take_back[k] * cut;
        for (int j = 0; j < p->order; j++)
            value += p->a[k][j] * old[j];
        x[k] = value;
    }
}

/* The largest voltage of the motor, V. */
static double voltage_circle(const InnerLoops *self)
{
    double circle = self->motor.voltage_max_v;
    if (self->dc_link.active)
        circle = self->dc_link.circle_share * self->link.volts;
    return circle * self->inverter.output_share;
}

/* d and q currents for the torque, A. */
static Pair wanted_currents(InnerLoops *self, double torque_nm, double electrical_ratio)
{
    LoopState *state = &self->state;
    if (!self->field.active)
        return (Pair){0.0, torque_nm * self->motor.per_torque_constant};
    double electrical = electrical_ratio * state->speed_measured_rad_s;
    return field_currents(&self->field, &self->believed, torque_nm, current_limit(self), state->weaker_a,
                          voltage_circle(self), electrical);
}

/* A weakened field lets a shaft run several times as fast as its motor is rated for: only there its period takes the
   steps that this needs. */
static void step_by_speed(InnerLoops *self)
{
    bool calm = fabs(self->state.speed_measured_rad_s) < self->field.calm_rad_s;
    double steps = calm ? self->field.calm_steps : self->field.fast_steps;
    if (steps == self->motor.substeps)
        return;
    self->motor.substeps = steps;
    self->motor.step_s = self->motor.period_s / steps;
}

/* PI or state space in d and q with decoupling and back-EMF feed-forward; the voltage circle serves d
   first, and what it cuts off is taken back out of the integrals (no wind-up). */
static void current_loops(InnerLoops *self, Pair wanted, double electrical_ratio)
{
    const LoopParameters *p = &self->loop;
    LoopState *state = &self->state;
    double i_d = state->current_d_measured_a, i_q = state->current_q_measured_a;
    double electrical = electrical_ratio * state->speed_measured_rad_s;
    double error_d = wanted[0] - i_d, error_q = wanted[1] - i_q;
    double v_d = axis_voltage(&p->controller_d, state->controller_d, error_d, p->gain_d, state->integral_d);
    double v_q = axis_voltage(&p->controller_q, state->controller_q, error_q, p->gain_q, state->integral_q);
    v_d -= electrical * p->decouple_q_h * i_q;
    v_q += electrical * (p->decouple_d_h * i_d + self->believed.flux_linkage_wb);
    double circle = voltage_circle(self);
    if (self->field.voltage_share > 0.0) {
        step_by_speed(self);
        state->weaker_a = weaken(&self->field, state->weaker_a, sqrt(v_d * v_d + v_q * v_q), circle, electrical);
    }
    double out_d = within(v_d, -circle, circle);
    double rest_q = sqrt(circle * circle - out_d * out_d);
    double out_q = within(v_q, -rest_q, rest_q);
    if (out_d != v_d || out_q != v_q)
        state->limited = 1.0;
    state->integral_d += p->integral_gain * (error_d + (out_d - v_d) * p->per_gain_d);
    state->integral_q += p->integral_gain * (error_q + (out_q - v_q) * p->per_gain_q);
    advance_controller(&p->controller_d, state->controller_d, error_d, out_d - v_d);
    advance_controller(&p->controller_q, state->controller_q, error_q, out_q - v_q);
    state->next.voltage_d_v = out_d;
    state->next.voltage_q_v = out_q;
}

static void switch_off(InnerLoops *self)
{
    LoopState *state = &self->state;
    self->shaped = (TorquePathState){0};
    state->now.on = state->next.on = 0.0;
    state->next.voltage_d_v = state->next.voltage_q_v = state->integral_d = state->integral_q = 0.0;
    state->torque_demand_nm = state->rest_ticks = state->weaker_a = 0.0;
    for (int k = 0; k < CONTROLLER_ORDER_MAX; k++)
        state->controller_d[k] = state->controller_q[k] = 0.0;
}

/* Whether the power stage may be on at this tick. */
static bool may_be_on(InnerLoops *self)
{
    bool on = self->demand.control != CONTROL_OFF;
    if (!self->protection.active)
        return on;
    const LoopState *state = &self->state;
    double current_a2 = square(state->current_d_measured_a) + square(state->current_q_measured_a);
    double missing = self->sensed.missing;
    bool tripped = watch(&self->watched, &self->protection, on, link_voltage(self), current_a2, missing);
    return on && !tripped;
}

/* A brake takes its time to follow its coil. */
static void move_brake(LoopState *state, const LoopParameters *p)
{
    if (state->braked == state->brake_holds) {
        state->brake_waits = 0.0;
        return;
    }
    state->brake_waits += 1.0;
    if (state->brake_waits > (state->braked != 0.0 ? p->brake_close_ticks : p->brake_open_ticks)) {
        state->brake_holds = state->braked;
        state->brake_waits = 0.0;
    }
}

/* The work of one inner period; its voltage goes out at the next one, turned on to that one's middle.

   Inverter off: the holding brake closes as soon as the shaft is slow, and opens with the inverter on, but where
   somebody orders otherwise. */
static void run_firmware(InnerLoops *self, double electrical_ratio)
{
    const Demand *demand = &self->demand;
    LoopState *state = &self->state;
    state->now = state->next;
    double angle = sample(self);
    state->limited = 0.0;
    if (!may_be_on(self)) {
        switch_off(self);
        if (fabs(state->speed_measured_rad_s) < self->loop.rest_speed_rad_s)
            state->braked = 1.0;
    } else {
        state->braked = 0.0;
        double torque = torque_demand(self);
        if (demand->control == CONTROL_TORQUE && torque != sloped(self))
            state->limited = 1.0;
        state->torque_demand_nm = torque;
        if (self->path.active)
            torque = shaped_torque(&self->shaped, &self->path, torque);
        current_loops(self, wanted_currents(self, torque, electrical_ratio), electrical_ratio);
        state->next.on = 1.0;
        state->next.angle_rad =
            angle + 1.5 * self->motor.period_s * electrical_ratio * state->speed_measured_rad_s;
    }
    state->control = demand->control;
    if (self->loop.brake_order != BRAKE_BY_STAGE)
        state->braked = self->loop.brake_order == BRAKE_SET ? 1.0 : 0.0;
    move_brake(state, &self->loop);
}

/* Of the next periods; each period's load is that of its middle. */
void look_up_loads(InnerLoops *self, int count)
{
    TableLoad *load = &self->load;
    double tick_s = 1.0 / (double)self->rate_hz;
    double at_s = ((double)self->ticks + 0.5) * tick_s - load->from_s;
    load->place = fill_loads(&load->table, load->loads_nm, at_s, tick_s, count, load->place);
    load->end = self->ticks + count;
}

/* At the end of an inner period. */
static void look_at_switches(InnerLoops *self)
{
    const MotorState *shaft = &self->shaft;
    bool coupled = self->mechanism.coupled;
    double speed_rad_s = coupled ? self->load_side.speed_rad_s : shaft->speed_rad_s;
    double ahead_rad = shaft->angle_rad - (coupled ? self->load_side.twist_rad : 0.0);
    double now_s = (double)(self->ticks + 1) * self->motor.period_s;
    watch_switches(&self->switched, &self->switches, shaft->turns + ahead_rad * PER_TURN, speed_rad_s * PER_TURN, now_s,
                   self->motor.period_s);
}

static void run(InnerLoops *self, int64_t ticks)
{
    self->asked = 0;
    double electrical_ratio = ratio_of_angles(self); /* nobody writes the commutation meanwhile */
    for (; ticks > 0; ticks--) {
        if (self->load.table.points > 0) {
            if (self->ticks >= self->load.end)
                look_up_loads(self, LOADS_AT_ONCE);
            int64_t place = self->ticks + LOADS_AT_ONCE - self->load.end;
            assert(place >= 0 && place < LOADS_AT_ONCE);
            self->demand.load_nm = self->load.loads_nm[place];
        }
        drive_motor(self, self->demand.load_nm);
        if (self->switches.active)
            look_at_switches(self);
        run_firmware(self, electrical_ratio);
        self->ticks++;
    }
}

/* a b / c, rounded down; a b may leave 64 bits: a day at 100 kHz does. */
static int64_t scaled(int64_t a, int64_t b, int64_t c)
{
    __int128 product = (__int128)a * b;
    __int128 quotient = product / c;
    return (int64_t)(quotient * c > product ? quotient - 1 : quotient);
}

static int64_t ticks_due(const InnerLoops *self, int64_t now_ns)
{
    return scaled(now_ns - self->power_on_ns, self->rate_hz, NS_PER_S) - self->ticks;
}

/* Runs every tick up to and including now_ns; whether there was one. */
bool advance_to(InnerLoops *self, int64_t now_ns)
{
    int64_t due = ticks_due(self, now_ns);
    if (due <= 0)
        return false;
    run(self, due);
    return true;
}

/* Runs the ticks up to the next of the motion grid, or to now_ns if that comes first; whether the grid was
   reached. */
bool advance_to_motion_tick(InnerLoops *self, int64_t now_ns)
{
    int64_t due = ticks_due(self, now_ns);
    int64_t missing = self->motion_ticks - self->ticks % self->motion_ticks;
    int64_t ticks = due < missing ? due : missing;
    if (ticks > 0)
        run(self, ticks);
    return due >= missing;
}

/* The instant of the last tick, ns rounded down: when the actual values were sampled. */
int64_t tick_at(const InnerLoops *self)
{
    return self->power_on_ns + scaled(self->ticks, NS_PER_S, self->rate_hz);
}

/* The instant of the next tick at or after now_ns, ns rounded up. */
int64_t tick_after(const InnerLoops *self, int64_t now_ns)
{
    int64_t ticks = -scaled(self->power_on_ns - now_ns, self->rate_hz, NS_PER_S);
    return self->power_on_ns - scaled(-ticks, NS_PER_S, self->rate_hz);
}

/* The torque demand in force now: a set-point counts from the instant at which it was written, the speed loop's
   demand from the tick that computed it. N m, inside its limits. */
double torque_in_force(InnerLoops *self)
{
    if (self->demand.control == CONTROL_TORQUE && self->asked)
        return torque_demand(self);
    return self->demand.control == CONTROL_OFF ? 0.0 : self->state.torque_demand_nm;
}
