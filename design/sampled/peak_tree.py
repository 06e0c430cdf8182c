"""The largest error after a load step over every walk of a graph: best first, to any closeness.

A leaf is a state that some walk has reached, its node, and a radius: how far, in a norm that no step
enlarges (:mod:`servobench.design.sampled.falling_norms`), a loop that this leaf stands for may lie from it.
No error behind a leaf exceeds |rest| + V(d) + radius. The leaf of the largest bound is stepped through every
edge, again and again; a leaf whose bound is not above the goal is done. At any moment the largest bound of
the leaves left, and the largest error passed, is certified.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.peak_steps import PeakBound

_AT_ONCE = 4000
"""Leaves stepped at once."""
_REFINED_AFTER = 60_000
"""Leaves stepped until bounds are sharpened, again and again."""
_REFINED_AT, _REFINED_FROM = 40, 50
"""Leaves for which that is done, each so many of the largest bounds."""


class Leaves(NamedTuple):
    """States reached, (N, ..) each."""

    node: NDArray[np.intp]
    d: Array
    """(N, k): departure from rest."""
    radius: Array
    memory: Array
    """(N, m): what the controller knows of the past, if its node does not tell."""

    def part(self, which: NDArray[np.intp]) -> "Leaves":
        """Return some of them."""
        return Leaves(self.node[which], self.d[which], self.radius[which], self.memory[which])


class Steps(Protocol):
    """The graph."""

    def bounds(self, leaves: Leaves) -> Array:
        """Return (N,): what no error behind each leaf exceeds."""

    def refine(self, leaves: Leaves) -> None:
        """Sharpen the bounds for some leaves."""

    def stepped(self, leaves: Leaves) -> tuple[Leaves, float, float]:
        """Return the leaves a period later, the largest error passed, and what none exceeded."""


def joined(parts: list[Leaves]) -> Leaves:
    """Return all of them as one."""
    node, *others = (np.concatenate(own) for own in zip(*parts, strict=True))
    return Leaves(node, *others)


def bounded_peak(
    steps: Steps, first: Leaves, known: tuple[float, float], closeness: float, leaves_max: int
) -> PeakBound:
    """Return the bound of every walk from ``first``, and the largest error reached.

    ``known``: an error that is reached, and a bound of those before ``first``; ``closeness``: relative, at
    which the search ends; ``leaves_max``: leaves stepped until it ends anyway.
    """
    left, done, count, refined = first, 0.0, 0, _REFINED_AFTER
    reached, passed = known
    bounds = steps.bounds(left)
    while len(bounds):
        goal = max((1.0 + closeness) * reached, passed)
        over = bounds > goal
        if not over.all():
            done = max(done, float(bounds[~over].max()))
            left, bounds = left.part(np.flatnonzero(over)), bounds[over]
        if count > leaves_max or not len(bounds):
            break
        places = np.arange(len(bounds))
        if len(bounds) > _AT_ONCE:
            places = np.argpartition(-bounds, _AT_ONCE)
        taken, kept = places[:_AT_ONCE], places[_AT_ONCE:]
        if count >= refined:
            largest = np.argsort(-bounds)[: _REFINED_FROM * _REFINED_AT : _REFINED_FROM]
            steps.refine(left.part(largest))
            bounds, refined = steps.bounds(left), refined + _REFINED_AFTER
            continue
        came, error, bound = steps.stepped(left.part(taken))
        count += len(taken)
        reached, passed = max(reached, error), max(passed, bound)
        left = joined([left.part(kept), came])
        bounds = np.concatenate([bounds[kept], steps.bounds(came)])
    return PeakBound(max(passed, done, float(bounds.max(initial=0.0))), reached)
