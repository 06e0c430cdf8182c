"""The feedback with the least gain in the loop that really runs: sampled, held, with delay and loss.

The figure to be made small is the largest gain under the regular patterns, d lost of every d + 1 with
every other sample delayed by T, under the condition that the loop decays under every pattern. That
condition is met by exchange: what the search for the worst pattern finds too slow is added to
the patterns that are looked at, and the search for K begun again. The figure is not smooth in K, so a
simplex (Nelder and Mead) walks; on its way it looks at each lifted loop at some angles only, and
what it ends with is measured exactly and for every d.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from design.delay_loop import Array
from design.errors import NoSolution
from design.held_loop import Delivery, HeldLoop, SampledNetwork, Strategy
from design.lifting import lifted, sampled_gain
from design.loss_patterns import Pattern, chain_of, deliveries_of, repeated, worst_pattern
from design.sampled import regular_patterns
from design.speed_design import least_gain
from design.speed_loop import Feedback, SpeedModel

_NODES = 3
_ANGLES = np.concatenate([[0.0], np.geomspace(0.03, math.pi, 9)])
_AROUND = (0.7, 0.85, 1.0)
"""Times the angle of a pole: where the gain peaks, or near it."""
_SLOW = 0.05
"""Modulus of a pole that makes a peak at all."""
_EVALUATIONS = 120
_POLISHING = 40
_SHARES = (0.8, 2.0)
"""Times the speed gain of the constant delay: where the search starts."""
_UNSTABLE = 50.0
"""Of the logarithm that is searched: above any gain, and sloping towards stability."""
_EXCHANGES = 8
_DECAY = 0.2
"""Times the inverse of the longest age: the decay that every pattern must keep."""


@dataclass(frozen=True, slots=True, eq=False)
class SampledDesign:
    """A gain and the largest gain of its loop under the regular patterns, rad/s per N m."""

    K: Array
    gain: float


def least_sampled_gain(
    model: SpeedModel,
    network: SampledNetwork,
    feedback: Feedback = Feedback.FULL,
    integral_time_s: float | None = None,
) -> SampledDesign:
    """The best that the search finds. Raises NoSolution if no start is stable under every pattern."""
    age_s = network.age_max_s
    if network.strategy is Strategy.STAMP:
        # its age with every loss at once is longer than any that matters for long
        age_s = network.agreed_delay_s + network.period_s
    start = least_gain(model, age_s, Feedback.SPEED, integral_time_s).K
    free = np.array(model.free_gains(feedback))
    least_decay = _DECAY / network.age_max_s
    patterns = [pattern.deliveries for pattern in regular_patterns(HeldLoop(model, start, network))] + [
        (each,) for each in deliveries_of(HeldLoop(model, start, network), delays=2)
    ]
    search = _Search(model, network, start, free, patterns, least_decay)
    for _ in range(_EXCHANGES):
        figure, x = min((search.from_gain(share) for share in _SHARES), key=lambda found: found[0])
        if figure < _UNSTABLE:
            x = search.polished(x)
        K = search.gain_of(x)
        loop = HeldLoop(model, K, network)
        worst = worst_pattern(loop)
        if figure < _UNSTABLE and worst.decay_per_s >= least_decay:
            gains = [sampled_gain(loop, chain_of(loop, each)) for each in regular_patterns(loop)]
            return SampledDesign(K, max(gains))
        patterns.append(worst.deliveries)
    raise NoSolution(
        "feedback for the sampled loop",
        "no gain was found under which every pattern decays",
        f"the last one decays by {worst.decay_per_s:.4g} per s, wanted {least_decay:.4g}",
    )


Deliveries = tuple[Delivery, ...]


class _Loop(HeldLoop):
    """A loop whose flows, which do not depend on K, are kept for the next K."""

    def __init__(
        self, model: SpeedModel, K: Array, network: SampledNetwork, flows: dict[float, Array]
    ) -> None:
        super().__init__(model, K, network)
        self._flows = flows

    def _flow(self, length_s: float) -> Array:
        known = self._flows.get(length_s)
        if known is None:
            known = self._flows[length_s] = super()._flow(length_s)
        return known


class _Search:
    """The search over K; ``patterns`` may grow from one search to the next."""

    def __init__(
        self,
        model: SpeedModel,
        network: SampledNetwork,
        start: Array,
        free: Array,
        patterns: Sequence[Deliveries],
        least_decay: float,
    ) -> None:
        self._model = model
        self._network = network
        self._start = start
        self._free = free
        self._patterns = patterns
        self._least_decay = least_decay
        self._flows: dict[float, Array] = {}

    def from_gain(self, share: float) -> tuple[float, Array]:
        """From ``share`` of the start's speed gain, without current feedback: figure reached, and where.

        The speed gain is searched by its logarithm, the current gain as it is.
        """
        origin = np.zeros(len(self._free))
        origin[-1] = math.log(share)
        return self._walk(self._figure, origin, 0.3, _EVALUATIONS)

    def polished(self, x: Array) -> Array:
        """The same by the exact gain, with small steps from ``x``."""
        return self._walk(self._exact_figure, x, 0.04, _POLISHING)[1]

    @staticmethod
    def _walk(
        figure: Callable[[Array], float], origin: Array, step: float, evaluations: int
    ) -> tuple[float, Array]:
        simplex = [origin, *(origin - step * axis for axis in np.eye(len(origin)))]
        options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-6, "maxfev": evaluations}
        answer = minimize(figure, origin, method="Nelder-Mead", options=options)
        return float(answer.fun), np.asarray(answer.x)

    def gain_of(self, x: Array) -> Array:
        entries = self._start[self._free].copy()
        entries[-1] *= math.exp(x[-1])
        if len(self._free) > 1:
            entries[0] = x[0]
        return self._model.with_entries(self._start, self._free, entries)

    def _figure(self, x: Array) -> float:
        """Logarithm of the largest gain under the patterns with least, some and most losses, roughly."""
        return self._largest(x, _rough_gain)

    def _exact_figure(self, x: Array) -> float:
        return self._largest(x, lambda loop, pattern: sampled_gain(loop, chain_of(loop, pattern)))

    def _largest(self, x: Array, gain: Callable[[HeldLoop, Pattern], float]) -> float:
        loop = _Loop(self._model, self.gain_of(x), self._network, self._flows)
        decay = min(repeated(loop, each).decay_per_s for each in self._patterns)
        if decay < self._least_decay:
            return _UNSTABLE + (self._least_decay - decay) * self._network.age_max_s
        return max(math.log(gain(loop, pattern)) for pattern in _some(regular_patterns(loop)))


def _some(patterns: Sequence[Pattern]) -> list[Pattern]:
    places = sorted({0, len(patterns) // 2, len(patterns) - 1})
    return [patterns[place] for place in places]


def _rough_gain(loop: HeldLoop, pattern: Pattern) -> float:
    system = lifted(loop, chain_of(loop, pattern), _NODES)
    poles = np.linalg.eigvals(system.A)
    resonances = np.abs(np.angle(poles[np.abs(poles) > _SLOW]))
    angles = np.concatenate([_ANGLES, *(resonances * share for share in _AROUND)])
    z = np.exp(1j * angles)[:, None, None]
    inner = np.linalg.solve(
        z * np.eye(len(system.A)) - system.A, np.broadcast_to(system.B, (len(angles), *system.B.shape))
    )
    return float(np.linalg.norm(system.C @ inner + system.D, 2, axis=(1, 2)).max())
