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
from scipy.spatial import cKDTree

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.peak_steps import PeakBound

_AT_ONCE = 4000
"""Leaves stepped at once."""
_REFINED_AFTER = 60_000
"""Leaves stepped until bounds are sharpened, again and again."""
_REFINED_AT, _REFINED_FROM = 40, 50
"""Leaves for which that is done, each so many of the largest bounds."""

_CROWDED = 2000
"""Leaves from which those near each other are merged."""
_MERGED = 0.4
"""Share of the closeness asked to which that may widen them."""


class Leaves(NamedTuple):
    """States reached, (N, ..) each."""

    node: NDArray[np.intp]
    d: Array
    """(N, k): departure from rest."""
    radius: Array
    memory: Array
    """(N, m): what the controller knows of the past, if its node does not tell."""
    doubt: Array
    """The part of the radius within which what is really reached lies."""

    def part(self, which: NDArray[np.intp]) -> "Leaves":
        """Return some of them."""
        node, *others = self
        return Leaves(node[which], *(own[which] for own in others))


class Steps(Protocol):
    """The graph."""

    def bounds(self, leaves: Leaves) -> Array:
        """Return (N,): what no error behind each leaf exceeds."""

    def refine(self, leaves: Leaves) -> None:
        """Sharpen the bounds for some leaves."""

    def merged(self, leaves: Leaves, radius: float) -> Leaves:
        """Return fewer leaves that stand for all, none widened beyond ``radius``."""

    def stepped(self, leaves: Leaves) -> tuple[Leaves, float, float]:
        """Return the leaves a period later, the largest error passed, and what none exceeded."""


def covered(points: Array, radii: Array, radius: float) -> tuple[NDArray[np.intp], Array]:
    """Return which balls cover all of them when widened to at most ``radius``, and their radii.

    ``points`` (N, m, k): the distance of two is the largest of m Euclidean ones.
    """
    flat, free = points.reshape(len(points), -1), np.ones(len(points), dtype=bool)
    tree, reach = cKDTree(flat), max(radius - float(radii.min()), 0.0)
    chosen, widened = [], []
    for place in np.argsort(radii, kind="stable")[::-1]:
        if not free[place]:
            continue
        others = np.array(tree.query_ball_point(flat[place], reach))
        others = others[free[others]]
        apart = np.linalg.norm(points[others] - points[place], axis=2).max(axis=1) + radii[others]
        apart[others == place] = radii[place]
        inside = apart <= max(radius, radii[place])
        free[others[inside]] = False
        chosen.append(place)
        widened.append(float(apart[inside].max()))
    return np.array(chosen), np.array(widened)


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
    left, done, count, refined, crowded = first, 0.0, 0, _REFINED_AFTER, _CROWDED
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
        came_bounds = steps.bounds(came)
        open_ = np.flatnonzero(came_bounds > max((1.0 + closeness) * reached, passed))
        done = max(done, float(np.delete(came_bounds, open_).max(initial=0.0)))
        left = joined([left.part(kept), came.part(open_)])
        bounds = np.concatenate([bounds[kept], came_bounds[open_]])
        if len(left.d) > crowded:
            left = steps.merged(left, _MERGED * closeness * reached)
            bounds, crowded = steps.bounds(left), max(_CROWDED, 2 * len(left.d))
    return PeakBound(max(passed, done, float(bounds.max(initial=0.0))), reached)
