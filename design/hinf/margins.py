"""Margins of a SISO loop L = G K, continuous or sampled: gain, phase and modulus margin, with their places.

Crossings are bracketed on a grid and then found by Brent's method, so they are exact to rounding.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from design.statespace import Array, ComplexArray, StateSpace

Response = Callable[[Array], ComplexArray]
"""(k,) frequencies, rad/s, to (k,) values of L."""
_POINTS_PER_DECADE = 400


@dataclass(frozen=True, slots=True)
class Margins:
    """Of all crossings the nearest to instability; infinite without a crossing, its place then NaN."""

    gain_margin_db: float
    gain_margin_rad_s: float
    phase_margin_deg: float
    phase_margin_rad_s: float
    modulus_margin: float
    """inf |1 + L| = 1/||S||."""
    modulus_margin_rad_s: float


def margins(loop: StateSpace) -> Margins:
    """Margins of a loop in state space; a sampled one up to half its sampling rate."""
    poles = loop.poles()
    if loop.period_s is None:
        rates = np.abs(poles[np.abs(poles) > 0.0])
        low, high = float(rates.min(initial=1.0)) * 1e-2, float(rates.max(initial=1.0)) * 1e2
    else:
        high = math.pi / loop.period_s
        rates = np.abs(np.log(poles[np.abs(poles) > 1e-9])) / loop.period_s
        low = float(rates[rates > 0.0].min(initial=high)) * 1e-2
    return margins_of(lambda omega: loop.response(omega)[:, 0, 0], max(low, high * 1e-12), high)


def margins_of(L: Response, low_rad_s: float, high_rad_s: float) -> Margins:
    """Margins of the loop ``L`` between two frequencies."""
    decades = math.log10(high_rad_s / low_rad_s)
    omega = np.logspace(math.log10(low_rad_s), math.log10(high_rad_s), int(_POINTS_PER_DECADE * decades) + 2)
    omega[-1] = high_rad_s
    values = L(omega)
    gain_db, gain_at = _gain_margin(L, omega, values)
    phase_deg, phase_at = _phase_margin(L, omega, values)
    modulus, modulus_at = _modulus_margin(L, omega, values)
    return Margins(gain_db, gain_at, phase_deg, phase_at, modulus, modulus_at)


def _roots(function: Callable[[Array], Array], omega: Array, values: Array) -> list[float]:
    changes = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    return [
        scipy.optimize.brentq(lambda w: float(function(np.array([w]))[0]), omega[k], omega[k + 1], rtol=1e-13)
        for k in changes
    ]


def _gain_margin(L: Response, omega: Array, values: ComplexArray) -> tuple[float, float]:
    crossings = _roots(lambda w: L(w).imag, omega, values.imag)
    end = values[-1]
    if abs(end.imag) <= 1e-9 * abs(end):  # half the sampling rate: the response is real there
        crossings.append(float(omega[-1]))
    best, place = math.inf, math.nan
    for crossing in crossings:
        value = complex(L(np.array([crossing]))[0])
        if value.real < 0.0:
            margin = -20.0 * math.log10(abs(value))
            if abs(margin) < abs(best):
                best, place = margin, crossing
    return best, place


def _phase_margin(L: Response, omega: Array, values: ComplexArray) -> tuple[float, float]:
    best, place = math.inf, math.nan
    for crossing in _roots(lambda w: np.log(np.abs(L(w))), omega, np.log(np.abs(values))):
        value = complex(L(np.array([crossing]))[0])
        margin = math.degrees(math.remainder(math.atan2(value.imag, value.real) - math.pi, math.tau))
        if abs(margin) < abs(best):
            best, place = margin, crossing
    return best, place


def _modulus_margin(L: Response, omega: Array, values: ComplexArray) -> tuple[float, float]:
    nearest, place = highest(lambda w: -np.abs(1.0 + L(w)), omega, -np.abs(1.0 + values), 1e-9)
    return -nearest, place


def highest(
    function: Callable[[Array], Array], omega: Array, values: Array, tolerance: float
) -> tuple[float, float]:
    """The largest value and its frequency: the best of a grid, and the top of the hill on which it stands.

    ``tolerance``: of the frequency, relative.
    """
    k = int(np.argmax(values))
    optimum = scipy.optimize.minimize_scalar(
        lambda log_omega: -float(function(np.array([math.exp(log_omega)]))[0]),
        bounds=(math.log(omega[max(k - 1, 0)]), math.log(omega[min(k + 1, len(omega) - 1)])),
        method="bounded",
        options={"xatol": tolerance},
    )
    if -optimum.fun > values[k]:
        return -float(optimum.fun), math.exp(optimum.x)
    return float(values[k]), float(omega[k])
