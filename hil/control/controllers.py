"""Speed controllers: a state estimate and a reference in, a torque out.

What the loop asks of each is :class:`servobench.hil.loop.protocol.Controller`. For a drive that closes more
than its current loop: a position loop over its speed mode, and streams of set-points.

    reference position --> P --+--> speed set-point --> the drive's speed loop --> shaft
    its rate ------------------'

A sampled controller in state space, as H-infinity synthesis finds it, on the speed error.

    u_k = C x_k + D e_k + ff_k           e_k = omega*(delayed) - omega_k
    x_k+1 = A x_k + B e_k + L (s_k - ff_k)      s_k: the command as it was sent, after all limits

What a limit cuts off, the states know: A has only poles that decay, so nothing winds up. The feed-forward
carries friction and inertia along the reference; the error is taken to the reference as it was when the
commands were given that a reading tells of, so a ramp makes none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.hil.loop.protocol import (
    Context,
    Controller,
    PositionSetPoint,
    SetPoint,
    SpeedSetPoint,
    TorqueSetPoint,
)
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.scenario import Quantity


@dataclass(frozen=True, slots=True)
class PidGains:
    """Parallel form: u = Kp e + Ki int(e) - Kd s/(1 + s Tf) omega + Bff omega*."""

    proportional_nm_s_rad: float
    integral_nm_rad: float
    derivative_nm_s2_rad: float = 0.0
    derivative_filter_s: float = 0.002
    """Tf: time constant of the derivative's first-order filter."""
    anti_windup_s: float | None = None
    """Tt of back-calculation; None: Kp/Ki."""
    feedforward_nm_s_rad: float = 0.0
    """Bff: torque per reference speed, usually the viscous friction."""


class Pid(Controller):
    """PID with the derivative on the measurement, filtered, and back-calculation against windup.

    While the drive does not follow, the integral is frozen: it holds the load, and the reference is the speed
    of the shaft. Else it advances by backward Euler; the torque that the limits cut off is
    fed back into it with time constant Tt (Astrom and Hagglund, Advanced PID
    Control, 2006, 3.5). The derivative is taken between the instants at which the
    estimates are valid, so a dropout neither repeats nor inflates it.
    """

    def __init__(self, gains: PidGains, period_s: float) -> None:
        self._gains = gains
        self._period_s = period_s
        tracking_s = gains.anti_windup_s
        if tracking_s is None and gains.integral_nm_rad > 0.0:
            tracking_s = gains.proportional_nm_s_rad / gains.integral_nm_rad
        # Slower than one period: a faster correction would overshoot the limit it corrects for.
        self._tracking_gain = period_s / max(tracking_s, period_s) if tracking_s else 0.0
        self._integral_nm = 0.0
        self._derivative_nm = 0.0
        self._error_rad_s = 0.0
        self._demand_nm = 0.0
        self._last: StateEstimate | None = None

    def output(self, context: Context) -> SetPoint:
        gains, estimate, reference_rad_s = self._gains, context.estimate, context.reference_rad_s
        self._error_rad_s = reference_rad_s - estimate.velocity_rad_s
        self._demand_nm = (
            gains.proportional_nm_s_rad * self._error_rad_s
            + self._integral_nm
            + self._next_derivative(estimate)
            + gains.feedforward_nm_s_rad * reference_rad_s
        )
        return TorqueSetPoint(self._demand_nm)

    def update(self, context: Context, command: Command) -> None:
        estimate = context.estimate
        self._derivative_nm = self._next_derivative(estimate)
        self._last = estimate
        if not context.follows:
            return
        self._integral_nm += (
            self._gains.integral_nm_rad * self._period_s * self._error_rad_s
            + self._tracking_gain * (command.torque_nm - self._demand_nm)
        )

    def _next_derivative(self, estimate: StateEstimate) -> float:
        last = self._last
        if self._gains.derivative_nm_s2_rad == 0.0 or last is None or estimate.valid_at <= last.valid_at:
            return self._derivative_nm
        step_s = (estimate.valid_at - last.valid_at) / NS_PER_S
        change = self._gains.derivative_nm_s2_rad * (last.velocity_rad_s - estimate.velocity_rad_s)
        filter_s = self._gains.derivative_filter_s
        return (filter_s * self._derivative_nm + change) / (filter_s + step_s)


class StateFeedback(Controller):
    """Static state feedback in error coordinates, [Ling2012] (2.4), (2.6) and (2.14).

        x = [i_q* - i_q, omega* - omega]     u = i_qr* - i_qr = K x

    ``gain``: K = [K1 (A/A), K2 (A s/rad)]. The reference current i_q* = i_qr* carries the
    friction at the reference speed and a known load:
    K_t i_q* = feedforward_load_nm + viscous_friction omega*. A step of the
    reference therefore needs no integral action, a step of the load leaves an error. K3 (A/rad), if
    there is one, acts on the integral of the speed error, summed once a period, and not while a
    limit cuts the torque off or the drive does not follow.
    """

    def __init__(
        self,
        gain: tuple[float, ...],
        torque_constant_nm_a: float,
        viscous_friction_nm_s: float,
        feedforward_load_nm: float = 0.0,
        period_s: float = 0.0,
    ) -> None:
        self._gain = (gain[0], gain[1])
        self._integral_gain_a_rad = gain[2] if len(gain) == 3 else 0.0
        self._period_s = period_s
        self._integral_rad = 0.0
        self._error_rad_s = 0.0
        self._demand_nm = 0.0
        self._torque_constant_nm_a = torque_constant_nm_a
        self._viscous_friction_nm_s = viscous_friction_nm_s
        self._feedforward_load_nm = feedforward_load_nm

    def output(self, context: Context) -> SetPoint:
        estimate, reference_rad_s = context.estimate, context.reference_rad_s
        constant = self._torque_constant_nm_a
        steady_nm = self._feedforward_load_nm + self._viscous_friction_nm_s * reference_rad_s
        current_error_a = (steady_nm - estimate.torque_nm) / constant
        speed_error_rad_s = reference_rad_s - estimate.velocity_rad_s
        correction_a = self._gain[0] * current_error_a + self._gain[1] * speed_error_rad_s
        if self._integral_gain_a_rad == 0.0:
            return TorqueSetPoint(steady_nm - constant * correction_a)
        correction_a += self._integral_gain_a_rad * self._integral_rad
        self._error_rad_s = speed_error_rad_s
        self._demand_nm = steady_nm - constant * correction_a
        return TorqueSetPoint(self._demand_nm)

    def update(self, context: Context, command: Command) -> None:
        """Advance the integral; without one there is nothing to advance."""
        if self._integral_gain_a_rad != 0.0 and context.follows and command.torque_nm == self._demand_nm:
            self._integral_rad += self._period_s * self._error_rad_s


class PositionLoop(Controller):
    """omega_set = K (theta*(t_s) - theta(t_s)) + F omega*(t_a + lead).

    t_s is the instant of the estimate, so a steady speed leaves no error however old the reading is; t_a that
    at which the command acts. ``lead``: what the drive takes from there until its shaft has the speed.
    """

    def __init__(self, gain_per_s: float, feedforward: float, lead: Duration) -> None:
        self._gain_per_s = gain_per_s
        self._feedforward = feedforward
        self._lead = lead

    def output(self, context: Context) -> SetPoint:
        speed = self._feedforward * context.reference_rate_at(Instant(context.acts_at + self._lead))
        estimate = context.estimate
        if estimate.sequence > 0:
            asked_rad = context.reference_at(estimate.valid_at)
            speed += self._gain_per_s * (asked_rad - estimate.position_rad)
        return SpeedSetPoint(speed)


class SetPointStream(Controller):
    """The reference itself, at the instant for which the drive takes a set-point.

    A torque or speed is in force once it acts. A position is reached an interpolation period, 60C2h, later.
    """

    def __init__(self, quantity: Quantity, period: Duration) -> None:
        self._quantity = quantity
        self._period = period

    def output(self, context: Context) -> SetPoint:
        if self._quantity is Quantity.POSITION:
            return PositionSetPoint(context.reference_at(Instant(context.acts_at + self._period)))
        asked = context.reference_at(context.acts_at)
        return SpeedSetPoint(asked) if self._quantity is Quantity.SPEED else TorqueSetPoint(asked)


class HinfFeedback(Controller):
    """``states``: A, (n, n), of any entries; those that are 0 cost nothing.

    ``inputs``: B, (n,), of the speed error, rad/s; ``sent_inputs``: L, (n,), of the command that was sent,
    N m; ``outputs``: C, (n,), N m; ``direct``: D, N m per rad/s. ``answer_periods``: from a reading to where
    the speed of a later one has answered to its command.
    """

    def __init__(
        self,
        states: Sequence[Sequence[float]],
        inputs: Sequence[float],
        sent_inputs: Sequence[float],
        outputs: Sequence[float],
        direct: float,
        inertia_kg_m2: float,
        viscous_friction_nm_s: float,
        answer_periods: float,
    ) -> None:
        self._inputs = list(inputs)
        self._sent_inputs = list(sent_inputs)
        self._outputs = list(outputs)
        self._direct = direct
        self._order = len(outputs)
        self._diagonal = [row[place] for place, row in enumerate(states)]
        self._places: list[int] = []
        self._gains: list[float] = []
        self._ends: list[int] = []
        for place, row in enumerate(states):
            for other, gain in enumerate(row):
                if gain != 0.0 and other != place:
                    self._places.append(other)
                    self._gains.append(gain)
            self._ends.append(len(self._places))
        self._inertia = inertia_kg_m2
        self._friction = viscous_friction_nm_s
        self._whole = int(answer_periods)
        self._part = answer_periods - self._whole
        self._begin()

    def _begin(self) -> None:
        self._state = [0.0] * self._order
        self._error_rad_s = 0.0
        self._forward_nm = 0.0
        self._references: list[float] = []
        """The last ones, as a ring; empty before the first cycle."""
        self._newest = 0

    def reset(self) -> None:
        self._begin()

    def channels(self) -> Sequence[str]:
        return ("feedback_error_rad_s",)

    def output(self, context: Context) -> SetPoint:
        ahead = context.preview(1)
        reference = ahead[0]
        if not self._references:
            self._references = [reference] * (self._whole + 2)
        error = self._answered(reference) - context.estimate.velocity_rad_s
        period_s = context.period / NS_PER_S
        forward = self._friction * reference + self._inertia * (ahead[1] - reference) / period_s
        torque, state, outputs = self._direct * error, self._state, self._outputs
        for place in range(self._order):
            torque += outputs[place] * state[place]
        self._error_rad_s, self._forward_nm = error, forward
        return TorqueSetPoint(torque + forward)

    def _answered(self, reference: float) -> float:
        """The reference of ``answer_periods`` ago, between two cycles in proportion."""
        ring, size = self._references, self._whole + 2
        later = reference if self._whole == 0 else ring[(self._newest - self._whole + 1) % size]
        earlier = ring[(self._newest - self._whole) % size]
        return later + self._part * (earlier - later)

    def update(self, context: Context, command: Command) -> None:
        error, sent, state = self._error_rad_s, command.torque_nm - self._forward_nm, self._state
        inputs, sent_inputs, diagonal = self._inputs, self._sent_inputs, self._diagonal
        places, gains, ends, entry = self._places, self._gains, self._ends, 0
        after: list[float] = []
        for place in range(self._order):
            value = diagonal[place] * state[place] + inputs[place] * error + sent_inputs[place] * sent
            end = ends[place]
            while entry < end:
                value += gains[entry] * state[places[entry]]
                entry += 1
            after.append(value)
        self._state = after
        self._newest = (self._newest + 1) % (self._whole + 2)
        self._references[self._newest] = context.reference_rad_s

    def telemetry(self) -> Sequence[float]:
        return [self._error_rad_s]
