"""Controllers of a given small structure against the same weights as the full-order one.

The objective max over w of the largest singular value of [w1 S; w2 K S; w3 T] is neither smooth nor
convex in the controller's coefficients. It is solved as a smooth problem with many constraints (minimise t
with the value at each frequency below t, by sequential quadratic programming), frequencies being added
where the true peak shows, from several starts; the last word is the H-infinity norm itself. Time is
counted in the plant's own L/r, so that a motor's size changes nothing.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import scipy.optimize

from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.mixed_sensitivity import Weights, mixed_sensitivity
from servobench.design.hinf.synthesis import closed_loop
from servobench.design.hinf.system_norm import hinf_norm
from servobench.design.statespace import Array, ComplexArray, StateSpace, from_zpk

_BAD = 1e3
"""A norm beyond this is a start that ran away, not an optimum: no controller could be made from it. Norms of
optima are near 1; a limit of 10 decides alike."""
_ROUNDS = 6
"""Three leave 4e-5 of the norm of the paper's PI, six nothing of its eighth digit; from poor starts 2e-3 and
8e-4."""


class Structure(Enum):
    """Structures of the controller."""

    PI = "pi"
    """k (s + a)/s"""
    PI_POLE = "pi+pole"
    """k (s + a)/(s (s/p + 1))"""
    THIRD = "third-order"
    """k (s + a)(s + b)/(s (s^2 + 2 d w s + w^2)), the form of [Azaiz2007] (71)"""


def _pi(theta: Array) -> tuple[list[complex], list[complex], float]:
    k, a = np.exp(theta)
    return [-a], [0.0], float(k)


def _pi_pole(theta: Array) -> tuple[list[complex], list[complex], float]:
    k, a, p = np.exp(theta)
    return [-a], [0.0, -p], float(k * p)


def _third(theta: Array) -> tuple[list[complex], list[complex], float]:
    k, a, b, w, d = np.exp(theta)
    root = np.emath.sqrt(d * d - 1.0) * w
    pair = [complex(-d * w + root), complex(-d * w - root)]
    return [-a, -b], [0.0, *pair], float(k)


_FORMS: dict[Structure, Callable[[Array], tuple[list[complex], list[complex], float]]] = {
    Structure.PI: _pi,
    Structure.PI_POLE: _pi_pole,
    Structure.THIRD: _third,
}


def tune(
    G: StateSpace, weights: Weights, structure: Structure, crossing_rad_s: float
) -> tuple[StateSpace, float]:
    """Return the best controller of ``structure`` found for the first-order plant ``G``, and its norm.

    ``crossing_rad_s``: start of the search. Raises InfeasibleDesign if no start led to a stable loop.
    """
    plant = mixed_sensitivity(G, weights)
    corner, gain = -float(G.A[0, 0]), float((G.C @ G.B)[0, 0])
    slow = _Scaled.of(G, weights, corner)
    best: tuple[StateSpace, float] | None = None
    for factor in (0.25, 0.5, 1.0, 2.0):
        crossing = crossing_rad_s / corner
        k = factor * crossing * corner / gain
        fast, high = max(20.0 * crossing, 1.0), weights.control.pole_rad_s / corner
        starts = {
            Structure.PI: [k, 1.0],
            Structure.PI_POLE: [k, 1.0, fast],
            Structure.THIRD: [k * fast**2 / high, 1.0, high, fast, 1.0],
        }
        zeros, poles, scaled = _FORMS[structure](_minimax(slow, structure, np.log(starts[structure])))
        rise = corner ** (len(poles) - len(zeros))
        K = from_zpk([z * corner for z in zeros], [p * corner for p in poles], scaled * rise)
        norm = hinf_norm(closed_loop(plant, K)).gain
        if math.isfinite(norm) and (best is None or norm < best[1]):
            best = K, norm
    if best is None:
        raise InfeasibleDesign(
            f"a stable loop with the structure {structure.value}",
            "no start led to one",
            "take the full order, or lower the crossing of w1",
        )
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Scaled:
    """G, w1, w2 and w3 in the time 1/``rate``; the slowest and fastest rate among them, in that time."""

    systems: tuple[StateSpace, ...]
    rate: float
    slowest: float
    fastest: float

    @classmethod
    def of(cls, G: StateSpace, weights: Weights, rate: float) -> "_Scaled":
        parts = weights.by_function.values()
        rates = np.array([x for w in parts for x in (w.zero_rad_s, w.pole_rad_s)]) / rate
        systems = (G, *(weight.system for weight in parts))
        return cls(systems, rate, float(rates.min()), float(rates.max()))

    def responses(self, omega: Array) -> list[ComplexArray]:
        """Return the three responses, each (k,)."""
        return [system.response(omega * self.rate)[:, 0, 0] for system in self.systems]


def _minimax(problem_of: _Scaled, structure: Structure, start: Array) -> Array:
    ends = math.log10(problem_of.slowest) - 1.0, math.log10(problem_of.fastest)
    omega = np.logspace(*ends, int(10 * (ends[1] - ends[0])))
    fine = np.logspace(*ends, int(200 * (ends[1] - ends[0])))
    theta = start

    def values(theta: Array, grid: Array, responses: list[ComplexArray]) -> Array:
        g, w1, w2, w3 = responses
        zeros, poles, k = _FORMS[structure](np.clip(theta, -30.0, 30.0))
        s = 1j * grid
        K = k * np.prod([s - z for z in zeros], axis=0) / np.prod([s - p for p in poles], axis=0)
        S = 1.0 / (1.0 + g * K)
        return np.asarray(
            np.sqrt(np.abs(w1 * S) ** 2 + np.abs(w2 * K * S) ** 2 + np.abs(w3 * g * K * S) ** 2)
        )

    on_fine = problem_of.responses(fine)
    for _ in range(_ROUNDS):
        responses = problem_of.responses(omega)
        level = float(values(theta, omega, responses).max())
        problem: dict[str, Any] = {
            "type": "ineq",
            "fun": lambda x, r=responses, w=omega: x[-1] - np.log(values(x[:-1], w, r)),
        }
        optimum = scipy.optimize.minimize(
            lambda x: x[-1],
            np.append(theta, math.log(max(level, 1e-9))),
            jac=lambda x: np.eye(len(x))[-1],
            constraints=[problem],
            method="SLSQP",
            options={"maxiter": 100, "ftol": 1e-10},
        )
        if np.all(np.isfinite(optimum.x)) and values(optimum.x[:-1], fine, on_fine).max() < _BAD:
            theta = optimum.x[:-1]
        seen = values(theta, fine, on_fine)
        peak = float(fine[int(np.argmax(seen))])
        omega = np.unique(np.concatenate([omega, peak * np.array([0.97, 1.0, 1.03])]))
    return theta
