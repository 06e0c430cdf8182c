"""The compiled heart of the simulated drive: motor, mechanics and the inner control loops.

Everything compiled stands in this one file, because numba's cache notices a change only in the
file that holds the compiled function. :mod:`virtual_bus.drive.firmware` fills the arrays and gives the
numbers their names.

Arrays of float64: a state (indices ``S_*``), machine and gains (``P_*``), what the drive's upper
layer asks for (``D_*``). Only +, -, *, / and sqrt occur, no library sine and no fused or reordered
arithmetic, so a run gives the same bits on every IEEE 754 machine.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from design.kept_code import kept

FloatArray = NDArray[np.float64]
Motion = tuple[float, float, float, float, float]
"""i_d, i_q, omega, v_d, v_q: A, A, rad/s, V, V."""
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """numba without fastmath.

    Without numba's reference counts: nothing here makes an array; counting took half of the time.
    """
    return kept(function, error_model="numpy", _nrt=False)


# State: motor and mechanics
S_CURRENT_D, S_CURRENT_Q, S_SPEED, S_ANGLE, S_TURNS = 0, 1, 2, 3, 4
# State: inverter; the voltage being applied, and the one computed for the next period
S_ON, S_VOLTAGE_D, S_VOLTAGE_Q, S_VOLTAGE_ANGLE = 5, 6, 7, 8
S_NEXT_ON, S_NEXT_D, S_NEXT_Q, S_NEXT_ANGLE = 9, 10, 11, 12
# State: firmware
S_INTEGRAL_D, S_INTEGRAL_Q, S_COUNT, S_SPEED_MEASURED = 13, 14, 15, 16
S_D_MEASURED, S_Q_MEASURED, S_TORQUE_MEASURED, S_TORQUE_DEMAND = 17, 18, 19, 20
S_SPEED_DEMAND, S_SPEED_INTEGRAL, S_REST_TICKS, S_CONTROL, S_LIMITED, S_BRAKED = 21, 22, 23, 24, 25, 26
# State: of a current controller in state space, d and q
S_CONTROLLER_D, S_CONTROLLER_Q, S_CONTROLLER_OLD = 27, 35, 43
STATE_SIZE = 51

P_RESISTANCE, P_INDUCTANCE_D, P_INDUCTANCE_Q, P_FLUX, P_POLE_PAIRS, P_TORQUE_FACTOR = 0, 1, 2, 3, 4, 5
P_INERTIA, P_VISCOUS, P_COULOMB, P_VOLTAGE_MAX = 6, 7, 8, 9
P_PERIOD, P_SUBSTEPS, P_COUNTS = 10, 11, 12
P_GAIN_D, P_GAIN_Q, P_INTEGRAL_GAIN = 13, 14, 15
P_SPEED_FILTER, P_SPEED_GAIN, P_SPEED_INTEGRAL_GAIN, P_SPEED_LIMIT_GAIN = 16, 17, 18, 19
P_REST_SPEED, P_BRAKE = 20, 21
# Reciprocals: a division costs as much as ten products.
P_PER_INDUCTANCE_D, P_PER_INDUCTANCE_Q, P_PER_INERTIA, P_STEP = 22, 23, 24, 25
P_RATE, P_TORQUE_CONSTANT, P_PER_TORQUE_CONSTANT, P_PER_GAIN_D, P_PER_GAIN_Q = 26, 27, 28, 29, 30
P_COUNTS_PER_RAD, P_RAD_PER_COUNT, P_ENCODER_HELD = 31, 32, 33
# Inductances that the drive decouples with, which need not be the motor's
P_DECOUPLE_D, P_DECOUPLE_Q = 34, 35
# Controllers in state space: is there one; of each axis: order, D, and in rows A, B, C, the take-back gain
P_CONTROLLERS, P_CONTROLLER_D = 36, 37
CONTROLLER_ORDER_MAX = 8
CONTROLLER_SIZE = 2 + CONTROLLER_ORDER_MAX * (CONTROLLER_ORDER_MAX + 3)
P_CONTROLLER_Q = P_CONTROLLER_D + CONTROLLER_SIZE
PARAMETERS_SIZE = P_CONTROLLER_Q + CONTROLLER_SIZE

D_CONTROL, D_TORQUE, D_TORQUE_MAX, D_CURRENT_MAX, D_SPEED, D_ACCELERATION, D_SPEED_MAX, D_LOAD = range(8)
D_TORQUE_FEED, DEMAND_SIZE = 8, 9
CONTROL_OFF, CONTROL_TORQUE, CONTROL_SPEED = 0.0, 1.0, 2.0

TURN = 2.0 * math.pi
_PER_TURN = 1.0 / TURN
_BELOW_TURN = math.nextafter(TURN, 0.0)
_SIXTH = 1.0 / 6.0
# pi/2 in two parts: the high one has 33 bits, so that its product with a small whole number is exact.
_HALF_PI_HIGH = float.fromhex("0x1.921fb544p+0")
_PER_HALF_PI = 2.0 / math.pi
_HALF_PI_LOW = float.fromhex("0x1.0b4611a626331p-34")


@compiled
def sine_cosine(angle: float) -> tuple[float, float]:
    """sin and cos of ``angle`` (rad), error below 4e-16 for magnitudes up to 1000: reduction to
    -pi/4..pi/4, then the Taylor polynomials to the 15th and 16th power."""
    quarter = math.floor(angle * _PER_HALF_PI + 0.5)
    x = angle - quarter * _HALF_PI_HIGH - quarter * _HALF_PI_LOW
    y = x * x
    y2 = y * y
    y4 = y2 * y2
    # Estrin's scheme: half as many roundings wait for each other as in Horner's.
    s = (-1.0 / 6.0 + y * (1.0 / 120.0)) + y2 * (-1.0 / 5040.0 + y * (1.0 / 362880.0))
    s = s + y4 * (-1.0 / 39916800.0 + y * (1.0 / 6227020800.0) - y2 * (1.0 / 1307674368000.0))
    s = x + x * y * s
    c = (-0.5 + y * (1.0 / 24.0)) + y2 * (-1.0 / 720.0 + y * (1.0 / 40320.0))
    c = c + y4 * (
        (-1.0 / 3628800.0 + y * (1.0 / 479001600.0))
        - y2 * (1.0 / 87178291200.0 - y * (1.0 / 20922789888000.0))
    )
    c = 1.0 + y * c
    remainder = quarter - 4.0 * math.floor(quarter * 0.25)
    if remainder == 0.0:
        return s, c
    if remainder == 1.0:
        return c, -s
    if remainder == 2.0:
        return -s, -c
    return -c, s


@compiled
def _torque(p: FloatArray, i_d: float, i_q: float) -> float:
    saliency = p[P_INDUCTANCE_D] - p[P_INDUCTANCE_Q]
    return float(p[P_TORQUE_FACTOR] * p[P_POLE_PAIRS] * (p[P_FLUX] + saliency * i_d) * i_q)


@compiled
def _slopes(p: FloatArray, x: Motion, live: float, turning: float, resisting: float, moving: float) -> Motion:
    """d/dt of (i_d, i_q, omega, v_d, v_q). ``live``: 0 freezes the currents; ``turning``: 1 for a voltage
    that stands still in the stator's frame and so turns backwards in the rotor's, 0 for one that stands
    still in the rotor's; ``resisting``: N m of load and Coulomb friction; ``moving``: 0 holds the shaft."""
    i_d, i_q, speed, v_d, v_q = x
    electrical = p[P_POLE_PAIRS] * speed
    flux_d = p[P_INDUCTANCE_D] * i_d + p[P_FLUX]
    flux_q = p[P_INDUCTANCE_Q] * i_q
    slope_d = live * (v_d - p[P_RESISTANCE] * i_d + electrical * flux_q) * p[P_PER_INDUCTANCE_D]
    slope_q = live * (v_q - p[P_RESISTANCE] * i_q - electrical * flux_d) * p[P_PER_INDUCTANCE_Q]
    net = _torque(p, i_d, i_q) - p[P_VISCOUS] * speed - resisting
    backwards = turning * electrical
    return slope_d, slope_q, moving * net * p[P_PER_INERTIA], backwards * v_q, -backwards * v_d


@compiled
def _ahead(x: Motion, k: Motion, h: float) -> Motion:
    return x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4]


@compiled
def _runge_kutta(
    p: FloatArray, x: Motion, live: float, turning: float, resisting: float, moving: float, h: float
) -> tuple[Motion, float]:
    """One classical fourth-order step of ``h`` seconds: the new state, and the angle travelled."""
    k1 = _slopes(p, x, live, turning, resisting, moving)
    x2 = _ahead(x, k1, 0.5 * h)
    k2 = _slopes(p, x2, live, turning, resisting, moving)
    x3 = _ahead(x, k2, 0.5 * h)
    k3 = _slopes(p, x3, live, turning, resisting, moving)
    x4 = _ahead(x, k3, h)
    k4 = _slopes(p, x4, live, turning, resisting, moving)
    w = h * _SIXTH
    new = (
        x[0] + w * (k1[0] + 2.0 * (k2[0] + k3[0]) + k4[0]),
        x[1] + w * (k1[1] + 2.0 * (k2[1] + k3[1]) + k4[1]),
        x[2] + w * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2]),
        x[3] + w * (k1[3] + 2.0 * (k2[3] + k3[3]) + k4[3]),
        x[4] + w * (k1[4] + 2.0 * (k2[4] + k3[4]) + k4[4]),
    )
    return new, w * (x[2] + 2.0 * (x2[2] + x3[2]) + x4[2])


@compiled
def _substep(
    p: FloatArray, x: Motion, live: float, turning: float, load: float, friction: float, h: float
) -> tuple[Motion, float]:
    """``h`` seconds with ``friction`` N m of Coulomb friction: the step is cut where the shaft comes to
    rest, and there it stays as long as the friction holds it. Returns new state and angle travelled."""
    if friction == 0.0:
        return _runge_kutta(p, x, live, turning, load, 1.0, h)
    travelled = 0.0
    for _ in range(4):
        if x[2] != 0.0:
            sign = 1.0 if x[2] > 0.0 else -1.0
        else:
            net = _torque(p, x[0], x[1]) - load
            if abs(net) <= friction:
                break
            sign = 1.0 if net > 0.0 else -1.0
        resisting = load + sign * friction
        new, angle = _runge_kutta(p, x, live, turning, resisting, 1.0, h)
        if new[2] * sign >= 0.0:
            return new, travelled + angle
        if x[2] == 0.0:
            break
        fraction = x[2] / (x[2] - new[2])
        new, angle = _runge_kutta(p, x, live, turning, resisting, 1.0, fraction * h)
        travelled += angle
        x = (new[0], new[1], 0.0, new[3], new[4])
        h *= 1.0 - fraction
    new, _ = _runge_kutta(p, x, live, turning, 0.0, 0.0, h)
    return new, travelled


@compiled
def advance_plant(
    state: FloatArray,
    p: FloatArray,
    v_d: float,
    v_q: float,
    live: float,
    turning: float,
    load: float,
    brake: float,
) -> None:
    """One period of motor and mechanics under the voltage that in the rotor's frame is
    (v_d, v_q) at its start; ``live`` and ``turning`` as in ``_slopes``; ``load`` and ``brake`` N m."""
    friction = p[P_COULOMB] + brake
    h = p[P_STEP]
    x = (state[S_CURRENT_D], state[S_CURRENT_Q], state[S_SPEED], v_d, v_q)
    angle = state[S_ANGLE]
    for _ in range(int(p[P_SUBSTEPS])):
        x, travelled = _substep(p, x, live, turning, load, friction, h)
        angle += travelled
    turns = math.floor(angle * _PER_TURN)
    state[S_CURRENT_D], state[S_CURRENT_Q], state[S_SPEED] = x[0], x[1], x[2]
    # Rounding may leave the angle a hair outside of its turn.
    state[S_ANGLE] = min(max(angle - turns * TURN, 0.0), _BELOW_TURN)
    state[S_TURNS] += turns


@compiled
def _drive_motor(state: FloatArray, p: FloatArray, load: float) -> None:
    """One inner period of the plant under the inverter's present output.

    Inverter off: the diodes drive the current down against the DC link, far faster than R or the back-EMF
    would, so both are left out; back-EMF above the DC link would rectify and is not modelled.
    """
    if state[S_ON] != 0.0:
        s, c = sine_cosine(state[S_VOLTAGE_ANGLE] - p[P_POLE_PAIRS] * state[S_ANGLE])
        v_d = c * state[S_VOLTAGE_D] - s * state[S_VOLTAGE_Q]
        v_q = s * state[S_VOLTAGE_D] + c * state[S_VOLTAGE_Q]
        advance_plant(state, p, v_d, v_q, 1.0, 1.0, load, 0.0)
        return
    i_d, i_q = state[S_CURRENT_D], state[S_CURRENT_Q]
    magnitude = math.sqrt(i_d * i_d + i_q * i_q)
    fall = p[P_VOLTAGE_MAX] * p[P_PERIOD] / max(p[P_INDUCTANCE_D], p[P_INDUCTANCE_Q])
    keep = 1.0 - fall / magnitude if magnitude > fall else 0.0
    state[S_CURRENT_D], state[S_CURRENT_Q] = keep * i_d, keep * i_q
    advance_plant(state, p, 0.0, 0.0, 0.0, 0.0, load, state[S_BRAKED] * p[P_BRAKE])


@compiled
def _sample(state: FloatArray, p: FloatArray) -> float:
    """What the firmware sees at the start of a period: encoder count, filtered speed, dq currents in the
    frame of the encoder's angle, torque. Returns that electrical angle, rad."""
    counts = p[P_COUNTS]
    within_turn = math.floor(state[S_ANGLE] * p[P_COUNTS_PER_RAD])
    count = state[S_TURNS] * counts + within_turn
    if p[P_ENCODER_HELD] != 0.0:
        count = state[S_COUNT]
        within_turn = count - counts * math.floor(count / counts)
    raw_speed = (count - state[S_COUNT]) * p[P_RAD_PER_COUNT] * p[P_RATE]
    state[S_COUNT] = count
    state[S_SPEED_MEASURED] += p[P_SPEED_FILTER] * (raw_speed - state[S_SPEED_MEASURED])
    angle = (within_turn + 0.5) * p[P_RAD_PER_COUNT] * p[P_POLE_PAIRS]
    s, c = sine_cosine(p[P_POLE_PAIRS] * state[S_ANGLE] - angle)
    i_d = c * state[S_CURRENT_D] - s * state[S_CURRENT_Q]
    i_q = s * state[S_CURRENT_D] + c * state[S_CURRENT_Q]
    state[S_D_MEASURED], state[S_Q_MEASURED] = i_d, i_q
    state[S_TORQUE_MEASURED] = _torque(p, i_d, i_q)
    return float(angle)


@compiled
def _speed_loop(state: FloatArray, p: FloatArray, demand: FloatArray, limit: float) -> float:
    """Torque demand of the speed loop: ramped reference with inertia feed-forward, PI without wind-up."""
    step = demand[D_ACCELERATION] * p[P_PERIOD]
    wanted = demand[D_SPEED] - state[S_SPEED_DEMAND]
    change = min(max(wanted, -step), step)
    state[S_SPEED_DEMAND] += change
    error = state[S_SPEED_DEMAND] - state[S_SPEED_MEASURED]
    proportional = p[P_SPEED_GAIN] * error + p[P_INERTIA] * change * p[P_RATE]
    torque = proportional + state[S_SPEED_INTEGRAL] + demand[D_TORQUE_FEED]
    limited = float(min(max(torque, -limit), limit))
    if torque != limited:
        state[S_LIMITED] = 1.0
    else:
        state[S_SPEED_INTEGRAL] += p[P_SPEED_INTEGRAL_GAIN] * p[P_PERIOD] * error
    at_rest = abs(state[S_SPEED_MEASURED]) < p[P_REST_SPEED] and state[S_SPEED_DEMAND] == 0.0
    state[S_REST_TICKS] = state[S_REST_TICKS] + 1.0 if at_rest else 0.0
    return limited


@compiled
def torque_demand(state: FloatArray, p: FloatArray, demand: FloatArray) -> float:
    """The torque to be made, N m, inside every limit; for a torque set-point ``state`` stays as it is.

    The speed limit is a proportional controller on the distance to it, so it bounds the torque towards
    the limit and lets every torque away from it pass.
    """
    limit = min(demand[D_TORQUE_MAX], p[P_TORQUE_CONSTANT] * demand[D_CURRENT_MAX])
    if demand[D_CONTROL] == CONTROL_SPEED:
        if state[S_CONTROL] != CONTROL_SPEED:
            state[S_SPEED_DEMAND] = state[S_SPEED_MEASURED]
            state[S_SPEED_INTEGRAL] = min(max(state[S_TORQUE_DEMAND], -limit), limit)
            state[S_REST_TICKS] = 0.0
        return _speed_loop(state, p, demand, limit)
    up = p[P_SPEED_LIMIT_GAIN] * (demand[D_SPEED_MAX] - state[S_SPEED_MEASURED])
    down = -p[P_SPEED_LIMIT_GAIN] * (demand[D_SPEED_MAX] + state[S_SPEED_MEASURED])
    torque = min(max(demand[D_TORQUE], down), up)
    return float(min(max(torque, -limit), limit))


@compiled
def _voltage(
    state: FloatArray, p: FloatArray, error: float, gain: float, integral: float, first: int, at: int
) -> float:
    """An axis' voltage before decoupling: PI, or C x + D e of the controller whose state begins at ``first``
    and whose parameters begin at ``at``."""
    order = int(p[at])
    if order < 0:
        return float(gain * error + integral)
    row = at + 2 + CONTROLLER_ORDER_MAX * (CONTROLLER_ORDER_MAX + 1)
    voltage = p[at + 1] * error
    for k in range(order):
        voltage += p[row + k] * state[first + k]
    return float(voltage)


@compiled
def _advance_controller(
    state: FloatArray, p: FloatArray, error: float, cut: float, first: int, at: int
) -> None:
    """x = A x + B e + L cut, with ``cut`` V what the limits took off the voltage."""
    order = int(p[at])
    inputs = at + 2 + CONTROLLER_ORDER_MAX * CONTROLLER_ORDER_MAX
    for k in range(order):
        state[S_CONTROLLER_OLD + k] = state[first + k]
    for k in range(order):
        value = p[inputs + k] * error + p[inputs + 2 * CONTROLLER_ORDER_MAX + k] * cut
        for j in range(order):
            value += p[at + 2 + CONTROLLER_ORDER_MAX * k + j] * state[S_CONTROLLER_OLD + j]
        state[first + k] = value


@compiled
def _current_loops(state: FloatArray, p: FloatArray, i_q_wanted: float) -> None:
    """PI or state space in d (to zero) and q with decoupling and back-EMF feed-forward; the voltage circle
    serves d first, and what it cuts off is taken back out of the integrals (no wind-up)."""
    i_d, i_q = state[S_D_MEASURED], state[S_Q_MEASURED]
    electrical = p[P_POLE_PAIRS] * state[S_SPEED_MEASURED]
    error_d, error_q = -i_d, i_q_wanted - i_q
    v_d = _voltage(state, p, error_d, p[P_GAIN_D], state[S_INTEGRAL_D], S_CONTROLLER_D, P_CONTROLLER_D)
    v_q = _voltage(state, p, error_q, p[P_GAIN_Q], state[S_INTEGRAL_Q], S_CONTROLLER_Q, P_CONTROLLER_Q)
    v_d -= electrical * p[P_DECOUPLE_Q] * i_q
    v_q += electrical * (p[P_DECOUPLE_D] * i_d + p[P_FLUX])
    most = p[P_VOLTAGE_MAX]
    out_d = min(max(v_d, -most), most)
    most_q = math.sqrt(most * most - out_d * out_d)
    out_q = min(max(v_q, -most_q), most_q)
    if out_d != v_d or out_q != v_q:
        state[S_LIMITED] = 1.0
    state[S_INTEGRAL_D] += p[P_INTEGRAL_GAIN] * (error_d + (out_d - v_d) * p[P_PER_GAIN_D])
    state[S_INTEGRAL_Q] += p[P_INTEGRAL_GAIN] * (error_q + (out_q - v_q) * p[P_PER_GAIN_Q])
    if p[P_CONTROLLERS] != 0.0:
        _advance_controller(state, p, error_d, out_d - v_d, S_CONTROLLER_D, P_CONTROLLER_D)
        _advance_controller(state, p, error_q, out_q - v_q, S_CONTROLLER_Q, P_CONTROLLER_Q)
    state[S_NEXT_D], state[S_NEXT_Q] = out_d, out_q


@compiled
def _firmware(state: FloatArray, p: FloatArray, demand: FloatArray) -> None:
    """The work of one inner period; its voltage goes out at the next one, turned on to that one's middle.

    Inverter off: the holding brake closes as soon as the shaft is slow, and opens with the inverter on.
    """
    state[S_ON] = state[S_NEXT_ON]
    state[S_VOLTAGE_D], state[S_VOLTAGE_Q] = state[S_NEXT_D], state[S_NEXT_Q]
    state[S_VOLTAGE_ANGLE] = state[S_NEXT_ANGLE]
    angle = _sample(state, p)
    state[S_LIMITED] = 0.0
    if demand[D_CONTROL] == CONTROL_OFF:
        state[S_ON] = state[S_NEXT_ON] = 0.0
        state[S_NEXT_D] = state[S_NEXT_Q] = state[S_INTEGRAL_D] = state[S_INTEGRAL_Q] = 0.0
        state[S_TORQUE_DEMAND] = state[S_REST_TICKS] = 0.0
        for k in range(S_CONTROLLER_D, S_CONTROLLER_OLD):
            state[k] = 0.0
        if abs(state[S_SPEED_MEASURED]) < p[P_REST_SPEED]:
            state[S_BRAKED] = 1.0
    else:
        state[S_BRAKED] = 0.0
        torque = torque_demand(state, p, demand)
        if demand[D_CONTROL] == CONTROL_TORQUE and torque != demand[D_TORQUE]:
            state[S_LIMITED] = 1.0
        state[S_TORQUE_DEMAND] = torque
        _current_loops(state, p, torque * p[P_PER_TORQUE_CONSTANT])
        state[S_NEXT_ON] = 1.0
        state[S_NEXT_ANGLE] = angle + 1.5 * p[P_PERIOD] * p[P_POLE_PAIRS] * state[S_SPEED_MEASURED]
    state[S_CONTROL] = demand[D_CONTROL]


@compiled
def advance_drive(
    s: FloatArray, p: FloatArray, demand: FloatArray, loads: FloatArray, at: int, n: int
) -> None:
    """``n`` inner periods: plant up to the tick, then the firmware's work. ``loads[at:]``: N m, or none."""
    for k in range(at, at + n):
        if len(loads) > 0:
            demand[D_LOAD] = loads[k]
        _drive_motor(s, p, demand[D_LOAD])
        _firmware(s, p, demand)
