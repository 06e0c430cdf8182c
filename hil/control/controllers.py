"""Speed controllers: a state estimate and a reference in, a torque out.

What the loop asks of each is :class:`servobench.hil.loop.axis_roles.Controller`.
"""

from dataclasses import dataclass

from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.loop.axis_roles import Controller
from servobench.hil.loop.context import Context, SetPoint, TorqueSetPoint
from servobench.hil.loop.samples import StateEstimate


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
