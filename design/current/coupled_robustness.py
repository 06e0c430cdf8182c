"""Both current loops together at a speed, while r_s, L_d and L_q lie anywhere within a box.

The drive decouples with the nominal inductances, so a wrong one couples the axes. With the electrical speed
w_e the closed loop has a pole at s exactly where

    (r + s L_d + K_d)(r + s L_q + K_q) + w_e^2 (L_d - L_d0)(L_q - L_q0) = 0

With r_d and r_q for the two r this is affine in each parameter, so over a box it stays within the convex
hull of its values at the corners (mapping theorem of Zadeh and Desoer, 1963). If 0 lies outside of the hull
at every frequency, no motor of the box moves a pole across the axis. The box is cut into pieces, in each of
which r_d and r_q lie close together. 1 over the largest box that passes bounds the structured singular
value from above, at every frequency of the grid.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servobench.design.hinf.robustness import axis_real_mu
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import Array, ComplexArray, StateSpace, append, balanced

NDBool = NDArray[np.bool_]

_PIECES_R, _PIECES_L = 6, 3
_HALVINGS = 14
"""Halvings of the interval from 0 to 1 / spread, so that mu is known to 1/16384 of it."""
_GRID = 240
"""First frequencies. With the refinements below, 30 find the same peaks of the paper's loops."""
_REFINEMENTS, _PEAKS = 4, 5
"""Without refinements the bound falls short by 4 % at a peak of the paper's loops, with three by 4e-4; of the
peaks two suffice."""


@dataclass(frozen=True, slots=True)
class CoupledRobustness:
    """Both axes at one speed."""

    real_mu_bound: float
    """Below 1: stable with every motor of the box; the box may grow by its inverse."""
    real_mu_rad_s: float

    @property
    def certified(self) -> bool:
        """True if the whole box is stable, as far as the grid of frequencies shows."""
        return self.real_mu_bound < 1.0


def coupled_robustness(
    motor: PmsmParameters, K_d: StateSpace, K_q: StateSpace, speed_rad_s: float, spread: float = 0.5
) -> CoupledRobustness:
    """Return the bound over a grid from a thousandth of the slowest r/L to thirty times the loops' own
    rates."""
    corners = [motor.resistance_ohm / L for L in (motor.inductance_d_h, motor.inductance_q_h)]
    rates = np.abs(np.concatenate([K_d.poles(), K_q.poles()]))
    electrical = abs(speed_rad_s) * motor.pole_pairs
    fast = max(*corners, electrical, *(rates[rates < 1e3 * max(corners)]))
    omega = np.logspace(np.log10(min(corners) * 1e-3), np.log10(30.0 * fast), _GRID)
    mu = coupled_real_mu(motor, K_d, K_q, speed_rad_s, omega, spread)
    for _ in range(_REFINEMENTS):  # mu of real parameters has narrow peaks
        finer = _between_peaks(omega, mu)
        omega = np.concatenate([omega, finer])
        mu = np.concatenate([mu, coupled_real_mu(motor, K_d, K_q, speed_rad_s, finer, spread)])
        order = np.argsort(omega)
        omega, mu = omega[order], mu[order]
    k = int(np.argmax(mu))
    return CoupledRobustness(float(mu[k]), float(omega[k]))


def _between_peaks(omega: Array, mu: Array) -> Array:
    """Return frequencies about the highest values of ``mu``, on both sides up to the next known ones."""
    finer = []
    for k in np.argsort(mu)[-_PEAKS:]:
        low, high = omega[max(k - 1, 0)], omega[min(k + 1, len(omega) - 1)]
        finer.append(np.exp(np.linspace(np.log(low), np.log(high), 12)[1:-1]))
    return np.setdiff1d(np.concatenate(finer), omega)


def coupled_real_mu(
    motor: PmsmParameters,
    K_d: StateSpace,
    K_q: StateSpace,
    speed_rad_s: float,
    omega: Array,
    spread: float = 0.5,
) -> Array:
    """Return the (k,) bound of mu at the k frequencies, for the box +-``spread``; at most for a box that
    holds r = 0.

    Above ``spread`` only, where a motor is still one: the smallest value is ``spread`` itself. At standstill
    the axes do not meet, and it is exact.
    """
    if speed_rad_s == 0.0:
        resistance = motor.resistance_ohm
        d_axis = axis_real_mu(resistance, motor.inductance_d_h, K_d, omega, spread)
        q_axis = axis_real_mu(resistance, motor.inductance_q_h, K_q, omega, spread)
        return np.maximum(np.maximum(d_axis, q_axis), spread)
    k_d, k_q = K_d.response(omega)[:, 0, 0], K_q.response(omega)[:, 0, 0]
    low, high = np.zeros(len(omega)), np.full(len(omega), 1.0 / spread)
    for _ in range(_HALVINGS):
        size = 0.5 * (low + high)
        hit = _may_vanish(motor, k_d, k_q, speed_rad_s, omega, spread * size)
        low, high = np.where(hit, low, size), np.where(hit, size, high)
    return np.asarray(1.0 / np.maximum(low, 1e-9), dtype=float)


def _may_vanish(
    motor: PmsmParameters,
    k_d: ComplexArray,
    k_q: ComplexArray,
    speed_rad_s: float,
    omega: Array,
    spread: Array,
) -> NDBool:
    """Return (k,) True where 0 lies in the hull of some piece of the box +-``spread`` (k,)."""
    coupling = (motor.pole_pairs * speed_rad_s) ** 2
    r_d, r_q, off_d, off_q = (offset[:, None] * spread for offset in _CORNERS)
    r, L_d, L_q = motor.resistance_ohm, motor.inductance_d_h, motor.inductance_q_h
    d_axis = r * (1.0 + r_d) + 1j * omega * L_d * (1.0 + off_d) + k_d
    q_axis = r * (1.0 + r_q) + 1j * omega * L_q * (1.0 + off_q) + k_q
    values = d_axis * q_axis + coupling * L_d * L_q * off_d * off_q
    return np.asarray(_hull_holds_zero(values.reshape(-1, 16, len(omega))).any(axis=0), dtype=bool)


def _corners() -> Array:
    """Return (4, 16 pieces) offsets of r_d, r_q, L_d, L_q in spreads, the corners of a piece together."""
    cuts_r, cuts_l = (np.linspace(-1.0, 1.0, pieces + 1) for pieces in (_PIECES_R, _PIECES_L))
    corners = [
        corner
        for i, j, m in itertools.product(range(_PIECES_R), range(_PIECES_L), range(_PIECES_L))
        for corner in itertools.product(
            cuts_r[i : i + 2], cuts_r[i : i + 2], cuts_l[j : j + 2], cuts_l[m : m + 2]
        )
    ]
    return np.array(corners).T


_CORNERS = _corners()


def _hull_holds_zero(points: ComplexArray) -> NDBool:
    """Return (l, k) True where 0 lies in the convex hull of ``points`` (l, m, k) along m."""
    angles = np.sort(np.angle(points), axis=1)
    gaps = np.diff(np.concatenate([angles, angles[:, :1] + 2.0 * np.pi], axis=1), axis=1)
    return np.asarray(gaps.max(axis=1) <= np.pi, dtype=bool)


@dataclass(frozen=True, slots=True)
class WorstMotor:
    """The motor of a grid over the box whose loops decay slowest, or grow fastest."""

    resistance_ohm: float
    inductance_d_h: float
    inductance_q_h: float
    rightmost_pole_per_s: float
    """Largest real part of a closed-loop pole; above 0: unstable."""


def worst_motor(
    motor: PmsmParameters, K_d: StateSpace, K_q: StateSpace, speed_rad_s: float, spread: float = 0.5
) -> WorstMotor:
    """Return evidence for the bound: five values of each parameter, corners included."""
    d, q = balanced(K_d), balanced(K_q)
    factors = np.linspace(1.0 - spread, 1.0 + spread, 5)
    worst: WorstMotor | None = None
    for r, L_d, L_q in itertools.product(factors, factors, factors):
        values = r * motor.resistance_ohm, L_d * motor.inductance_d_h, L_q * motor.inductance_q_h
        pole = float(np.linalg.eigvals(closed_loop(motor, values, d, q, speed_rad_s)).real.max())
        if worst is None or pole > worst.rightmost_pole_per_s:
            worst = WorstMotor(float(values[0]), float(values[1]), float(values[2]), pole)
    assert worst is not None
    return worst


def closed_loop(
    motor: PmsmParameters,
    values: tuple[float, float, float],
    K_d: StateSpace,
    K_q: StateSpace,
    speed_rad_s: float,
) -> Array:
    """Return the matrix of [i_d, i_q, K_d's and K_q's states] of a motor with r, L_d, L_q in ``values``.

    The drive decouples with the inductances of ``motor``.
    """
    r, L_d, L_q = values
    electrical = motor.pole_pairs * speed_rad_s
    K = append(K_d, K_q)
    inverse = np.diag([1.0 / L_d, 1.0 / L_q])
    cross = electrical * np.array([[0.0, L_q - motor.inductance_q_h], [motor.inductance_d_h - L_d, 0.0]])
    currents = inverse @ (cross - r * np.eye(2) - K.D)
    return np.block([[currents, inverse @ K.C], [-K.B, K.A]])
