"""A PID speed loop on the host for a drive behind a bus, by a rule.

    L(s) = Kp (1 + 1/(Ti s) + Td s/(1 + Tf s)) e^(-tau s) T_i(s)/(J s + B)

T_i: the closed current loop, torque demand to torque; tau: from the reading's instant to the torque, half a
period of holding included. The rule:

1. Td = 1/w_i, w_i the crossover of the current loop: the zero cancels its lag; Tf = one period.
2. Ti = ratio/w_c: the integral costs atan(1/ratio) of phase at the crossover w_c. A large ratio lets a step
   that meets the torque limit pass with little in the integral.
3. w_c is the highest frequency at which the loop keeps the required phase margin; Kp makes |L| = 1 there.
4. Behind a coupling w_c is lower, if need be: the highest at which the loop is stable, and keeps a modulus
   margin of 0.4, with both resonances where they are and a tenth off. What is told is of that loop.
   Without play.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.optimize

from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.margins import Margins, margins_of
from servobench.design.mechanism import Coupling, Side, speed_responses
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import Array, ComplexArray, StateSpace

_LOWEST_RAD_S = 1e-2
"""Below every crossover of a speed loop: for delays of 1 to 60 ms any start up to 10 rad/s gives the same
gains and margins."""
Loop = Callable[[Array], ComplexArray]
COUPLED_MARGIN: Final = 0.4
"""Modulus margin behind a coupling: a sensitivity below 2.5. A rigid shaft has 0.48."""
COUPLED_RANGE: Final = (0.9, 1.0, 1.1)
"""Of the resonances: what a sheet's stiffness and a belt's tension leave open."""
_TRIED: Final = 80
"""Crossovers on the way down to a hundredth of the rigid shaft's."""


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
    resonance_hz: float | None = None
    """The coupling's, which the crossover and the margins reckon with; None: a rigid shaft."""


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
    coupling = None if motor.mechanism is None else motor.mechanism.coupling
    if coupling is None:
        L = shape(w_c)
        Kp = _gain_at(L, w_c)
        margins = margins_of(lambda omega: Kp * L(omega), _LOWEST_RAD_S, 10.0 * highest)
        return SpeedPid(Kp, Kp * w_c / ratio, Kp * Td, Tf, w_c, tau, margins)
    w_c, margins = _behind(coupling, shape, w_c, 10.0 * highest)
    Kp = _gain_at(shape(w_c), w_c)
    return SpeedPid(Kp, Kp * w_c / ratio, Kp * Td, Tf, w_c, tau, margins, coupling.resonance_hz)


def _gain_at(L: Loop, w_c: float) -> float:
    return 1.0 / float(np.abs(L(np.array([w_c]))[0]))


def _behind(
    coupling: Coupling, shape: Callable[[float], Loop], w_rigid: float, highest: float
) -> tuple[float, Margins]:
    """The highest crossover up to ``w_rigid`` by rule 4, and the margins of its loop. Error:
    InfeasibleDesign."""
    places = [coupling.with_resonance(share) for share in COUPLED_RANGE]
    for w_c in np.geomspace(w_rigid, 0.01 * w_rigid, _TRIED):
        loops = [_flexible(each, shape(float(w_c)), float(w_c)) for each in places]
        if all(_keeps(loop, _grid(each, highest)) for loop, each in zip(loops, places, strict=True)):
            middle = COUPLED_RANGE.index(1.0)
            return float(w_c), margins_of(loops[middle], _LOWEST_RAD_S, highest, _grid(coupling, highest))
    raise InfeasibleDesign(
        f"a modulus margin of {COUPLED_MARGIN:g} behind a coupling",
        f"its resonance at {coupling.resonance_hz:.3g} Hz leaves less",
        "put a notch there, in the drive or in a controller of your own, or shorten the delay",
    )


def _flexible(coupling: Coupling, L: Loop, w_c: float) -> Loop:
    """The whole loop with what the coupling makes of the rigid shaft, at the side that the encoder is on."""
    Kp, inertia_kg_m2 = _gain_at(L, w_c), coupling.motor_kg_m2 + coupling.load_kg_m2

    def whole(omega: Array) -> ComplexArray:
        on_motor, on_load = speed_responses(coupling, omega / math.tau)
        told = on_load if coupling.encoder is Side.LOAD else on_motor
        return np.asarray(Kp * L(omega) * told * 1j * omega * inertia_kg_m2)

    return whole


def _grid(coupling: Coupling, highest: float) -> Array:
    """Frequencies, rad/s, dense around both resonances, whose peaks are narrow."""
    near = np.concatenate([1.0 - np.geomspace(0.5, 1e-4, 120), [1.0], 1.0 + np.geomspace(1e-4, 1.0, 120)])
    peaks = [math.tau * near * hertz for hertz in (coupling.antiresonance_hz, coupling.resonance_hz)]
    return np.unique(np.concatenate([np.geomspace(_LOWEST_RAD_S, highest, 800), *peaks]))


def _keeps(loop: Loop, omega: Array) -> bool:
    """Whether the closed loop is stable, by Nyquist, with COUPLED_MARGIN. Its open loop has integrators and
    stable poles: 1 + L turns from within the third or fourth quadrant to 1, without another turn."""
    difference = 1.0 + loop(omega)
    turned = np.unwrap(np.angle(difference))
    return bool(np.min(np.abs(difference)) >= COUPLED_MARGIN and abs(turned[-1]) < math.pi)


def _imaginary(omega: Array) -> ComplexArray:
    return np.asarray(1j * omega, dtype=complex)
