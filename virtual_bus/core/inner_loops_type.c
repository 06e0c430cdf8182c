/* Python's InnerLoops (native.pyi): its numbers as attributes, its work as methods. */
#include <string.h>

#include "arguments.h"
#include "inner_loops.h"
#include "types.h"

typedef struct InnerLoopsObject {
    PyObject head;
    PyObject *times, *torques; /* octets that the load table lies in */
    PyObject *cogging, *load_table; /* octets, or NULL */
    InnerLoops loops;
} InnerLoopsObject;

PyTypeObject *inner_loops_type;

InnerLoops *loops_of(PyObject *self) { return &((InnerLoopsObject *)self)->loops; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    InnerLoops *loops = loops_of(self);
    loops->loop.controller_d.order = loops->loop.controller_q.order = -1;
    loops->asked = 1;
    loops->inverter.output_share = loops->phase_amplitude = 1.0;
    loops->rotor.cosine = 1.0; /* of the angle 0 */
    loops->rate_hz = loops->motion_ticks = 1; /* divided by */
    loops->scale = (UserScale){0.0, 1.0, 1.0, 1.0, 0.0, 0.0};
    return self;
}

static void keep_table(InnerLoopsObject *self, PyObject *times, PyObject *torques)
{
    PyObject *before[] = {self->times, self->torques};
    self->times = times;
    self->torques = torques;
    for (int k = 0; k < 2; k++) {
        if (before[k] != NULL)
            Py_DecRef(before[k]);
    }
}

static void keep(PyObject **place, PyObject *octets)
{
    PyObject *before = *place;
    *place = octets;
    if (before != NULL)
        Py_DecRef(before);
}

static void discard(PyObject *self)
{
    PyTypeObject *type = self->type;
    keep_table((InnerLoopsObject *)self, NULL, NULL);
    keep(&((InnerLoopsObject *)self)->cogging, NULL);
    keep(&((InnerLoopsObject *)self)->load_table, NULL);
    PyObject_Free(self);
    Py_DecRef((PyObject *)type);
}

static PyObject *call_advance_to(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    return integer(now, &now_ns) ? PyBool_FromLong(advance_to(loops_of(self), now_ns)) : NULL;
}

static PyObject *call_advance_to_motion_tick(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    return integer(now, &now_ns) ? PyBool_FromLong(advance_to_motion_tick(loops_of(self), now_ns)) : NULL;
}

static PyObject *call_tick_at(PyObject *self, PyObject *none)
{
    (void)none;
    return PyLong_FromLongLong(tick_at(loops_of(self)));
}

static PyObject *call_tick_after(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    return integer(now, &now_ns) ? PyLong_FromLongLong(tick_after(loops_of(self), now_ns)) : NULL;
}

static PyObject *call_torque_in_force(PyObject *self, PyObject *none)
{
    (void)none;
    return PyFloat_FromDouble(torque_in_force(loops_of(self)));
}

/* 6064h as of the last tick, as are the next two. */
static double position_told(InnerLoops *loops)
{
    const UserScale *scale = &loops->scale;
    double counts = loops->state.count - scale->origin;
    return scale->range_span ? ranged_position(scale, counts) : user_position(counts, scale->counts_per_position);
}

/* 606Ch. */
static double velocity_told(InnerLoops *loops)
{
    return clipped(loops->state.speed_measured_rad_s * loops->scale.velocity_per_rad_s, 32);
}

/* 6077h. */
static double torque_told(InnerLoops *loops)
{
    return clipped(loops->state.torque_measured_nm / loops->scale.torque_unit_nm, 16);
}

/* 6074h: what is in force now. */
static double torque_demand_told(InnerLoops *loops)
{
    return clipped(torque_in_force(loops) / loops->scale.torque_unit_nm, 16);
}

static PyObject *call_position_told(PyObject *self, PyObject *none)
{
    (void)none;
    return whole(position_told(loops_of(self)));
}

static PyObject *call_velocity_told(PyObject *self, PyObject *none)
{
    (void)none;
    return whole(velocity_told(loops_of(self)));
}

static PyObject *call_torque_told(PyObject *self, PyObject *none)
{
    (void)none;
    return whole(torque_told(loops_of(self)));
}

static PyObject *call_torque_demand_told(PyObject *self, PyObject *none)
{
    (void)none;
    return whole(torque_demand_told(loops_of(self)));
}

typedef struct ToldNumber {
    PyCFunction call;
    double (*tell)(InnerLoops *);
} ToldNumber;

static const ToldNumber told_numbers[] = {
    {call_position_told, position_told},
    {call_velocity_told, velocity_told},
    {call_torque_told, torque_told},
    {call_torque_demand_told, torque_demand_told},
};

/* Ask a bound method of loops that tells an object's number: 1; 0 if it is something else, -1 for an error. */
int tell_number(PyObject *asked, int64_t *told)
{
    if (asked->type != &PyCFunction_Type)
        return 0;
    PyCFunction function = PyCFunction_GetFunction(asked);
    for (size_t place = 0; place < sizeof told_numbers / sizeof *told_numbers; place++) {
        if (told_numbers[place].call != function)
            continue;
        double value = told_numbers[place].tell(loops_of(PyCFunction_GetSelf(asked)));
        if (value - value != 0.0)
            return whole(value) == NULL ? -1 : 0; /* no number: its error is set */
        *told = (int64_t)value;
        return 1;
    }
    return 0;
}

/* Whether a set-point was cut at the last tick. */
static PyObject *call_is_limited(PyObject *self, PyObject *none)
{
    (void)none;
    return PyBool_FromLong(loops_of(self)->state.limited != 0.0);
}

static PyObject *call_demand_torque(PyObject *self, PyObject *torque_nm)
{
    InnerLoops *loops = loops_of(self);
    if (!number(torque_nm, &loops->demand.torque_nm))
        return NULL;
    loops->asked = 1;
    return nothing();
}

static PyObject *call_ramp_to_speed(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    InnerLoops *loops = loops_of(self);
    double values[3];
    if (!takes(count, 3, "ramp_to_speed") || !numbers(arguments, values, 3))
        return NULL;
    loops->demand.speed_rad_s = values[0];
    loops->demand.acceleration_rad_s2 = values[1];
    loops->demand.torque_feed_nm = values[2];
    loops->demand.control = CONTROL_SPEED;
    loops->commutation.forced = 0; /* a loop needs the rotor's own angle */
    loops->asked = 1;
    return nothing();
}

static PyObject *call_bear(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    InnerLoops *loops = loops_of(self);
    const double *times_s, *torques_nm;
    Py_ssize_t points, torques;
    double from_s;
    if (!takes(count, 4, "bear") || !doubles(arguments[0], &times_s, &points)
        || !doubles(arguments[1], &torques_nm, &torques) || !number(arguments[3], &from_s))
        return NULL;
    int held = PyObject_IsTrue(arguments[2]);
    if (held < 0)
        return NULL;
    if (points != torques || points > INT32_MAX) {
        PyErr_Format(PyExc_ValueError, "%zd times and %zd torques: as many expected", points, torques);
        return NULL;
    }
    Py_IncRef(arguments[0]);
    Py_IncRef(arguments[1]);
    keep_table((InnerLoopsObject *)self, arguments[0], arguments[1]);
    loops->load.table = (LoadTable){times_s, torques_nm, (int)points, held};
    loops->load.from_s = from_s;
    loops->load.place = 0;
    if (points)
        look_up_loads(loops, 0);
    return nothing();
}

static PyObject *call_set_cogging(PyObject *self, PyObject *octets)
{
    const double *torques_nm;
    Py_ssize_t count;
    if (!doubles(octets, &torques_nm, &count))
        return NULL;
    if (count < 2 || count > INT32_MAX) {
        PyErr_Format(PyExc_ValueError, "%zd torques: 2 expected at least", count);
        return NULL;
    }
    Py_IncRef(octets);
    keep(&((InnerLoopsObject *)self)->cogging, octets);
    Mechanism *mechanism = &loops_of(self)->mechanism;
    mechanism->cogging_nm = torques_nm;
    mechanism->cogging_points = (int)count - 1;
    mechanism->cogging_per_rad = mechanism->cogging_points / TURN_RAD;
    return nothing();
}

static PyObject *call_tabulate_errors(PyObject *self, PyObject *none)
{
    (void)none;
    tabulate_errors(&loops_of(self)->encoder);
    return nothing();
}

static PyObject *call_set_load_table(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    const double *table;
    int64_t places, speeds;
    Py_ssize_t given;
    if (!takes(count, 3, "set_load_table") || !integer(arguments[0], &places) || !integer(arguments[1], &speeds)
        || !doubles(arguments[2], &table, &given))
        return NULL;
    if (places < 1 || places > INT16_MAX || speeds < 1 || speeds > INT16_MAX
        || given != places + speeds + places * speeds) {
        PyErr_Format(PyExc_ValueError, "%lld places, %lld speeds, %zd numbers: n, m, n + m + n m expected",
                     (long long)places, (long long)speeds, given);
        return NULL;
    }
    Py_IncRef(arguments[2]);
    keep(&((InnerLoopsObject *)self)->load_table, arguments[2]);
    PlacedLoad *placed = &loops_of(self)->mechanism.placed;
    loops_of(self)->load_side.place = (TablePlace){0, 0};
    placed->places = (int)places;
    placed->speeds = (int)speeds;
    placed->table = table;
    return nothing();
}

static bool switch_number(PyObject *given, int64_t *which)
{
    if (!integer(given, which))
        return false;
    if (*which >= 0 && *which < SWITCHES)
        return true;
    PyErr_Format(PyExc_ValueError, "switch %lld: 0..%d expected", (long long)*which, SWITCHES - 1);
    return false;
}

static PyObject *call_set_switch(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    InnerLoops *loops = loops_of(self);
    int64_t which;
    double turns[2];
    if (!takes(count, 3, "set_switch") || !switch_number(arguments[0], &which) || !numbers(arguments + 1, turns, 2))
        return NULL;
    loops->switches.low_turns[which] = turns[0];
    loops->switches.high_turns[which] = turns[1];
    loops->switched.watched = 0;
    return nothing();
}

static PyObject *call_switch_seen(PyObject *self, PyObject *number)
{
    InnerLoops *loops = loops_of(self);
    int64_t which;
    if (!switch_number(number, &which))
        return NULL;
    double now_s = (double)loops->ticks * loops->motor.period_s;
    return PyBool_FromLong(switch_seen(&loops->switched, &loops->switches, (int)which, now_s));
}

static PyObject *call_set_least_currents(PyObject *self, PyObject *octets)
{
    const double *currents_a;
    Py_ssize_t count;
    FieldControl *field = &loops_of(self)->field;
    if (!doubles(octets, &currents_a, &count))
        return NULL;
    if (count < 2 || count > FIELD_POINTS_MAX) {
        PyErr_Format(PyExc_ValueError, "%zd currents: 2 to %d expected", count, FIELD_POINTS_MAX);
        return NULL;
    }
    memcpy(field->least_d_a, currents_a, (size_t)count * sizeof(double));
    field->points = (int)count;
    return nothing();
}

static PyObject *call_set_controller(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    LoopParameters *loop = &loops_of(self)->loop;
    int64_t axis, order;
    const double *values;
    Py_ssize_t given;
    if (!takes(count, 3, "set_controller") || !integer(arguments[0], &axis) || !integer(arguments[1], &order)
        || !doubles(arguments[2], &values, &given))
        return NULL;
    if (axis < 0 || axis > 1 || order < 0 || order > CONTROLLER_ORDER_MAX || given != 1 + order * (order + 3)) {
        PyErr_Format(PyExc_ValueError, "axis %lld, order %lld, %zd numbers: 0 or 1, 0..%d, 1 + n (n + 3) expected",
                     (long long)axis, (long long)order, given, CONTROLLER_ORDER_MAX);
        return NULL;
    }
    CurrentController *controller = axis == 0 ? &loop->controller_d : &loop->controller_q;
    size_t row = (size_t)order * sizeof(double);
    controller->order = (int)order;
    controller->d = *values++;
    for (int k = 0; k < order; k++, values += order)
        memcpy(controller->a[k], values, row);
    memcpy(controller->b, values, row);
    memcpy(controller->c, values + order, row);
    memcpy(controller->take_back, values + 2 * order, row);
    return nothing();
}

static PyObject *call_advance_motor(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    InnerLoops *loops = loops_of(self);
    double values[4];
    int64_t periods;
    if (!takes(count, 5, "advance_motor") || !numbers(arguments, values, 4) || !integer(arguments[4], &periods))
        return NULL;
    Voltage voltage = {.d = values[0], .q = values[1], .live = 1.0, .turning = values[3]};
    for (; periods > 0; periods--)
        advance_machine(&loops->shaft, &loops->load_side, &loops->motor, &loops->mechanism, voltage, values[2], 0.0);
    return nothing();
}

static PyObject *call_state(PyObject *self, PyObject *none)
{
    (void)none;
    InnerLoops *loops = loops_of(self);
    char octets[sizeof loops->shaft + sizeof loops->load_side + sizeof loops->link + sizeof loops->watched
                + sizeof loops->sensed + sizeof loops->state];
    char *end = octets;
    memcpy(end, &loops->shaft, sizeof loops->shaft);
    end += sizeof loops->shaft;
    memcpy(end, &loops->load_side, sizeof loops->load_side);
    end += sizeof loops->load_side;
    memcpy(end, &loops->link, sizeof loops->link);
    end += sizeof loops->link;
    memcpy(end, &loops->watched, sizeof loops->watched);
    end += sizeof loops->watched;
    memcpy(end, &loops->sensed, sizeof loops->sensed);
    end += sizeof loops->sensed;
    memcpy(end, &loops->state, sizeof loops->state);
    return PyBytes_FromStringAndSize(octets, sizeof octets);
}

static PyMethodDef methods[] = {
    {"advance_to", call_advance_to, METH_O, NULL},
    {"advance_to_motion_tick", call_advance_to_motion_tick, METH_O, NULL},
    {"tick_at", call_tick_at, METH_NOARGS, NULL},
    {"tick_after", call_tick_after, METH_O, NULL},
    {"torque_in_force", call_torque_in_force, METH_NOARGS, NULL},
    {"position_told", call_position_told, METH_NOARGS, NULL},
    {"velocity_told", call_velocity_told, METH_NOARGS, NULL},
    {"torque_told", call_torque_told, METH_NOARGS, NULL},
    {"is_limited", call_is_limited, METH_NOARGS, NULL},
    {"torque_demand_told", call_torque_demand_told, METH_NOARGS, NULL},
    {"demand_torque", call_demand_torque, METH_O, NULL},
    {"ramp_to_speed", (PyCFunction)(void (*)(void))call_ramp_to_speed, METH_FASTCALL, NULL},
    {"bear", (PyCFunction)(void (*)(void))call_bear, METH_FASTCALL, NULL},
    {"set_controller", (PyCFunction)(void (*)(void))call_set_controller, METH_FASTCALL, NULL},
    {"set_cogging", call_set_cogging, METH_O, NULL},
    {"tabulate_errors", call_tabulate_errors, METH_NOARGS, NULL},
    {"set_switch", (PyCFunction)(void (*)(void))call_set_switch, METH_FASTCALL, NULL},
    {"switch_seen", call_switch_seen, METH_O, NULL},
    {"set_load_table", (PyCFunction)(void (*)(void))call_set_load_table, METH_FASTCALL, NULL},
    {"set_least_currents", call_set_least_currents, METH_O, NULL},
    {"advance_motor", (PyCFunction)(void (*)(void))call_advance_motor, METH_FASTCALL, NULL},
    {"state", call_state, METH_NOARGS, NULL},
    {0},
};

#define PLACE(path) offsetof(InnerLoopsObject, loops.path)
#define PARAMETER(group, name) {#name, T_DOUBLE, PLACE(group.name), 0, NULL}
#define NUMBER(name, path) {name, T_DOUBLE, PLACE(path), 0, NULL}

static PyMemberDef members[] = {
    PARAMETER(motor, resistance_ohm),
    PARAMETER(motor, inductance_d_h),
    PARAMETER(motor, inductance_q_h),
    PARAMETER(motor, flux_linkage_wb),
    PARAMETER(motor, pole_pairs),
    PARAMETER(motor, torque_factor),
    PARAMETER(motor, inertia_kg_m2),
    PARAMETER(motor, viscous_friction_nm_s),
    PARAMETER(motor, coulomb_friction_nm),
    PARAMETER(motor, voltage_max_v),
    PARAMETER(motor, period_s),
    PARAMETER(motor, substeps),
    PARAMETER(motor, step_s),
    PARAMETER(motor, torque_constant_nm_a),
    PARAMETER(motor, per_inductance_d),
    PARAMETER(motor, per_inductance_q),
    PARAMETER(motor, per_inertia),
    PARAMETER(motor, per_torque_constant),
    NUMBER("per_period", motor.rate_hz),
    {"saturated", T_INT, PLACE(motor.saturation.active), 0, NULL},
    NUMBER("saturation_per_d", motor.saturation.per_d),
    NUMBER("saturation_per_q", motor.saturation.per_q),
    NUMBER("saturation_magnet_a", motor.saturation.magnet_a),
    NUMBER("saturation_knee_wb2", motor.saturation.knee_wb2),
    NUMBER("saturation_strength", motor.saturation.strength),
    NUMBER("believed_flux_wb", believed.flux_linkage_wb),
    NUMBER("believed_saliency_h", believed.saliency_h),
    NUMBER("believed_resistance_ohm", believed.resistance_ohm),
    NUMBER("believed_inductance_q_h", believed.inductance_q_h),
    NUMBER("believed_inertia_kg_m2", believed.inertia_kg_m2),
    {"field_active", T_INT, PLACE(field.active), 0, NULL},
    NUMBER("field_per_step", field.per_step),
    NUMBER("field_voltage_share", field.voltage_share),
    NUMBER("field_gain", field.gain),
    NUMBER("field_speed_min_rad_s", field.speed_min_rad_s),
    NUMBER("field_floor_a", field.floor_a),
    NUMBER("field_weakest_a", field.weakest_a),
    NUMBER("field_torque_per_wb", field.torque_per_wb),
    NUMBER("field_calm_rad_s", field.calm_rad_s),
    NUMBER("field_calm_steps", field.calm_steps),
    NUMBER("field_fast_steps", field.fast_steps),
    {"mechanism", T_INT, PLACE(mechanism.active), 0, NULL},
    {"coupled", T_INT, PLACE(mechanism.coupled), 0, NULL},
    {"encoder_on_load", T_INT, PLACE(mechanism.encoder_on_load), 0, NULL},
    {"friction_on_load", T_INT, PLACE(mechanism.friction_on_load), 0, NULL},
    PARAMETER(mechanism, per_inertia_rotor),
    PARAMETER(mechanism, per_inertia_load),
    PARAMETER(mechanism, stiffness_nm_rad),
    PARAMETER(mechanism, damping_nm_s),
    PARAMETER(mechanism, half_backlash_rad),
    PARAMETER(mechanism, yield_s),
    PARAMETER(mechanism, backward_more_nm),
    PARAMETER(mechanism, rubs_per_load),
    PARAMETER(mechanism, bristle_nm_rad),
    PARAMETER(mechanism, bristle_nm_s),
    PARAMETER(mechanism, breakaway_more_nm),
    PARAMETER(mechanism, per_stribeck),
    {"placed_load", T_INT, PLACE(mechanism.placed.active), 0, NULL},
    PARAMETER(mechanism.placed, hanging_nm),
    PARAMETER(mechanism.placed, arm_nm),
    PARAMETER(mechanism.placed, arm_per_turn),
    PARAMETER(mechanism.placed, arm_turns),
    PARAMETER(mechanism.placed, repeats_turns),
    {"end_stops", T_INT, PLACE(mechanism.stops.active), 0, NULL},
    NUMBER("stop_negative_turns", mechanism.stops.negative_turns),
    NUMBER("stop_positive_turns", mechanism.stops.positive_turns),
    NUMBER("stop_stiffness_nm_rad", mechanism.stops.stiffness_nm_rad),
    NUMBER("stop_damping_nm_s", mechanism.stops.damping_nm_s),
    NUMBER("stop_yield_s", mechanism.stops.yield_s),
    {"torque_path", T_INT, PLACE(path.active), 0, NULL},
    NUMBER("torque_step_nm", path.step_nm),
    PARAMETER(path, low_gain),
    PARAMETER(path, notch_b0),
    PARAMETER(path, notch_b1),
    PARAMETER(path, notch_b2),
    PARAMETER(path, notch_a1),
    PARAMETER(path, notch_a2),
    {"switches", T_INT, PLACE(switches.active), 0, NULL},
    NUMBER("switch_bounce_s", switches.bounce_s),
    {"switch_bounces", T_INT, PLACE(switches.bounces), 0, NULL},
    NUMBER("switch_filter_s", switches.filter_s),
    {"switch_seed", T_LONGLONG, PLACE(switches.seed), 0, NULL},
    {"supplied", T_INT, PLACE(dc_link.active), 0, NULL},
    {"feeds_back", T_INT, PLACE(dc_link.feeds_back), 0, NULL},
    PARAMETER(dc_link, source_v),
    PARAMETER(dc_link, source_siemens),
    PARAMETER(dc_link, capacitance_f),
    PARAMETER(dc_link, chopper_siemens),
    PARAMETER(dc_link, chopper_on_v),
    PARAMETER(dc_link, chopper_off_v),
    PARAMETER(dc_link, idle_w),
    PARAMETER(dc_link, circle_share),
    NUMBER("link_steps", dc_link.steps),
    NUMBER("link_step_s", dc_link.step_s),
    NUMBER("link_v", link.volts),
    PARAMETER(link, chopping),
    PARAMETER(link, supplied_j),
    PARAMETER(link, chopped_j),
    NUMBER("phase_amplitude", phase_amplitude),
    {"sensors", T_INT, PLACE(sensors.active), 0, NULL},
    NUMBER("sensor_scale_a", sensors.scale_a),
    NUMBER("sensor_scale_b", sensors.scale_b),
    NUMBER("sensor_offset_a", sensors.offset_a),
    NUMBER("sensor_offset_b", sensors.offset_b),
    NUMBER("sensor_range_a", sensors.range_a),
    NUMBER("sensor_step_a", sensors.step_a),
    NUMBER("sensor_noise_a", sensors.noise_a),
    NUMBER("sensor_delay_share", sensors.delay_share),
    {"sensor_seed", T_LONGLONG, PLACE(sensors.seed), 0, NULL},
    PARAMETER(inverter, dead_share),
    PARAMETER(inverter, zero_band_a),
    PARAMETER(inverter, output_share),
    {"protected", T_INT, PLACE(protection.active), 0, NULL},
    PARAMETER(protection, over_v),
    PARAMETER(protection, under_v),
    PARAMETER(protection, over_a2),
    PARAMETER(protection, continuous_a),
    PARAMETER(protection, continuous_a2),
    PARAMETER(protection, overload_max_a2s),
    PARAMETER(protection, warning_a2s),
    PARAMETER(protection, clear_a2s),
    PARAMETER(protection, winding_max_c),
    PARAMETER(protection, missing_max),
    {"overload_trips", T_INT, PLACE(protection.overload_trips), 0, NULL},
    NUMBER("watch_period_s", protection.period_s),
    {"stage_heats", T_INT, PLACE(protection.stage_heats), 0, NULL},
    PARAMETER(protection, stage_share),
    PARAMETER(protection, ambient_c),
    PARAMETER(protection, rise_k_a2),
    PARAMETER(protection, stage_max_c),
    PARAMETER(protection, stage_clear_c),
    PARAMETER(protection, derate_from_c),
    PARAMETER(protection, derate_a_k),
    PARAMETER(watched, overload_a2s),
    PARAMETER(watched, limiting),
    PARAMETER(watched, warning),
    PARAMETER(watched, winding_c),
    PARAMETER(watched, stage_c),
    PARAMETER(watched, derated),
    {"trip", T_INT, PLACE(watched.trip), 0, NULL},
    {"commutation_active", T_INT, PLACE(commutation.active), 0, NULL},
    {"lines_mirrored", T_INT, PLACE(commutation.mirrored), 0, NULL},
    {"angle_forced", T_INT, PLACE(commutation.forced), 0, NULL},
    NUMBER("commutation_pole_pairs", commutation.pole_pairs),
    NUMBER("commutation_ahead_rad", commutation.ahead_rad),
    NUMBER("forced_rad", commutation.forced_rad),
    PARAMETER(resolution, counts),
    PARAMETER(resolution, counts_per_rad),
    PARAMETER(resolution, rad_per_count),
    {"encoder_active", T_INT, PLACE(encoder.active), 0, NULL},
    {"encoder_distorted", T_INT, PLACE(encoder.distorted), 0, NULL},
    {"encoder_sines", T_INT, PLACE(encoder.sines), 0, NULL},
    {"speed_method", T_INT, PLACE(encoder.method), 0, NULL},
    PARAMETER(encoder, lines),
    PARAMETER(encoder, sine_offset),
    PARAMETER(encoder, cosine_offset),
    PARAMETER(encoder, sine_in_phase),
    PARAMETER(encoder, sine_across),
    PARAMETER(encoder, eccentricity_rad),
    PARAMETER(encoder, eccentricity_phase_rad),
    PARAMETER(encoder, delay_share),
    PARAMETER(encoder, timer_hz),
    PARAMETER(encoder, observer_position_gain),
    PARAMETER(encoder, observer_speed_gain),
    {"encoder_loses", T_INT, PLACE(encoder.loses), 0, NULL},
    PARAMETER(encoder, dirt_from),
    PARAMETER(encoder, dirt_width),
    NUMBER("counts_lost", sensed.lost),
    NUMBER("counts_missing", sensed.missing),
    PARAMETER(loop, gain_d),
    PARAMETER(loop, gain_q),
    PARAMETER(loop, integral_gain),
    PARAMETER(loop, per_gain_d),
    PARAMETER(loop, per_gain_q),
    PARAMETER(loop, decouple_d_h),
    PARAMETER(loop, decouple_q_h),
    PARAMETER(loop, speed_filter),
    PARAMETER(loop, speed_gain),
    PARAMETER(loop, speed_integral_gain),
    PARAMETER(loop, speed_limit_gain),
    PARAMETER(loop, rest_speed_rad_s),
    PARAMETER(loop, brake_nm),
    PARAMETER(loop, brake_open_ticks),
    PARAMETER(loop, brake_close_ticks),
    PARAMETER(loop, brake_drag_nm),
    {"brake_order", T_INT, PLACE(loop.brake_order), 0, NULL},
    {"encoder_held", T_INT, PLACE(loop.encoder_held), 0, NULL},
    PARAMETER(shaft, current_d_a),
    PARAMETER(shaft, current_q_a),
    PARAMETER(shaft, speed_rad_s),
    PARAMETER(shaft, angle_rad),
    PARAMETER(shaft, turns),
    NUMBER("load_speed_rad_s", load_side.speed_rad_s),
    NUMBER("twist_rad", load_side.twist_rad),
    NUMBER("bristle_rad", load_side.bristle_rad),
    NUMBER("stop_touched", load_side.stop),
    NUMBER("stop_hits", load_side.hits),
    NUMBER("stop_hit_rad_s", load_side.hit_rad_s),
    NUMBER("voltage_d_v", state.now.voltage_d_v),
    NUMBER("voltage_q_v", state.now.voltage_q_v),
    NUMBER("next_voltage_d_v", state.next.voltage_d_v),
    NUMBER("next_voltage_q_v", state.next.voltage_q_v),
    PARAMETER(state, count),
    PARAMETER(state, speed_measured_rad_s),
    PARAMETER(state, current_d_measured_a),
    PARAMETER(state, current_q_measured_a),
    PARAMETER(state, torque_measured_nm),
    PARAMETER(state, torque_demand_nm),
    PARAMETER(state, speed_demand_rad_s),
    PARAMETER(state, rest_ticks),
    PARAMETER(state, weaker_a),
    PARAMETER(state, limited),
    PARAMETER(state, braked),
    PARAMETER(state, brake_holds),
    {"control", T_INT, PLACE(state.control), READONLY, NULL},
    {"wanted_control", T_INT, PLACE(demand.control), 0, NULL},
    PARAMETER(demand, torque_up_nm),
    PARAMETER(demand, torque_down_nm),
    PARAMETER(demand, current_max_a),
    PARAMETER(demand, speed_max_rad_s),
    PARAMETER(demand, load_nm),
    PARAMETER(scale, origin),
    PARAMETER(scale, counts_per_position),
    PARAMETER(scale, velocity_per_rad_s),
    PARAMETER(scale, torque_unit_nm),
    PARAMETER(scale, range_low),
    PARAMETER(scale, range_span),
    {"asked", T_INT, PLACE(asked), 0, NULL},
    {"power_on_ns", T_LONGLONG, PLACE(power_on_ns), 0, NULL},
    {"rate_hz", T_LONGLONG, PLACE(rate_hz), 0, NULL},
    {"ticks", T_LONGLONG, PLACE(ticks), READONLY, NULL},
    {"motion_ticks", T_LONGLONG, PLACE(motion_ticks), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec inner_loops_spec = {
    .name = "servobench.virtual_bus.core.native.InnerLoops",
    .basicsize = sizeof(InnerLoopsObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
