"""The slowest decay over every sequence of lost readings and commands, every inertia of a range, and delays
that vary: the graph of :mod:`servobench.design.sampled.loss_peak`, its walks as in
:mod:`servobench.design.sampled.walk_decay`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.sampled.falling_norms import NormedEdge, left_by
from servobench.design.sampled.jump_loop import Outcome, Remembering
from servobench.design.sampled.loss_peak import NARROWEST, Move, parts_of, walked
from servobench.design.sampled.stepped_load import LoadedPeriod, Shafts, SteppedLoad
from servobench.design.sampled.varying_delay import GRIDS, DelayRange
from servobench.design.sampled.walk_decay import (
    CLOSENESS,
    Continued,
    FollowedWalks,
    WalkedGraph,
    bounded_decay,
    contracting_norms,
    slowest_walk,
)

CLOSE = GRIDS[1]
"""Of the grid of delays: what lies between its instants adds up from period to period."""
_ENOUGH = 0.05
"""Share of the decay found by which a certified one may lie below without a further look at the part."""
_OUT = 3e-3
"""Share of a size that polynomials leave out in a period, from which a narrower part may prove more."""


class DecayPerSecond(NamedTuple):
    """Of every sequence, and of the slowest found, 1/s; negative: it grows."""

    certified: float
    found: float


GraphOf = Callable[[Shafts], tuple[WalkedGraph, Sequence[NormedEdge]]]


def losses_decay(
    controller: Remembering,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> DecayPerSecond:
    """Return the decay with at most so many readings and commands lost in a row.

    ``inertias``, ``delays``: as for the peak. Raises NoSolution.
    """
    moves = list(walked(controller, readings_max, commands_max))

    def graph(shafts: Shafts) -> tuple[WalkedGraph, Sequence[NormedEdge]]:
        own = _Losses(controller, moves, shafts, delays)
        return own, own.edges

    return decay_over_inertias(graph, controller.period_s, inertias)


def decay_over_inertias(graph_of: GraphOf, period_s: float, inertias: tuple[float, float]) -> DecayPerSecond:
    """Return the bound over a range of inertias, part by part. Raises NoSolution."""
    parts = [(shafts, *graph_of(shafts)) for shafts in parts_of(inertias)]
    found = max(slowest_walk(graph, edges) for _, graph, edges in parts)
    certified = 0.0
    while parts:
        _stable(found)
        shafts, graph, edges = parts.pop()
        norms, goal = contracting_norms(edges, graph.nodes, found), found ** (1.0 - CLOSENESS)
        left = out = math.inf
        if norms is not None:
            bound = bounded_decay(graph, norms, found, goal)
            found, left = max(found, bound.found), bound.certified
            out = max(shares_of(edge, norms[0])[1] for edge in edges)
        if left > found ** (1.0 - _ENOUGH) and out > _OUT:
            halves = shafts.halves(NARROWEST)
            if halves:
                parts += [(half, *graph_of(half)) for half in halves]
                continue
        certified = max(certified, left)
    _stable(found)
    if certified >= 1.0:
        raise NoSolution("certificate of the decay", "no norms were found that contract along every sequence")
    return DecayPerSecond(-math.log(certified) / period_s, -math.log(found) / period_s)


def _stable(found: float) -> None:
    if found >= 1.0:
        raise NoSolution("certificate of the decay", "a pattern is known that destabilises the loop")


def shares_of(edge: NormedEdge, T: Array) -> tuple[float, float]:
    """Return what a period leaves of a size, and the part of it that its polynomials leave out."""
    whole = left_by(edge, T)
    return whole, max(0.0, whole - left_by(edge._replace(room=0.0), T))


class _Losses:
    """The periods of ``moves`` around some shafts."""

    def __init__(
        self, controller: Remembering, moves: Sequence[Move], shafts: Shafts, delays: DelayRange | None
    ) -> None:
        self._controller, self._shafts = controller, shafts
        step = self._step(shafts)
        self.nodes, self.order = 1 + max(move.target for move in moves), step.order
        self._periods: list[tuple[Move, LoadedPeriod]] = [
            (move, period)
            for move in moves
            for period in step.periods(controller.chain(move.memory, move.outcome), controller.newest, delays)
        ]
        self.edges = [
            step.edge(move.source, move.target, period, period.first[None]) for move, period in self._periods
        ]

    def _step(self, shafts: Shafts) -> SteppedLoad:
        own = self._controller
        usual = own.chain(own.quiet, Outcome(reading=False, command=False))
        return SteppedLoad(own.loop, own.period_s, usual, shafts, CLOSE)

    def begun(self) -> list[tuple[int, Array]]:
        return [(node, np.zeros((1, 0))) for node in range(self.nodes)]

    def continued(self, walks: FollowedWalks, T: Array, inverse: Array) -> Iterator[Continued]:
        for letter, ((move, period), edge) in enumerate(zip(self._periods, self.edges, strict=True)):
            rows = np.flatnonzero(walks.node == move.source)
            if len(rows):
                maps = T[move.target] @ period.M.coefficients @ period.first @ inverse[move.source]
                left, unsure = shares_of(edge, T)
                yield Continued(
                    rows, move.target, maps[:, None], left, unsure, 0.0, walks.memory[rows], letter
                )

    def radius(self, letters: Sequence[int]) -> float:
        return max(
            self._repeated([self._periods[letter] for letter in letters], end)
            for end in (self._shafts.middle - self._shafts.half, self._shafts.middle + self._shafts.half)
        )

    def _repeated(self, periods: Sequence[tuple[Move, LoadedPeriod]], inverse_inertia: float) -> float:
        step = self._step(Shafts(inverse_inertia))
        total = np.eye(self._controller.loop.size)
        for _, period in periods:
            again = step.maps(period.chain)
            total = again.M.coefficients[0] @ again.first @ total
        return math.pow(float(np.abs(np.linalg.eigvals(total)).max()), 1.0 / len(periods))
