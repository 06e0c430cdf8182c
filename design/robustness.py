"""What is left when r_s, L_d and L_q lie within a box about their nominal values.

Two questions, answered apart: does every motor of the box give a stable loop, and how large does the
weighted closed loop get. A grid gives what some motor does reach; the structured singular value bounds
what any motor of the box can do. With real parameters, mu(M) <= beta if for scalings D > 0 and G

    M* D M + j (G M - M* G) <= beta^2 D        (Fan, Tits, Doyle 1991), here diagonal and searched.

For one axis the two parameters enter through one voltage, so M has rank one and mu is exact.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from design.margins import margins
from design.mixed_sensitivity import axis_plant
from design.motor import PmsmParameters
from design.statespace import Array, ComplexArray, StateSpace, connect, series
from design.system_norm import hinf_norm
from design.weights import Weights

_GRID = 9


@dataclass(frozen=True, slots=True)
class AxisRobustness:
    """One axis over resistance and inductance, each within +-``spread`` of nominal."""

    spread: float
    stable: bool
    """Of every motor of the grid."""
    real_mu_peak: float
    """Below 1: every motor of the box gives a stable loop; the box may grow by 1/mu."""
    real_mu_rad_s: float
    worst_modulus_margin: float
    worst_weighted_sensitivity: float
    """Largest ||w1 S|| on the grid; 1 is the demand (41)."""
    worst_resistance_ohm: float
    """Where that is."""
    worst_inductance_h: float
    weighted_sensitivity_bound: float
    """No motor of the box exceeds it; infinite if the box may hold an unstable loop."""


def axis_robustness(
    resistance_ohm: float, inductance_h: float, K: StateSpace, weights: Weights, spread: float = 0.5
) -> AxisRobustness:
    """Grid and bounds for the continuous controller ``K`` of one axis."""
    factors = np.linspace(1.0 - spread, 1.0 + spread, _GRID)
    stable, modulus, worst = True, math.inf, (-math.inf, math.nan, math.nan)
    for r, L in itertools.product(resistance_ohm * factors, inductance_h * factors):
        G = axis_plant(float(r), float(L))
        loop = series(G, K)
        weighted = series(weights.error.system, connect(loop, [[-1.0]], [[1.0]], [[-1.0]]))
        weighted = _plus_direct(weighted, weights)
        norm = hinf_norm(weighted, 1e-9).gain
        if math.isinf(norm):
            stable = False
        worst = max(worst, (norm, float(r), float(L)))
        modulus = min(modulus, margins(loop).modulus_margin if math.isfinite(norm) else 0.0)
    omega = _grid(K, resistance_ohm / inductance_h, weights.error.pole_rad_s)
    mu = axis_real_mu(resistance_ohm, inductance_h, K, omega, spread)
    k = int(np.argmax(mu))
    bound = weighted_sensitivity_bound(resistance_ohm, inductance_h, K, weights, spread, omega)
    return AxisRobustness(spread, stable, float(mu[k]), float(omega[k]), modulus, *worst, bound)


def _plus_direct(minus_w1_t: StateSpace, weights: Weights) -> StateSpace:
    """w1 - w1 T from -w1 T whose last state group is w1 itself driven by -T: feed 1 - T in instead."""
    w1 = weights.error.system
    B = minus_w1_t.B.copy()
    B[-1:] += w1.B
    return StateSpace(minus_w1_t.A, B, minus_w1_t.C, minus_w1_t.D + w1.D)


def _grid(K: StateSpace, corner: float, slowest: float) -> Array:
    rates = np.abs(K.poles())
    high = math.log10(max(rates.max(), corner)) + 1.0
    return np.logspace(math.log10(slowest) - 2.0, high, 2400)


def axis_real_mu(
    resistance_ohm: float, inductance_h: float, K: StateSpace, omega: Array, spread: float
) -> Array:
    """(k,) exact mu of one axis: 1 over the smallest box factor that puts a pole at j omega.

    1 + (a + j b) (x r + j w y L) = 0 with G S = a + j b has one real solution (x, y).
    """
    g = axis_plant(resistance_ohm, inductance_h).response(omega)[:, 0, 0]
    closed = g / (1.0 + g * K.response(omega)[:, 0, 0])
    target = -1.0 / closed
    x, y = target.real / (spread * resistance_ohm), target.imag / (spread * inductance_h * omega)
    return np.asarray(1.0 / np.maximum(np.abs(x), np.abs(y)), dtype=float)


def weighted_sensitivity_bound(
    resistance_ohm: float, inductance_h: float, K: StateSpace, weights: Weights, spread: float, omega: Array
) -> float:
    """Bound, on the frequencies ``omega``, of |w1 S| over the whole box of one axis.

    S = 1/(1 + K/(z)) with z = r + j w L anywhere in a rectangle: |S| = |z|/|z + K|. Over the rectangle it
    is largest on the boundary, where it is a ratio of quadratics in one real number, so exact up to the grid.
    """
    k = K.response(omega)[:, 0, 0]
    w1 = np.abs(weights.error.system.response(omega)[:, 0, 0])
    low, high = 1.0 - spread, 1.0 + spread
    worst = np.zeros(len(omega))
    for fixed_r, value in itertools.product((True, False), (low, high)):
        for ratio in np.linspace(low, high, 401):
            r, L = (value, ratio) if fixed_r else (ratio, value)
            z = r * resistance_ohm + 1j * omega * L * inductance_h
            worst = np.maximum(worst, np.abs(z / (z + k)))
    mu = axis_real_mu(resistance_ohm, inductance_h, K, omega, spread)
    return math.inf if mu.max() >= 1.0 else float((w1 * worst).max())


def real_mu_upper_bound(M: ComplexArray, starts: int = 3) -> float:
    """Bound of mu of ``M`` (n, n) against diagonal real perturbations, by diagonal D and G scalings.

    Every D and G gives a bound; the search only tightens it.
    """
    n = len(M)

    def bound(theta: Array) -> float:
        D = np.exp(np.clip(theta[:n], -20.0, 20.0))
        scaled = M * D[:, None] / D
        size = np.linalg.norm(scaled, 2)
        low, high = 0.0, float(size)
        G = np.clip(theta[n:], -1e6, 1e6)
        if not np.any(G):
            return high
        root = 1.0 / np.sqrt(1.0 + G**2) ** 0.5
        for _ in range(40):
            beta = 0.5 * (low + high)
            tested = (scaled / max(beta, 1e-300) - 1j * np.diag(G)) * root[:, None] * root
            low, high = (low, beta) if np.linalg.norm(tested, 2) <= 1.0 else (beta, high)
        return high

    best = min(bound(np.zeros(2 * n)), float(np.linalg.norm(M, 2)))
    generator = np.random.default_rng(0)
    for k in range(starts):
        start = np.zeros(2 * n) if k == 0 else generator.normal(scale=1.0, size=2 * n)
        start[n:] += 0.1
        found = scipy.optimize.minimize(bound, start, method="Nelder-Mead", options={"maxiter": 400})
        best = min(best, float(found.fun))
    return best


def coupled_real_mu(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    speed_rad_s: float,
    omega: Array,
    spread: float = 0.5,
) -> Array:
    """(k,) bound of mu of both continuous loops at a mechanical speed, r_s, L_d, L_q off by ``spread``.

    The drive decouples with the nominal inductances, so at nominal parameters the axes are apart; a wrong
    inductance couples them. Below 1 at every frequency: stable over the whole box, if it is nominally.
    """
    electrical = motor.pole_pairs * speed_rad_s
    r, Ld, Lq = motor.resistance_ohm, motor.inductance_d_h, motor.inductance_q_h
    size = spread * np.array([r, r, Ld, Lq])
    see = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    result = []
    for w in omega:
        s = 1j * float(w)
        loop = np.diag([r + s * Ld + K_d.at(s)[0, 0, 0], r + s * Lq + K_q.at(s)[0, 0, 0]])
        enter = np.array([[-1.0, 0.0, -s, electrical], [0.0, -1.0, -electrical, -s]])
        M = see @ np.linalg.solve(loop, enter) * size
        result.append(real_mu_upper_bound(np.asarray(M, dtype=complex), starts=1))
    return np.array(result)
