"""The largest error after a load step over every sequence of lost readings and commands.

A node is what the controller remembers, and how many readings and commands in a row have just been lost, at
most so many of each; an edge is a period. The walks are searched best first
(:mod:`servobench.design.sampled.peak_tree`).
"""

from collections.abc import Hashable, Iterator
from typing import NamedTuple

import numpy as np

from servobench.design.sampled.falling_norms import NormedEdge, Norms
from servobench.design.sampled.jump_loop import Remembering
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.sampled.peak_tree import Leaves, bounded_peak, joined
from servobench.design.sampled.random_losses import Outcome
from servobench.design.sampled.stepped_load import NormedWalks, PeriodMaps, SteppedLoad

_CLOSENESS, _LEAVES_MAX = 3e-3, 300_000


class Move(NamedTuple):
    """A period of a walk."""

    source: int
    target: int
    memory: Hashable
    """What the controller knows at its begin."""
    outcome: Outcome


def losses_peak(controller: Remembering, readings_max: int, commands_max: int) -> PeakBound:
    """Return the largest error after a load step of 1 N m, rad/s, certified and reached, with at most so many
    readings and commands lost in a row. Raises NoSolution."""
    moves = list(walked(controller, readings_max, commands_max))
    nodes = 1 + max(move.target for move in moves)
    usual = controller.chain(controller.quiet, Outcome(reading=False, command=False))
    step = SteppedLoad(controller.loop, controller.period_s, usual)
    edges = [(move, step.maps(controller.chain(move.memory, move.outcome))) for move in moves]
    normed = [NormedEdge(move.source, move.target, maps.M[None], maps.looks) for move, maps in edges]
    norms = Norms(normed, nodes, step.starts)
    first = joined([step.begun(node, norms.first, np.zeros((1, 0))) for node in range(nodes)])
    return bounded_peak(_Walks(edges, norms, step), first, step.known, _CLOSENESS, _LEAVES_MAX)


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

    def __init__(self, edges: list[tuple[Move, PeriodMaps]], norms: Norms, step: SteppedLoad) -> None:
        super().__init__(norms, step)
        self._edges = edges

    def stepped(self, leaves: Leaves) -> tuple[Leaves, float, float]:
        came, reached, bound = [], 0.0, 0.0
        for move, (M, looks, inputs) in self._edges:
            own = leaves.part(np.flatnonzero(leaves.node == move.source))
            if not len(own.d):
                continue
            errors, between = self._step.errors(own.d, own.d @ looks.T, own.d @ inputs.T)
            reached = max(reached, float(errors.max()))
            bound = max(bound, float((errors + between + own.radius).max()))
            targets = np.full(len(own.d), move.target)
            came.append(own._replace(node=targets, d=own.d @ M.T))
        return joined(came), reached, bound
