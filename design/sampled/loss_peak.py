"""The largest error after a load step over every sequence of lost readings and commands, and every inertia
of a range.

A node is what the controller remembers, and how many readings and commands in a row have just been lost, at
most so many of each; an edge is a period. The walks are searched best first
(:mod:`servobench.design.sampled.peak_steps`), those of a part of the range at once.
"""

import itertools
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from servobench.design.errors import NoSolution
from servobench.design.sampled.falling_norms import Norms
from servobench.design.sampled.jump_loop import Outcome, Remembering
from servobench.design.sampled.peak_steps import Leaves, PeakBound, bounded_peak, joined
from servobench.design.sampled.stepped_load import LoadedPeriod, NormedWalks, Shafts, SteppedLoad
from servobench.design.sampled.varying_delay import GRIDS, DelayRange

_CLOSENESS, _LEAVES_MAX = 3e-3, 300_000
_COARSE = 3e-2
"""Closeness that is tried first: leaves are merged from farther away, and there are fewer."""
_START_PARTS = 256
"""Parts of the period in which the load may come: what lies between two widens every leaf, and with 64 the
norms of H-infinity with single losses made 7 % of it, for 0.3 %."""
_CLOSENESS_OF_DELAYS = 1e-2
"""The same where delays vary: what lies between those of the grid widens every leaf."""
_LEAVES_OF_PART = 150_000
"""The same for each part of a range of inertias, and where delays vary."""
_WIDEST = 1.2
"""Largest inertia over the smallest of a part of a range that is tried first."""
NARROWEST = 1.01
"""The same of a part that is not halved again where there are no norms for all of it."""

Peak = Callable[[Shafts, tuple[float, float], float], PeakBound]
"""The bound over some inertias; an error known to be reached, and a bound of those passed elsewhere; how
close the grid of delays is."""


class Move(NamedTuple):
    """A period of a walk."""

    source: int
    target: int
    memory: Hashable
    """What the controller knows at its begin."""
    outcome: Outcome


def losses_peak(
    controller: Remembering,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> PeakBound:
    """Return the largest error after a load step of 1 N m, rad/s, certified and reached, with at most so many
    readings and commands lost in a row.

    ``inertias``: smallest and largest, as multiples of the model's; ``delays``: None: that of the loop.
    Raises NoSolution.
    """
    moves = list(walked(controller, readings_max, commands_max))
    nodes = 1 + max(move.target for move in moves)
    usual = controller.chain(controller.quiet, Outcome(reading=False, command=False))

    def peak(shafts: Shafts, known: tuple[float, float], close: float) -> PeakBound:
        step = SteppedLoad(controller.loop, controller.period_s, usual, shafts, close, _START_PARTS)
        edges = [
            (move, period)
            for move in moves
            for period in step.periods(controller.chain(move.memory, move.outcome), controller.newest, delays)
        ]
        normed = [step.edge(move.source, move.target, period, period.first[None]) for move, period in edges]
        norms = Norms(normed, nodes, step.starts[:, 0])
        first = joined([step.begun(node, norms.first, np.zeros((1, 0))) for node in range(nodes)])
        both = max(known[0], step.known[0]), max(known[1], step.known[1])
        leaves_max = _LEAVES_OF_PART if shafts.half or delays else _LEAVES_MAX
        walks, certified = _Walks(edges, norms, step), np.inf
        for closeness in (_COARSE, _CLOSENESS_OF_DELAYS if delays else _CLOSENESS):
            bound = bounded_peak(walks, first, both, closeness, leaves_max)
            certified, both = min(certified, bound.certified), (bound.reached, both[1])
            if bound.certified > (1.0 + 2.0 * closeness) * bound.reached:
                break
        return PeakBound(float(certified), both[0])

    return over_inertias(peak, inertias, delays)


def over_inertias(peak: Peak, inertias: tuple[float, float], delays: DelayRange | None) -> PeakBound:
    """Return the bound over a range of inertias, part by part, the light ones first: their errors are
    largest. Raises NoSolution."""
    grids = GRIDS if delays else GRIDS[:1]
    certified = reached = 0.0
    parts = parts_of(inertias)
    while parts:
        shafts = parts.pop()
        try:
            bound = _closer(peak, shafts, (reached, 0.0), grids)
        except NoSolution:
            halves = shafts.halves(NARROWEST)
            if not halves:
                raise
            parts += halves
            continue
        certified, reached = max(certified, bound.certified), max(reached, bound.reached)
    return PeakBound(certified, reached)


def parts_of(inertias: tuple[float, float]) -> list[Shafts]:
    """Return the range in parts that are tried first, the lightest shafts last."""
    small, large = inertias
    if small == large:
        return [Shafts(1.0 / small)]
    ends = np.geomspace(1.0 / large, 1.0 / small, int(np.ceil(np.log(large / small) / np.log(_WIDEST))) + 1)
    return [Shafts(0.5 * (low + high), 0.5 * (high - low)) for low, high in itertools.pairwise(ends)]


def _closer(peak: Peak, shafts: Shafts, known: tuple[float, float], grids: Sequence[float]) -> PeakBound:
    """Return the bound by the first grid that has one. Raises NoSolution."""
    for close in grids[:-1]:
        with suppress(NoSolution):
            return peak(shafts, known, close)
    return peak(shafts, known, grids[-1])


def walked(controller: Remembering, readings_max: int, commands_max: int) -> Iterator[Move]:
    """Yield every period, the nodes in the order in which they are first reached."""
    numbers = {(controller.quiet, 0, 0): 0}
    waiting = list(numbers)
    for memory, readings, commands in waiting:
        for outcome in (Outcome(reading, command) for reading in (False, True) for command in (False, True)):
            runs = (readings + 1 if outcome.reading else 0), (commands + 1 if outcome.command else 0)
            if runs[0] > readings_max or runs[1] > commands_max:
                continue
            later = (controller.after(memory, outcome), *runs)
            if later not in numbers:
                numbers[later] = len(numbers)
                waiting.append(later)
            yield Move(numbers[memory, readings, commands], numbers[later], memory, outcome)


class _Walks(NormedWalks):
    """The periods of a graph, for the search."""

    def __init__(self, edges: list[tuple[Move, LoadedPeriod]], norms: Norms, step: SteppedLoad) -> None:
        super().__init__(norms, step)
        self._edges = edges

    def stepped(self, leaves: Leaves) -> tuple[Leaves, float, float]:
        came, reached, bound = [], 0.0, 0.0
        for move, period in self._edges:
            own = leaves.part(np.flatnonzero(leaves.node == move.source))
            if not len(own.d):
                continue
            d = self._step.apart(own.d)
            z = d @ period.first.T
            nothing = np.zeros_like(z[:, 0])
            least, most, between = self._step.errors(z, d, period, nothing)
            reached = max(reached, float((least - own.doubt).max()))
            bound = max(bound, float((most + between + own.radius).max()))
            targets = np.full(len(own.d), move.target)
            later, unsure, apart = self.moved(z, nothing, period, move.target)
            radius = self.left * own.radius + unsure + apart
            doubt = self.left * own.doubt + unsure
            came.append(own._replace(node=targets, d=later, radius=radius, doubt=doubt))
        return joined(came), reached, bound
