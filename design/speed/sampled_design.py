"""The feedback with the least gain in the loop as it runs: sampled, held, with delay and loss.

The figure to minimise is the largest gain under a set of patterns, provided that the loop decays under each.
The set grows by exchange: patterns beyond the figure, found by the searches for the worst, are added and the
search for K begins again, until they find nothing worse. The figure is not smooth in K, so a simplex (Nelder
and Mead) is used. The result is a gain found, not certified.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from servobench.design.delay.delay_loop import Array, Feedback, SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.analysis import regular_patterns
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import (
    Pattern,
    pattern_gains,
    pattern_of,
    slowest_pattern,
    worst_gain,
)
from servobench.design.speed.speed_design import SpeedDesign, least_gain

_TOLERANCE = 1e-3
"""Relative, of the gains on the way."""
_FINE = 1e-5
"""The same in the last steps."""
_CHANGED_MAX = 8
"""Deliveries up to which the worst pattern is changed: longer ones add little and cost much."""
_EVALUATIONS = 80
_POLISHING = 40
_SHARES = (0.8, 2.0)
"""Starts, as multiples of the speed gain for the constant delay."""
_UNSTABLE = 50.0
"""Logarithm used for unstable loops: above any gain, and sloping towards stability."""
_EXCHANGES = 8
_WORSE = 1.003
"""Ratio of the gain found to the largest of the set at which the search ends."""
_DECAY = 0.2
"""Times the inverse of the longest age: the decay that every pattern must keep."""


def least_sampled_gain(
    model: SpeedModel,
    network: SampledNetwork,
    feedback: Feedback = Feedback.FULL,
    integral_time_s: float | None = None,
) -> SpeedDesign:
    """Return the best feedback found, with the largest gain found for its loop.

    Raises NoSolution if no start is stable under every pattern.
    """
    age_s = network.age_max_s
    if network.strategy is Strategy.STAMP:
        # its age with every loss at once is longer than any that matters for long
        age_s = network.agreed_delay_s + network.period_s
    start = least_gain(model, age_s, Feedback.SPEED, integral_time_s).K
    free = np.array(model.free_gains(feedback))
    first = HeldLoop(model, start, network)
    least_decay = _DECAY / network.age_max_s
    search = _Search(model, network, start, free, _some(regular_patterns(first)), least_decay)
    best: SpeedDesign | None = None
    x = np.zeros(len(free))
    decay = math.nan
    for _ in range(_EXCHANGES):
        walks = [search.from_point(x)] if best else [search.from_gain(share) for share in _SHARES]
        figure, x = min(walks, key=lambda walk: walk[0])
        if figure < _UNSTABLE:
            x = search.polished(x)
        K = search.gain_of(x)
        loop = HeldLoop(model, K, network)
        slowest = slowest_pattern(loop)
        decay = slowest.decay_per_s
        if decay < least_decay:
            search.add(slowest)
            continue
        worst = worst_gain(loop, [*regular_patterns(loop), slowest], _CHANGED_MAX)
        if best is None or worst.gain < best.gain:
            best = SpeedDesign(K, network.constant_delay_s, worst.gain)
        if worst.gain <= search.gain_at(x) * _WORSE:
            break
        search.add(worst.pattern)
    if best is None:
        raise NoSolution(
            "feedback for the sampled loop",
            "no gain was found under which every pattern decays",
            f"the last one decays by {decay:.4g} per s, wanted {least_decay:.4g}",
        )
    return best


class _Search:
    """The search over K, whose patterns may grow from one walk to the next."""

    def __init__(
        self,
        model: SpeedModel,
        network: SampledNetwork,
        start: Array,
        free: Array,
        patterns: Sequence[Pattern],
        least_decay: float,
    ) -> None:
        self._model = model
        self._network = network
        self._start = start
        self._free = free
        self._patterns = [pattern.steps for pattern in patterns]
        self._least_decay = least_decay
        self._near: float | None = None
        self._tolerance = _TOLERANCE

    def add(self, pattern: Pattern) -> None:
        """Add ``pattern`` to the set."""
        self._patterns.append(pattern.steps)

    def gain_at(self, x: Array) -> float:
        """Return the largest gain under the patterns, rad/s per N m."""
        return math.exp(self._figure(x))

    def from_point(self, x: Array) -> tuple[float, Array]:
        """Search from ``x``: figure reached, and where."""
        return self._walk(x, 0.1, _EVALUATIONS)

    def from_gain(self, share: float) -> tuple[float, Array]:
        """Search from ``share`` of the start's speed gain, without current feedback: figure reached, and
        where.

        The speed gain is searched by its logarithm, the current gain directly.
        """
        origin = np.zeros(len(self._free))
        origin[-1] = math.log(share)
        return self._walk(origin, 0.3, _EVALUATIONS)

    def polished(self, x: Array) -> Array:
        """Repeat with small steps from ``x``."""
        self._tolerance = _FINE
        x = self._walk(x, 0.04, _POLISHING)[1]
        self._tolerance = _TOLERANCE
        return x

    def _walk(self, origin: Array, step: float, evaluations: int) -> tuple[float, Array]:
        simplex = [origin, *(origin - step * axis for axis in np.eye(len(origin)))]
        options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-5, "maxfev": evaluations}
        answer = minimize(self._figure, origin, method="Nelder-Mead", options=options)
        return float(answer.fun), np.asarray(answer.x)

    def gain_of(self, x: Array) -> Array:
        entries = self._start[self._free].copy()
        entries[-1] *= math.exp(x[-1])
        if len(self._free) > 1:
            entries[0] = x[0]
        return self._model.with_entries(self._start, self._free, entries)

    def _figure(self, x: Array) -> float:
        """Return the logarithm of the largest gain under the patterns."""
        loop = HeldLoop(self._model, self.gain_of(x), self._network)
        patterns = [pattern_of(loop, steps) for steps in self._patterns]
        decay = min(pattern.decay_per_s for pattern in patterns)
        if decay < self._least_decay:
            return _UNSTABLE + (self._least_decay - decay) * self._network.age_max_s
        self._near = float(np.max(pattern_gains(loop, patterns, self._tolerance, self._near)))
        return math.log(self._near)


def _some(patterns: Sequence[Pattern]) -> list[Pattern]:
    places = sorted({0, len(patterns) // 2, len(patterns) - 1})
    return [patterns[place] for place in places]
