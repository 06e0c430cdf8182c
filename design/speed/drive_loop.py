"""P and I of a loop inside a drive, from the frequency response of what it controls.

    L(s) = (P + I/s) G(s)

G: from the loop's output to what it compares with its set-point, with all delay in it. The integral's corner
I/P is a fixed share of the crossover: at a fifth it costs 11 degrees of phase there. Then one number is
left, the crossover, and it is asked for in one of two ways:

bandwidth      the frequency at which |L/(1 + L)| last is above -3 dB
phase margin   the highest crossover that keeps it
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.optimize

from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.margins import Margins, Response, margins_of
from servobench.design.statespace import Array, ComplexArray

INTEGRAL_SHARE: Final = 0.2
"""Corner of the integral over the crossover."""
PHASE_MARGIN_MIN_DEG: Final = 30.0
"""A loop with less overshoots by more than a third, and hardly bears a plant that is another than told."""
_HALF_POWER: Final = math.sqrt(0.5)
_PER_DECADE: Final = 200
_BEYOND: Final = 30.0
"""Crossovers are looked for this many times below and above the frequency asked for."""


@dataclass(frozen=True, slots=True)
class LoopBehaviour:
    """Behaviour of a closed loop."""

    bandwidth_hz: float
    """Where |L/(1 + L)| falls below -3 dB for good; NaN: not within the range."""
    crossover_hz: float
    """Of the smallest phase margin; NaN: none."""
    margins: Margins

    @property
    def stands(self) -> bool:
        """True if the loop keeps :data:`PHASE_MARGIN_MIN_DEG` and a gain margin above 1."""
        phase, gain = self.margins.phase_margin_deg, self.margins.gain_margin_db
        return phase >= PHASE_MARGIN_MIN_DEG and gain > 0.0


@dataclass(frozen=True, slots=True)
class DrivePi:
    """The gains of a loop, parallel: P and, per second, I."""

    proportional: float
    integral: float
    figures: LoopBehaviour


def shaft_plant(
    inertia_kg_m2: float, viscous_nm_s: float, delay_s: float, torque_lag_s: float = 0.0
) -> Response:
    """Return G of a speed loop that puts out torque: a rigid shaft behind a first-order lag and a delay."""

    def G(omega: Array) -> ComplexArray:
        s = 1j * np.asarray(omega)
        lag = np.exp(-delay_s * s) / (1.0 + torque_lag_s * s)
        return np.asarray(lag / (inertia_kg_m2 * s + viscous_nm_s), dtype=complex)

    return G


def winding_plant(resistance_ohm: float, inductance_h: float, delay_s: float) -> Response:
    """Return G of a current loop: the winding behind a delay, back-EMF taken out."""

    def G(omega: Array) -> ComplexArray:
        s = 1j * np.asarray(omega)
        return np.asarray(np.exp(-delay_s * s) / (inductance_h * s + resistance_ohm), dtype=complex)

    return G


def position_plant(speed_loop: Response) -> Response:
    """Return G of a position loop that puts out speed: the closed speed loop, L in ``speed_loop``."""

    def G(omega: Array) -> ComplexArray:
        L = speed_loop(omega)
        return np.asarray(L / (1.0 + L) / (1j * np.asarray(omega)), dtype=complex)

    return G


def closed_by(plant: Response, proportional: float, integral: float) -> Response:
    """Return L of a plant with P and I."""

    def L(omega: Array) -> ComplexArray:
        return np.asarray((proportional + integral / (1j * np.asarray(omega))) * plant(omega), dtype=complex)

    return L


def figures_of(L: Response, low_rad_s: float, high_rad_s: float) -> LoopBehaviour:
    """Return the figures of a loop between two frequencies."""
    margins = margins_of(L, low_rad_s, high_rad_s)
    return LoopBehaviour(
        _bandwidth_rad_s(L, low_rad_s, high_rad_s) / math.tau,
        margins.phase_margin_rad_s / math.tau,
        margins,
    )


def pi_for_bandwidth(plant: Response, bandwidth_hz: float, integral_share: float = INTEGRAL_SHARE) -> DrivePi:
    """Return the gains with that bandwidth. Raises InfeasibleDesign where none stand with it."""
    asked = math.tau * bandwidth_hz
    low, high = asked / _BEYOND, asked * _BEYOND

    def excess(log_w: float) -> float:
        w_c = math.exp(log_w)
        reached = _bandwidth_rad_s(_shaped(plant, w_c, integral_share), low / _BEYOND, high)
        return math.log(high if math.isnan(reached) else reached) - math.log(asked)

    demand = f"a bandwidth of {bandwidth_hz:g} Hz"
    first, last = math.log(low), math.log(asked)
    if excess(first) > 0.0 or excess(last) < 0.0:
        raise InfeasibleDesign(demand, "no crossover makes it", "ask for another one")
    w_c = math.exp(scipy.optimize.brentq(excess, first, last, xtol=1e-9))
    made = _made(plant, w_c, integral_share, low / _BEYOND, high)
    if not made.figures.stands:
        margins = made.figures.margins
        raise InfeasibleDesign(
            demand,
            f"it leaves {margins.phase_margin_deg:.1f} degrees of phase and {margins.gain_margin_db:.1f} dB",
            f"ask for a phase margin of {PHASE_MARGIN_MIN_DEG:g} degrees: it tells how fast it can be",
        )
    return made


def pi_for_phase_margin(
    plant: Response,
    phase_margin_deg: float,
    low_hz: float,
    high_hz: float,
    integral_share: float = INTEGRAL_SHARE,
) -> DrivePi:
    """Return the gains with the highest crossover between two frequencies that keeps the margin. Raises
    InfeasibleDesign for a margin that none keeps, or that all do: then no delay bounds the loop."""
    low, high = math.tau * low_hz, math.tau * high_hz
    omega = np.logspace(math.log10(low), math.log10(high), int(_PER_DECADE * math.log10(high / low)) + 2)
    corner = math.degrees(math.atan(integral_share))
    phase = np.degrees(np.unwrap(np.angle(plant(omega)))) - corner
    left = 180.0 + phase - phase_margin_deg
    demand = f"a phase margin of {phase_margin_deg:g} degrees"
    if not np.any(left >= 0.0):
        raise InfeasibleDesign(demand, f"the best is {left.max() + phase_margin_deg:.1f}", "ask for less")
    k = int(np.flatnonzero(left >= 0.0)[-1])
    if k == len(omega) - 1:
        raise InfeasibleDesign(
            demand, f"it is kept up to {high_hz:g} Hz, where nothing is known", "ask for a bandwidth"
        )
    part = left[k] / (left[k] - left[k + 1])
    w_c = float(omega[k] * (omega[k + 1] / omega[k]) ** part)
    return _made(plant, w_c, integral_share, low / _BEYOND, min(high, w_c * _BEYOND))


def _made(plant: Response, w_c: float, share: float, low: float, high: float) -> DrivePi:
    L = _shaped(plant, w_c, share)
    gain = 1.0 / float(abs((1.0 + share / 1j) * plant(np.array([w_c]))[0]))
    return DrivePi(gain, gain * share * w_c, figures_of(L, low, high))


def _shaped(plant: Response, w_c: float, share: float) -> Response:
    """Return L that crosses 1 at ``w_c``."""
    gain = 1.0 / float(abs((1.0 + share / 1j) * plant(np.array([w_c]))[0]))
    return closed_by(plant, gain, gain * share * w_c)


def _bandwidth_rad_s(L: Response, low: float, high: float) -> float:
    """Return where |T| crosses -3 dB last; NaN if it does not."""

    def above(omega: Array) -> Array:
        values = L(omega)
        return np.asarray(np.abs(values / (1.0 + values)) - _HALF_POWER, dtype=float)

    omega = np.logspace(math.log10(low), math.log10(high), int(_PER_DECADE * math.log10(high / low)) + 2)
    falls = np.flatnonzero(np.diff(np.sign(above(omega))) < 0)
    if not len(falls):
        return math.nan
    k = int(falls[-1])
    return float(
        scipy.optimize.brentq(lambda w: float(above(np.array([w]))[0]), omega[k], omega[k + 1], xtol=1e-9)
    )
