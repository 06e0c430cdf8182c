"""A PID speed loop on the host for a drive behind a bus, by a rule.

    L(s) = Kp (1 + 1/(Ti s) + Td s/(1 + Tf s)) e^(-tau s) T_i(s)/(J s + B)

T_i: the closed current loop, torque demand to torque; tau: from the reading's instant to the torque, half a
period of holding included. The rule:

1. Td = 1/w_i, w_i the crossover of the current loop: the zero cancels its lag; Tf = one period.
2. Ti = ratio/w_c: the integral costs atan(1/ratio) of phase at the crossover w_c. A large ratio lets a step
   that meets the torque limit pass with little in the integral.
3. w_c is the highest frequency at which the loop keeps the required phase margin; Kp makes |L| = 1 there.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.margins import Margins, margins_of
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import Array, ComplexArray, StateSpace

_LOWEST_RAD_S = 1e-2
"""Below every crossover of a speed loop: for delays of 1 to 60 ms any start up to 10 rad/s gives the same
gains and margins."""
Loop = Callable[[Array], ComplexArray]


@dataclass(frozen=True, slots=True)
class SpeedPid:
    """Kp, N m per rad/s, Ki = Kp/Ti, N m/rad, Kd = Kp Td, N m s^2/rad, Tf, s, and the resulting figures."""

    proportional_nm_s_rad: float
    integral_nm_rad: float
    derivative_nm_s2_rad: float
    derivative_filter_s: float
    crossover_rad_s: float
    dead_time_s: float
    margins: Margins


def first_order_current_loop(bandwidth_rad_s: float) -> StateSpace:
    """Return T_i of a drive whose current loops are PI with that bandwidth."""
    w = np.array([[bandwidth_rad_s]])
    return StateSpace(-w, w, np.ones((1, 1)), np.zeros((1, 1)))


def pid_by_rule(
    motor: PmsmParameters,
    T_i: StateSpace,
    current_crossover_rad_s: float,
    period_s: float,
    latency_s: float,
    phase_margin_deg: float = 50.0,
    ratio: float = 40.0,
) -> SpeedPid:
    """Apply the rule above; ``latency_s``: reading to torque, without the hold.

    Raises InfeasibleDesign where no frequency has that much phase left.
    """
    Td, Tf, tau = 1.0 / current_crossover_rad_s, period_s, latency_s + 0.5 * period_s

    def shaft(s: ComplexArray) -> ComplexArray:
        return np.asarray(motor.inertia_kg_m2 * s + motor.viscous_friction_nm_s, dtype=complex)

    def pid(s: ComplexArray, w_c: float) -> ComplexArray:
        return np.asarray(1.0 + w_c / (ratio * s) + Td * s / (1.0 + Tf * s), dtype=complex)

    def shape(w_c: float) -> Loop:
        def L(omega: Array) -> ComplexArray:
            s = _imaginary(omega)
            return np.asarray(pid(s, w_c) * np.exp(-tau * s) * T_i.at(s)[:, 0, 0] / shaft(s), dtype=complex)

        return L

    def phase_left(log_w: float) -> float:
        """Return the phase left, part by part, so that no turn is lost: PID and shaft stay within 90 degrees,
        T_i begins at 0."""
        w = math.exp(log_w)
        s = _imaginary(np.logspace(math.log10(w) - 6.0, math.log10(w), 300))
        inner = np.unwrap(np.angle(T_i.at(s)[:, 0, 0]))[-1]
        outer = np.angle(pid(s[-1:], w))[0] - np.angle(shaft(s[-1:]))[0] - tau * w
        return float(np.degrees(inner + outer)) + 180.0 - phase_margin_deg

    highest = math.pi / tau
    grid = np.log(np.logspace(math.log10(_LOWEST_RAD_S), math.log10(highest), 400))
    left = np.array([phase_left(float(w)) for w in grid])
    if not np.any(left >= 0.0):
        raise InfeasibleDesign(
            f"a phase margin of {phase_margin_deg:g} degrees",
            f"the best is {left.max() + phase_margin_deg:.1f}",
            "ask for less, give the integral a larger ratio, or shorten the delay",
        )
    k = int(np.flatnonzero(left >= 0.0)[-1])
    w_c = float(np.exp(scipy.optimize.brentq(phase_left, grid[k], grid[k + 1])))
    L = shape(w_c)
    Kp = 1.0 / float(np.abs(L(np.array([w_c]))[0]))
    margins = margins_of(lambda omega: Kp * L(omega), _LOWEST_RAD_S, 10.0 * highest)
    return SpeedPid(Kp, Kp * w_c / ratio, Kp * Td, Tf, w_c, tau, margins)


def _imaginary(omega: Array) -> ComplexArray:
    return np.asarray(1j * omega, dtype=complex)
