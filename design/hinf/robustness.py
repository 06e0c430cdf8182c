"""Robustness of a current loop when r_s, L_d and L_q lie within a box about their nominal values.

Two questions, answered apart: does every motor of the box give a stable loop, and how large does the
weighted sensitivity get. For one axis both have exact answers
(:mod:`servobench.design.hinf.box_sensitivity`); the coupled axes are in
:mod:`servobench.design.current.coupled_robustness`.
"""

import math
from dataclasses import dataclass

import numpy as np

from servobench.design.hinf.box_sensitivity import AxisBox, Worst, worst_over_box
from servobench.design.hinf.margins import highest
from servobench.design.hinf.mixed_sensitivity import axis_plant
from servobench.design.hinf.weights import Weights
from servobench.design.statespace import Array, StateSpace, connect, series


@dataclass(frozen=True, slots=True)
class AxisRobustness:
    """One axis over resistance and inductance, each within a box about nominal."""

    stable: bool
    """True if every motor of the box is stable, by the bound of the sensitivity."""
    real_mu_peak: float
    """Below 1: every motor of the box gives a stable loop; the box may grow by 1/mu."""
    real_mu_rad_s: float
    sensitivity: Worst
    """max |S|; 1 over it is the worst modulus margin."""
    weighted: Worst
    """max |w1 S|; 1 is the demand (41)."""

    @property
    def worst_modulus_margin(self) -> float:
        """Worst over all motors of the box; 0 if one is unstable."""
        return 1.0 / self.sensitivity.reached if self.stable else 0.0


def axis_robustness(
    resistance_ohm: float, inductance_h: float, K: StateSpace, weights: Weights, spread: float = 0.5
) -> AxisRobustness:
    """Return worst cases and mu for the continuous controller ``K`` of one axis."""
    box = AxisBox(resistance_ohm, inductance_h, spread)
    sensitivity, weighted = worst_over_box(box, K), worst_over_box(box, K, weights.error)
    nominal = connect(series(axis_plant(resistance_ohm, inductance_h), K), [[-1.0]], [[1.0]], [[1.0]])
    omega = _grid(K, resistance_ohm / inductance_h, weights.error.pole_rad_s)

    def mu(at: Array) -> Array:
        return axis_real_mu(resistance_ohm, inductance_h, K, at, spread)

    peak, at = highest(mu, omega, mu(omega), 1e-10)
    stable = nominal.is_stable() and math.isfinite(sensitivity.bound)
    return AxisRobustness(stable, peak, at, sensitivity, weighted)


def _grid(K: StateSpace, corner: float, slowest: float) -> Array:
    rates = np.abs(K.poles())
    high = math.log10(max(rates.max(), corner)) + 1.0
    return np.logspace(math.log10(slowest) - 2.0, high, 2400)


def axis_real_mu(
    resistance_ohm: float, inductance_h: float, K: StateSpace, omega: Array, spread: float
) -> Array:
    """Return the (k,) exact mu of one axis: 1 over the smallest box factor that puts a pole at j omega.

    1 + (a + j b) (x r + j w y L) = 0 with G S = a + j b has one real solution (x, y).
    """
    g = axis_plant(resistance_ohm, inductance_h).response(omega)[:, 0, 0]
    closed = g / (1.0 + g * K.response(omega)[:, 0, 0])
    target = -1.0 / closed
    x, y = target.real / (spread * resistance_ohm), target.imag / (spread * inductance_h * omega)
    return np.asarray(1.0 / np.maximum(np.abs(x), np.abs(y)), dtype=float)
