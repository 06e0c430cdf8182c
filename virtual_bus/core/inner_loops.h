/* What runs inside the drive at its inner rate: current and speed loops, with the motor behind them. */
#ifndef CORE_INNER_LOOPS_H
#define CORE_INNER_LOOPS_H

#include <stdbool.h>
#include <stdint.h>

#include "actual_values.h"
#include "dc_link.h"
#include "encoder.h"
#include "field.h"
#include "load_table.h"
#include "mechanism.h"
#include "motor.h"
#include "phases.h"
#include "protection.h"
#include "switches.h"
#include "torque_path.h"

enum { CONTROLLER_ORDER_MAX = 8 };
/* Inner periods: the loads of the next 16 ms are looked up at once. */
enum { LOADS_AT_ONCE = 256 };

typedef enum Control { CONTROL_OFF, CONTROL_TORQUE, CONTROL_SPEED } Control;

/* Who decides about the current of the brake's coil. */
typedef enum BrakeOrder { BRAKE_BY_STAGE, BRAKE_SET, BRAKE_RELEASED } BrakeOrder;

/* A current controller in state space, x = A x + B e + L cut, v = C x + D e; cut: V that the limits took off. */
typedef struct CurrentController {
    int order; /* -1: a PI in its place */
    double d;
    double a[CONTROLLER_ORDER_MAX][CONTROLLER_ORDER_MAX];
    double b[CONTROLLER_ORDER_MAX], c[CONTROLLER_ORDER_MAX], take_back[CONTROLLER_ORDER_MAX];
} CurrentController;

typedef struct LoopParameters {
    double gain_d, gain_q, integral_gain, per_gain_d, per_gain_q;
    double decouple_d_h, decouple_q_h; /* need not be the motor's inductances */
    double speed_filter, speed_gain, speed_integral_gain, speed_limit_gain;
    double rest_speed_rad_s, brake_nm;
    double brake_open_ticks, brake_close_ticks; /* from its coil's current until it lets go, or holds */
    double brake_drag_nm; /* of a brake that does not let go wholly */
    int brake_order;      /* BrakeOrder */
    int encoder_held; /* its line is broken: the count stands still */
    CurrentController controller_d, controller_q;
} LoopParameters;

/* The inverter's output: applied from one tick to the next, as the voltage that stands still in the stator's
   frame, at the rotor's electrical angle angle_rad. */
typedef struct Output {
    double on, voltage_d_v, voltage_q_v, angle_rad;
} Output;

/* By which angle the drive turns its currents, where that need not be the rotor's. */
typedef struct Commutation {
    int active;   /* 0: by the encoder's angle, which is right, and nothing of this counts */
    int mirrored; /* two lines of the motor are swapped, and the drive takes them for right, or the other way round */
    int forced;   /* its master says the angle, which is forced_rad */
    double pole_pairs; /* as the drive is set */
    double ahead_rad;  /* of the encoder's angle beyond the rotor's */
    double forced_rad;
} Commutation;

typedef struct LoopState {
    Output now, next;
    double integral_d, integral_q;
    double count; /* encoder */
    double speed_measured_rad_s, current_d_measured_a, current_q_measured_a, torque_measured_nm;
    double torque_demand_nm, speed_demand_rad_s, speed_integral_nm, rest_ticks;
    double weaker_a; /* i_d of the weakening */
    double limited; /* a set-point was cut */
    double braked;                   /* its coil is without current */
    double brake_holds, brake_waits; /* and it does hold; ticks since that is asked otherwise */
    double controller_d[CONTROLLER_ORDER_MAX], controller_q[CONTROLLER_ORDER_MAX];
    int control; /* of the last tick */
} LoopState;

typedef struct Demand {
    int control;
    double torque_nm, current_max_a;
    double torque_up_nm, torque_down_nm; /* most of either sign, both at least 0 */
    double speed_rad_s, acceleration_rad_s2, speed_max_rad_s;
    double load_nm;
    double torque_feed_nm; /* added to what the speed loop asks for */
} Demand;

/* The shaft's load by a table, and what was looked up of it. */
typedef struct TableLoad {
    LoadTable table; /* no points: the load is the demand's */
    double from_s;   /* its time 0, counted from power-on */
    int place;       /* the last point that was passed */
    int64_t end;     /* the first tick beyond those looked up */
    double loads_nm[LOADS_AT_ONCE];
} TableLoad;

typedef struct InnerLoops {
    MotorParameters motor;
    LoopParameters loop;
    TorquePath path;
    TorquePathState shaped;
    Believed believed;
    FieldControl field;
    Resolution resolution; /* of the encoder */
    Encoder encoder;
    Commutation commutation;
    EncoderState sensed;
    MotorState shaft;
    Mechanism mechanism;
    LoadSide load_side;
    Switches switches;
    SwitchState switched;
    DcLink dc_link;
    LinkState link;
    double phase_amplitude; /* A of a phase over A of the motor's transform */
    double rotor_rad;       /* electrical angle at which the currents were sensed, and its sine and cosine */
    SineCosine rotor;
    CurrentSensors sensors;
    SensorState sensor_state;
    Inverter inverter;
    Protection protection;
    ProtectionState watched;
    LoopState state;
    Demand demand;
    TableLoad load;
    UserScale scale;
    int64_t power_on_ns, rate_hz, ticks, motion_ticks;
    int asked; /* a demand was written since the last tick */
} InnerLoops;

bool advance_to(InnerLoops *self, int64_t now_ns);
bool advance_to_motion_tick(InnerLoops *self, int64_t now_ns);
int64_t tick_at(const InnerLoops *self);
int64_t tick_after(const InnerLoops *self, int64_t now_ns);
double torque_in_force(InnerLoops *self);
void look_up_loads(InnerLoops *self, int count);

#endif
