"""The best possible gain for a loop with constant delay: exact limits, no conservatism.

Two questions, for full or speed-only feedback, with or without integral action:

    least gain      min over K of   sup_w |G(jw; K, delay)|
    largest delay   max over K, delay   such that   |G(jw; K, delay)| <= gamma for all w

Both are semi-infinite programmes: smooth in K and delay at each frequency, but with a constraint for every
frequency, of which a few are active at the optimum (the gain at rest meets one or two resonances).
They are solved by exchange: a smooth programme over a finite set of frequencies (SLSQP), to which
the peaks of its answer are added until none of them breaks the bound. Each start ends in a local optimum;
the best of several is returned, and its norm is the proven one of :mod:`servobench.design.delay.delay_norm`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.optimize import minimize

from servobench.design.delay.delay_loop import Array, DelayLoop, Feedback, SpeedModel, loop_function
from servobench.design.delay.delay_norm import (
    first_delay_beyond_s,
    hinf_norm,
    is_stable,
    peaks,
    sampled_norm,
)
from servobench.design.errors import NoSolution
from servobench.design.statespace import ComplexArray

_EXCHANGES = 30
"""Exchanges at most: of 40 searches 35 end within 19, two are ended here."""
_RADIUS = 0.5
"""How far one exchange may go at first, in parts of each gain and of the delay."""
_RESTARTS = 5
"""Restarts at most: seven problems, with integral and without, reached their optimum in the first run, to
seven digits."""
_LEAST = 1e-12
"""Gain at rest with an integral, whose logarithm is needed."""
_LONGEST_S = 100.0
"""A gain that is kept with any delay counts as kept with this one."""
_ROUNDING = 1e-9
"""Relative excess of a norm over the bound that counts as rounding."""
_ROUNDED = (0.0, 1e-9, 1e-8, 1e-7)
"""Reductions of a delay until its norm is proved to be within the bound."""
_NEAR = 1e-6
"""Relative excess of a peak over the bound above which a point on the way is no candidate."""
_EXCESS = 1e-8
"""Relative excess of a peak over the bound that is tolerated."""
_K1_STARTS = (-2.0, -1.4, -1.0, -0.8, -0.6, -0.45, -0.3, -0.15, 0.2)
"""Current feedback, A/A, from which the search for full feedback chooses its starts."""
_K1_FAST = (-4.0, -8.0, -16.0, -32.0, -64.0, -128.0)
"""The same if none of those keeps the gain: the current loop is up to 129 times as fast."""
_REFINED = 2
"""Number of best starts that are refined."""


@dataclass(frozen=True, slots=True, eq=False)
class SpeedDesign:
    """A feedback with its result: gain of the loop in rad/s per N m, at ``delay_s``."""

    K: Array
    delay_s: float
    gain: float


def least_gain(
    model: SpeedModel,
    delay_s: float,
    feedback: Feedback = Feedback.FULL,
    integral_time_s: float | None = None,
) -> SpeedDesign:
    """Return the feedback with the least gain from load torque to speed error at ``delay_s``.

    ``integral_time_s``: K2/K3 of a model with integral, by default :meth:`SpeedModel.integral_time_s`.
    Raises NoSolution if no start leads to a stable loop.
    """
    candidates = []
    for K in _starts(model, delay_s, feedback, integral_time_s or model.integral_time_s(delay_s)):
        design = _refine(model, K, delay_s, None, feedback)
        if design is not None:
            candidates.append(design)
    if not candidates:
        raise NoSolution(f"feedback for a delay of {delay_s * 1e3:g} ms", "no stable loop was found")
    return min(candidates, key=lambda design: design.gain)


def largest_delay(
    model: SpeedModel,
    gamma: float,
    feedback: Feedback = Feedback.FULL,
    integral_time_s: float | None = None,
) -> SpeedDesign:
    """Return the feedback with the largest delay at which the gain stays within ``gamma``, rad/s per N m.

    ``integral_time_s``: K2/K3 of a model with integral; by default that of the largest delay without
    integral. Raises NoSolution if no feedback was found that keeps it even without delay.
    """
    if model.has_integral and integral_time_s is None:
        plain = largest_delay(model.without_integral, gamma, Feedback.SPEED)
        integral_time_s = model.integral_time_s(plain.delay_s)
    candidates = []
    for K in _delay_starts(model, gamma, integral_time_s or math.inf, feedback):
        design = _refine(model, K, _delay_within(model, K, gamma), gamma, feedback)
        if design is not None:
            candidates.append(design)
    if not candidates:
        what = f"{feedback.value} feedback for a gain of {gamma:g} rad/s per N m"
        raise NoSolution(what, "no start keeps it even without delay")
    return max(candidates, key=lambda design: design.delay_s)


def _delay_starts(model: SpeedModel, gamma: float, integral_time_s: float, feedback: Feedback) -> list[Array]:
    """Return the most promising of many gains that keep ``gamma`` without delay; some are infeasible, or
    all."""
    speed = _speed_starts(model, gamma, integral_time_s)
    # with current feedback the current loop's rate is a (1 - K1): a small gain may need it fast
    for first in (_K1_STARTS, _K1_FAST):
        tried = speed if feedback is Feedback.SPEED else [_with_current(K, K1) for K in speed for K1 in first]
        ranked = sorted(((_delay_within(model, K, gamma), K) for K in tried), key=_longest)
        kept = [K for delay_s, K in ranked[:_REFINED] if delay_s > 0.0]
        if kept or feedback is Feedback.SPEED:
            break
    return kept


def _longest(ranked: tuple[float, Array]) -> float:
    return -ranked[0]


def delay_within(model: SpeedModel, K: Array, gamma: float) -> float:
    """Return the largest delay, s, up to which every smaller one keeps the norm within ``gamma``; 0 if
    none."""
    delay_s = _delay_within(model, np.asarray(K, dtype=float), gamma)
    for less in _ROUNDED:
        if _keeps(model.loop(K, delay_s * (1.0 - less)), gamma, exact=True):
            return delay_s * (1.0 - less)
    return 0.0


def _delay_within(model: SpeedModel, K: Array, gamma: float) -> float:
    """Return the same, found where the frequencies are dense enough: without the proof of the norm."""
    return min(first_delay_beyond_s(model.loop(K, 0.0), gamma * (1.0 + _ROUNDING)), _LONGEST_S)


def _keeps(loop: DelayLoop, gamma: float, exact: bool = False) -> bool:
    """Return True if the loop is stable and its norm within ``gamma``."""
    if not is_stable(loop):
        return False
    norm = hinf_norm(loop) if exact else sampled_norm(loop)
    return norm <= gamma * (1.0 + _ROUNDING)


def _starts(model: SpeedModel, delay_s: float, feedback: Feedback, integral_time_s: float) -> list[Array]:
    """Return gains that are stable at ``delay_s``, from the least of speed-only feedback."""
    best: tuple[float, Array] = (math.inf, np.zeros(len(model.A)))
    for k in np.geomspace(1e-5, 1e3, 161) * _natural_gain(model):
        K = _speed_gain(model, -float(k), integral_time_s)
        loop = model.loop(K, delay_s)
        if is_stable(loop):
            gain = sampled_norm(loop)
            if gain < best[0]:
                best = (gain, K)
    if math.isinf(best[0]):
        return []
    starts = [best[1]]
    if feedback is Feedback.FULL:
        starts += [K for K1 in _K1_STARTS if is_stable(model.loop(K := _with_current(best[1], K1), delay_s))]
    return starts


def _natural_gain(model: SpeedModel) -> float:
    """Return a speed gain, A s/rad, at which the crossing is about the current loop's rate over ten."""
    model = model.rigid or model
    rate = -float(model.A[0, 0])
    return rate / 10.0 / float(model.A[1, 0])


def _speed_gain(model: SpeedModel, K2: float, integral_time_s: float) -> Array:
    K = np.zeros(len(model.A))
    K[1] = K2
    if model.has_integral:
        K[2] = K2 / integral_time_s
    return K


def _speed_starts(model: SpeedModel, gamma: float, integral_time_s: float) -> list[Array]:
    """Return speed gains around the least that keeps the gain at rest within ``gamma``."""
    shaft = model.rigid or model
    slope, friction = float(shaft.A[1, 0]), -float(shaft.A[1, 1])
    J = 1.0 / float(shaft.B2[1])
    needed = max((1.0 / gamma - friction * J) / (slope * J), 1e-6 * _natural_gain(model))
    # beside an integral, or where the current loop is slow for it, the resonance counts, not the gain at rest
    factors = (1.02, 1.15, 1.6, 2.5, 4.0, 8.0, 20.0)
    return [_speed_gain(model, -needed * factor, integral_time_s) for factor in factors]


def _with_current(K: Array, K1: float) -> Array:
    """Return K with current feedback and the rest changed so that the gain at rest stays."""
    turned = K * (1.0 - K1)
    turned[0] = K1
    return np.asarray(turned)


def _refine(
    model: SpeedModel, K: Array, delay_s: float, gamma: float | None, feedback: Feedback
) -> SpeedDesign | None:
    """Return the best result of :func:`_refine_once`, restarted from its end until it gains no more."""
    best: SpeedDesign | None = None
    for _ in range(_RESTARTS):
        refined = _refine_once(model, K, delay_s, gamma, feedback)
        if refined is None or (best is not None and not _better(refined, best, gamma, 1e-7)):
            break
        best = refined
        K, delay_s = best.K, best.delay_s
    return best


def _refine_once(
    model: SpeedModel, K: Array, delay_s: float, gamma: float | None, feedback: Feedback
) -> SpeedDesign | None:
    """Return the local optimum next to (K, delay): of the gain, or of the delay within ``gamma``."""
    bound = gamma if gamma is not None else hinf_norm(model.loop(K, delay_s))
    if math.isinf(bound):
        return None
    programme = _Programme(model, K.copy(), feedback, delay_s, bound, gamma is not None)
    centre, radius = programme.start, _RADIUS
    x = centre
    frequencies = np.array([peak.frequency_rad_s for peak in peaks(programme.loop(x), share=0.3)])
    best: SpeedDesign | None = None
    for left in range(_EXCHANGES, 0, -1):
        x = programme.solve(x, frequencies, centre, radius)
        loop = programme.loop(x)
        if not is_stable(loop):
            # too far for what these frequencies know
            radius, x = 0.5 * radius, centre
            continue
        tops = peaks(loop, share=0.5)
        worst = max(peak.gain for peak in tops)
        counts = gamma is None or worst <= programme.allowed(x) * (1.0 + _NEAR) or left == 1
        design = _measured(model, programme, x, gamma, worst) if counts else None
        if design is not None and (best is None or _better(design, best, gamma)):
            best = design
        if worst <= programme.allowed(x) * (1.0 + _EXCESS):
            if np.max(np.abs(x - centre)) < 0.9 * radius:
                break
            centre = x
        frequencies = np.union1d(frequencies, [peak.frequency_rad_s for peak in tops])
    if best is None:
        return None
    norm = hinf_norm(model.loop(best.K, best.delay_s))
    return SpeedDesign(best.K, best.delay_s, norm)


def _better(design: SpeedDesign, best: SpeedDesign, gamma: float | None, by: float = 0.0) -> bool:
    if gamma is None:
        return design.gain < best.gain * (1.0 - by)
    return design.delay_s > best.delay_s * (1.0 + by)


def _measured(
    model: SpeedModel, programme: "_Programme", x: Array, gamma: float | None, worst: float
) -> SpeedDesign | None:
    K = programme.gain_of(x)
    if gamma is None:
        return SpeedDesign(K, programme.delay_s, worst)
    # on the way the programme may stand outside the bound
    delay_s = _delay_within(model, K, gamma)
    return SpeedDesign(K, delay_s, gamma) if delay_s > 0.0 else None


class GainWalk:
    """SLSQP over x = [K/scale of the free entries, log of the delay or of the gain relative to the start].

    With ``for_delay`` the delay is made largest, else the gain least.
    """

    def __init__(
        self, model: SpeedModel, K: Array, feedback: Feedback, delay_s: float, for_delay: bool
    ) -> None:
        self._model = model
        self._K = K
        self._free = np.array(model.free_gains(feedback))
        self._scale = np.where(self._free == 0, 1.0, np.abs(K[self._free]))
        self.delay_s = delay_s
        self._for_delay = for_delay
        self.start = np.append(K[self._free] / self._scale, 0.0)

    def gain_of(self, x: Array) -> Array:
        """Return K at ``x``."""
        return self._model.with_entries(self._K, self._free, x[:-1] * self._scale)

    def delay_of(self, x: Array) -> float:
        """Return the delay at ``x``, s."""
        return self.delay_s * math.exp(x[-1]) if self._for_delay else self.delay_s

    def by_entries(self, by_gain: Array) -> Array:
        """Return slopes by the free entries of x, of those by K, (..., n)."""
        if self._model.has_integral:
            # the integral's gain follows the speed's
            by_gain = by_gain.copy()
            by_gain[..., 1] += by_gain[..., 2] * self._K[2] / self._K[1]
        return np.asarray(by_gain[..., self._free] * self._scale)

    def optimum(
        self, x: Array, centre: Array, radius: float, tolerance: float, steps_max: int, **slack: Any
    ) -> Array:
        """Optimise from ``x``, within ``radius`` of ``centre``, where the constraint ``slack`` is not below
        0."""
        sign = -1.0 if self._for_delay else 1.0
        gradient = sign * np.eye(len(x))[-1]
        answer = minimize(
            lambda x: sign * float(x[-1]),
            x,
            jac=lambda _x: gradient,
            bounds=[(value - radius, value + radius) for value in centre],
            constraints=[{"type": "ineq", **slack}],
            method="SLSQP",
            options={"ftol": tolerance, "maxiter": steps_max},
        )
        return np.asarray(answer.x)


class _Programme(GainWalk):
    """The smooth programme over given frequencies, in which |G| stays within a bound."""

    def __init__(
        self, model: SpeedModel, K: Array, feedback: Feedback, delay_s: float, bound: float, for_delay: bool
    ) -> None:
        super().__init__(model, K, feedback, delay_s, for_delay)
        self._bound = bound

    def allowed(self, x: Array) -> float:
        """Return the bound on |G|."""
        return self._bound if self._for_delay else self._bound * math.exp(x[-1])

    def loop(self, x: Array) -> DelayLoop:
        return self._model.loop(self.gain_of(x), self.delay_of(x))

    def solve(self, x: Array, frequencies: Array, centre: Array, radius: float) -> Array:
        """Return the optimum from ``x``, within ``radius`` of ``centre``, when only ``frequencies`` count."""

        unit_s = 1.0 / float(np.max(np.abs(self._model.A)))
        known = _FeedbackFunctions(self._model, frequencies * unit_s, unit_s)

        def slack(x: Array) -> Array:
            values, _ = known.gains(self.gain_of(x), self.delay_of(x))
            return np.asarray(math.log(self.allowed(x)) - np.log(values))

        def slope(x: Array) -> Array:
            _, (by_gain, by_delay) = known.gains(self.gain_of(x), self.delay_of(x))
            last = -self.delay_of(x) * by_delay if self._for_delay else np.ones(len(frequencies))
            return np.column_stack([-self.by_entries(by_gain), last])

        return self.optimum(x, centre, radius, 1e-12, 60, fun=slack, jac=slope)


class _FeedbackFunctions:
    """log |G| at given frequencies with its slopes: n and q are affine in K, by polynomials that do not
    depend on it."""

    def __init__(self, model: SpeedModel, w: Array, unit_s: float) -> None:
        """``w``: (m,) frequencies, rad per ``unit_s``."""
        each = [loop_function(model.loop(K, 0.0), unit_s) for K in np.eye(len(model.A))]
        self._s = 1j * w
        self._unit_s = unit_s

        def at(parts: Sequence[Array]) -> ComplexArray:
            return np.asarray(np.polynomial.polynomial.polyval(self._s, np.array(parts).T))

        self._n, self._q = at([each[0].numerator.plain, each[0].denominator.plain])
        self._n_by = at([function.numerator.delayed for function in each]).T
        self._q_by = at([function.denominator.delayed for function in each]).T
        self._last: tuple[bytes, float, Any] | None = None

    def gains(self, K: Array, delay_s: float) -> tuple[Array, tuple[Array, Array]]:
        """Return |G| (m,), and of its logarithm the slopes by K (m, n) and by the delay (m,), 1/s."""
        key = K.tobytes()
        if self._last is not None and self._last[:2] == (key, delay_s):
            return cast("tuple[Array, tuple[Array, Array]]", self._last[2])
        late = np.exp(-self._s * (delay_s / self._unit_s))
        n_late, q_late = late * (self._n_by @ K), late * (self._q_by @ K)
        n, q = self._n - n_late, self._q - q_late
        # with an integral the gain at rest is zero
        values = np.maximum(np.abs(n / q), _LEAST)
        n = np.where(n == 0.0, 1.0, n)
        by_gain = late[:, None] * (self._q_by / q[:, None] - self._n_by / n[:, None])
        by_delay = self._s / self._unit_s * (n_late / n - q_late / q)
        answer = values, (by_gain.real, by_delay.real)
        self._last = (key, delay_s, answer)
        return answer
