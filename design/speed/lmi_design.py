"""The best gain with a certificate of Theorem 3.3: Theorem 4.1 of [Ling2012], solved.

For a fixed gain K the certified figure is a convex programme; over K it is not. Theorem 4.1's question, "the
largest delay with a certificate for gamma", is therefore posed over K and the delay alone:

    max delay   such that   certified gain(K, delay) <= gamma

The certified gain is the value of a semidefinite programme, whose multipliers are its derivatives by the data
of the inequalities. So a smooth method (SLSQP) walks over a handful of parameters, each step one or two small
programmes, and where the optimum is not smooth it restarts from its last point. The result is proved
afterwards, like every certificate.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.certificate import certified_gain, gain_problem, gain_slope, scaled
from servobench.design.delay.delay_loop import Array, DelayLoop, Feedback, SpeedModel
from servobench.design.delay.delay_norm import hinf_norm, largest_stable_delay_s, rough_norm
from servobench.design.delay.lmi import solve
from servobench.design.errors import NoSolution
from servobench.design.speed.speed_design import GainWalk, SpeedDesign, largest_delay, least_gain

_ROUNDS = 6
"""Rounds at most: from the paper's gains the first reaches the largest delay."""
_ENOUGH = 1e-2
"""Relative gain of a round below which no further one begins: what is left is 5e-8 in Table 2."""
_CLIMBED = 2
"""Number of best starts that are followed to their optimum."""
_SEARCHED = 1e-8, 1e-6
"""Tolerances of the solver in searches: asked for a digit more it ends short in every fifth programme."""
_EXACT, _ROUGH = 1e-9, 1e-3
"""Relative accuracy of a delay: the solver's, and enough to tell the best starts."""
_NO_ROOM = 1e-6
"""Relative distance of the gain without delay from its limit at which no delay is left."""
_SMALL = 1e-12
"""Slope of the gain by the delay below which any delay is as good."""
_DELAYS_TRIED = 40
"""Delays at most: halving ends below any real one, where Newton's steps take four to six."""


def largest_certified_delay(
    model: SpeedModel,
    gamma: float,
    feedback: Feedback = Feedback.FULL,
    starts: Sequence[Array] = (),
) -> SpeedDesign:
    """Return the feedback with the largest delay at which the certificate keeps ``gamma``; its gain is
    certified.

    ``gamma``: rad/s per N m. ``starts``: gains to begin at, if some are known to be near; else the
    exact optima. Raises NoSolution if no start is certified at any delay.
    """
    candidates: list[tuple[float, Array]] = []
    for start in starts or _starts(model, gamma, feedback):
        # the exact optimum often has its gain at rest on the bound, where nothing is left to certify
        for K in (start, 1.03 * start, 1.2 * start):
            candidates.append((certified_delay_within(model, K, gamma, accuracy=_ROUGH), K))
    candidates = sorted(candidates, key=lambda each: -each[0])[:_CLIMBED]
    reached = [_climb(model, K, delay_s, gamma, feedback) for delay_s, K in candidates if delay_s > 0.0]
    if not reached:
        what = f"certified feedback for {gamma:g} rad/s per N m"
        raise NoSolution(what, "no start is certified at any delay")
    delay_s, K = max(reached, key=lambda each: each[0])
    return _proved(model, K, delay_s, gamma)


def least_certified_gain(
    model: SpeedModel, delay_s: float, feedback: Feedback = Feedback.FULL
) -> SpeedDesign:
    """Return the feedback with the least certified gain at ``delay_s``.

    Raises NoSolution if none of the starts is certified.
    """
    best: tuple[float, Array] | None = None
    for start in _gain_starts(model, delay_s, feedback):
        descended = _descend(model, start, delay_s, feedback)
        if descended is not None and (best is None or descended[0] < best[0]):
            best = descended
    if best is None:
        raise NoSolution(f"certified feedback for a delay of {delay_s * 1e3:g} ms", "no start is certified")
    K = best[1]
    return SpeedDesign(K, delay_s, certified_gain(model, model.loop(K, delay_s), 0).gain)


def certified_delay_within(
    model: SpeedModel, K: Array, gamma: float, near_s: float | None = None, accuracy: float = _EXACT
) -> float:
    """Return the largest delay, s, at which the certificate keeps ``gamma``; 0 if there is none.

    A certificate at a delay holds at every smaller one: a shorter delay only makes the term of Jensen's
    inequality larger. ``near_s``: where to begin; ``accuracy``: the relative length of the last step.
    """
    undelayed = model.loop(K, 0.0)
    stable_s = largest_stable_delay_s(undelayed)
    if stable_s == 0.0 or rough_norm(undelayed) >= gamma * (1.0 - _NO_ROOM):
        return 0.0
    low_s, high_s = 0.0, stable_s if math.isfinite(stable_s) else 20.0
    delay_s = min(near_s or math.inf, 0.5 * high_s)
    for _ in range(_DELAYS_TRIED):
        value = _certified(model, model.loop(K, delay_s), gamma, slopes=True)
        if value is None:
            high_s = delay_s
        else:
            # of the inverse square, which falls almost evenly, to 0 where no gain is certified any more
            newton_s = delay_s * (
                1.0 + value.squared * (1.0 - value.squared) / max(value.by_log_delay, _SMALL)
            )
            if abs(newton_s - delay_s) <= accuracy * delay_s:
                return newton_s
            low_s, high_s = (delay_s, high_s) if value.squared < 1.0 else (low_s, delay_s)
            if low_s < newton_s < high_s:
                delay_s = newton_s
                continue
        delay_s = 0.5 * (low_s + high_s)
    return low_s


def certified_gain_or_inf(model: SpeedModel, K: Array, delay_s: float, gamma: float) -> float:
    """Return the certified gain, in the scale of ``gamma``; infinite if none is."""
    value = _certified(model, model.loop(K, delay_s), gamma)
    return math.inf if value is None else gamma * math.sqrt(value.squared)


@dataclass(frozen=True, slots=True, eq=False)
class _Value:
    """Certified gain over gamma, squared, and its derivatives by [K, log delay]."""

    squared: float
    by_gain: Array
    by_log_delay: float


def _certified(model: SpeedModel, loop: DelayLoop, gamma: float, slopes: bool = False) -> _Value | None:
    """Return the value; None where the programme has no optimum: the loop is not certified, or not stable."""
    plant = scaled(loop, model.state_scale, gamma)
    problem = gain_problem(plant, 0)
    try:
        answer = solve(problem, *_SEARCHED)
    except NoSolution:
        return None
    squared = float(answer.y[-1])
    n = len(loop.K)
    if not slopes:
        return _Value(squared, np.zeros(n), 0.0)
    slope = gain_slope(plant, problem, answer)
    by_gain = loop.delay_s * (loop.B / model.state_scale) @ slope[:, n : 2 * n] * model.state_scale
    by_log_delay = float(np.sum(slope * np.column_stack([plant.A, plant.D, plant.E])))
    return _Value(squared, by_gain, by_log_delay)


def _climb(
    model: SpeedModel, K: Array, delay_s: float, gamma: float, feedback: Feedback
) -> tuple[float, Array]:
    """Climb from (K, delay) to the local optimum of the delay."""
    for _ in range(_ROUNDS):
        K_new, near_s = _Walk(model, K, feedback, delay_s, gamma, for_delay=True).run()
        reached = certified_delay_within(model, K_new, gamma, near_s)
        if reached <= delay_s * (1.0 + _ENOUGH):
            if reached > delay_s:
                K, delay_s = K_new, reached
            break
        K, delay_s = K_new, reached
    return delay_s, K


def _descend(model: SpeedModel, K: Array, delay_s: float, feedback: Feedback) -> tuple[float, Array] | None:
    """Descend from K to the local optimum of the certified gain."""
    scale = hinf_norm(model.loop(K, delay_s))
    value = _certified(model, model.loop(K, delay_s), scale)
    if value is None:
        return None
    gain = scale * math.sqrt(value.squared)
    for _ in range(_ROUNDS):
        K_new, _ = _Walk(model, K, feedback, delay_s, gain, for_delay=False).run()
        reached = _certified(model, model.loop(K_new, delay_s), gain)
        if reached is None or reached.squared >= 1.0 - _ENOUGH:
            break
        K, gain = K_new, gain * math.sqrt(reached.squared)
    return gain, K


class _Walk(GainWalk):
    """Keeps the certified gain within ``gamma``, or minimises its share of it."""

    def __init__(
        self, model: SpeedModel, K: Array, feedback: Feedback, delay_s: float, gamma: float, for_delay: bool
    ) -> None:
        super().__init__(model, K, feedback, delay_s, for_delay)
        self._gamma = gamma
        self._known: tuple[bytes, float, Array] | None = None

    def run(self) -> tuple[Array, float]:
        """Return the final K and delay, s."""
        x = self.optimum(self.start, self.start, 0.4, 1e-9, 25, fun=self._slack, jac=self._slope)
        return self.gain_of(x), self.delay_of(x)

    def _slack(self, x: Array) -> float:
        return self._ask(x)[0]

    def _slope(self, x: Array) -> Array:
        return self._ask(x)[1]

    def _ask(self, x: Array) -> tuple[float, Array]:
        """Return minus the log of the certified gain over its limit, and the gradient."""
        key = x.tobytes()
        if self._known is not None and self._known[0] == key:
            return self._known[1], self._known[2]
        loop = self._model.loop(self.gain_of(x), self.delay_of(x))
        value = _certified(self._model, loop, self._gamma, slopes=True)
        if value is None:
            # no certificate: as bad as the bounds of the walk let it be, sloping back to the start
            slack, slope = -1.0 - float(np.sum(np.square(x))), -2.0 * x
        else:
            slack = -0.5 * math.log(value.squared)
            part = -0.5 / value.squared
            last = part * value.by_log_delay if self._for_delay else 1.0
            slope = np.append(part * self.by_entries(value.by_gain), last)
            if not self._for_delay:
                slack += float(x[-1])
        self._known = (key, slack, slope)
        return slack, slope


def starts_between(full: Array, speed: Array) -> list[Array]:
    """Return gains to begin at, from the exact optima with full and with speed-only feedback."""
    return [full, 0.5 * (full + speed), 0.9 * speed + 0.1 * full, speed]


def _starts(model: SpeedModel, gamma: float, feedback: Feedback) -> list[Array]:
    """Return starts from the exact optima; where speed alone does not keep ``gamma``, with less current
    feedback."""
    if feedback is Feedback.SPEED:
        speed = largest_delay(model, gamma, Feedback.SPEED).K
        return [speed, 1.2 * speed]
    full = largest_delay(model, gamma, Feedback.FULL).K
    try:
        return starts_between(full, largest_delay(model, gamma, Feedback.SPEED).K)
    except NoSolution:
        return [full, 1.2 * full, 1.5 * full]


def _gain_starts(model: SpeedModel, delay_s: float, feedback: Feedback) -> list[Array]:
    speed = least_gain(model, delay_s, Feedback.SPEED).K
    if feedback is Feedback.SPEED:
        return [speed, 0.8 * speed]
    full = least_gain(model, delay_s, Feedback.FULL).K
    return [full, 0.5 * (full + speed), speed, 0.8 * speed]


def _proved(model: SpeedModel, K: Array, delay_s: float, gamma: float) -> SpeedDesign:
    """Return the certificate at the delay found, or slightly below it where rounding requires that."""
    for share in (1.0, 1.0 - 1e-7, 1.0 - 1e-6, 1.0 - 1e-5, 1.0 - 1e-4):
        try:
            proof = certified_gain(model, model.loop(K, delay_s * share), 0)
        except NoSolution:
            continue
        if proof.gain <= gamma * (1.0 + 1e-7):
            return SpeedDesign(K, delay_s * share, proof.gain)
    what = f"certificate of the gain {gamma:g} at {delay_s * 1e3:g} ms"
    raise NoSolution(what, "the optimum fails its check")
