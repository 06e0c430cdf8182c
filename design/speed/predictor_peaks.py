"""The largest error of a predictor after a load step over every sequence of losses and detected steps.

The search of :mod:`servobench.design.sampled.peak_tree`: a leaf remembers between which covariances that of
its filter lies, and the one that believes in faster loads. Its gains lie in a box; with those of the middle
it goes on, and what the others may make of it adds to its radius. At first the covariances are those behind
every past, so many histories of losses and steps at once; with each sample they come closer together.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.falling_norms import NormedEdge, Norms
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.sampled.peak_tree import Leaves, bounded_peak, joined
from servobench.design.sampled.random_losses import Outcome
from servobench.design.sampled.stepped_load import NormedWalks, SteppedLoad
from servobench.design.speed.predictor_gains import CovarianceRange, GainBoxes
from servobench.design.speed.predictor_loop import PredictorLoop
from servobench.design.speed.predictor_plant import KalmanModel, of_state
from servobench.design.speed.predictor_trial import Walks
from servobench.design.speed.random_loops import sent

_CLOSENESS, _LEAVES_MAX = 1e-2, 300_000
_HISTORIES_MAX = 400
"""Histories behind which the load may come."""
_SAMPLES_BEHIND = 2
"""Samples before the load, of every kind, in the search for the largest error."""
_SIGNS = np.array([[1.0, one, other] for one in (-1.0, 1.0) for other in (-1.0, 1.0)])


class _Move(NamedTuple):
    """A period: from so many (readings, commands) lost in a row, and its own losses."""

    source: int
    target: int
    readings: int
    outcome: Outcome


class _Period:
    """Its maps, linear in the gains L (3,) of its sample: without, and what an innovation adds (.., 3)."""

    def __init__(self, loop: PredictorLoop, step: SteppedLoad, outcome: Outcome) -> None:
        self.lost = step.maps(sent(loop.chain(None), outcome))
        read = loop.read / (loop.read @ loop.read)
        each = [step.maps(sent(loop.chain(of_state(L)), outcome)) for L in np.eye(3)]
        self.M, self.looks, self.inputs = (
            np.array([(with_sample - without) @ read for with_sample in rows]).T
            for without, rows in zip(self.lost, zip(*each, strict=True), strict=True)
        )


def predictor_peak(
    loop: PredictorLoop, kalman: KalmanModel, walks: Walks, readings_max: int, commands_max: int
) -> PeakBound:
    """Return the largest error after a load step of 1 N m, rad/s, certified and reached, with at most so many
    readings and commands lost in a row, and any samples taken for steps. Raises NoSolution."""
    moves = list(_moves(readings_max, commands_max))
    nodes = (readings_max + 1) * (commands_max + 1)
    step = SteppedLoad(loop, loop.period_s, loop.chain(kalman.observer(walks.quiet)))
    boxes = GainBoxes(kalman, walks, readings_max)
    periods = {outcome: _Period(loop, step, outcome) for outcome in {move.outcome for move in moves}}
    edges = []
    for move in moves:
        period = periods[move.outcome]
        corners = [np.zeros(3)] if move.outcome.reading else [L[1:] for L in boxes.corners(move.readings)]
        M = np.array([period.lost.M + np.outer(period.M @ L, loop.read) for L in corners])
        looks = [period.lost.looks + np.outer(period.looks @ L, loop.read) for L in corners]
        edges.append(NormedEdge(move.source, move.target, M, np.vstack(looks)))
    norms = Norms(edges, nodes, step.starts)
    walk, known = _Walks(loop.read, moves, periods, boxes, norms, step), step.known
    for closeness, begun in (
        (_CLOSENESS, boxes.exact(_histories(readings_max))),
        (_CLOSENESS, GainBoxes(kalman, walks, readings_max, _HISTORIES_MAX).outcomes),
    ):
        first = []
        for node in range(nodes):
            memory = boxes.predicted(begun, node // (commands_max + 1))
            first.append(step.begun(node, norms.first, _flat(memory)))
        bound = bounded_peak(walk, joined(first), known, closeness, _LEAVES_MAX)
        known = bound.reached, known[1]
    return bound


def _histories(readings_max: int) -> NDArray[np.int_]:
    letters = range(2 * (readings_max + 1))
    return np.array(list(itertools.product(letters, repeat=_SAMPLES_BEHIND)))


def _moves(readings_max: int, commands_max: int) -> Iterator[_Move]:
    width = commands_max + 1
    for readings, commands in itertools.product(range(readings_max + 1), range(width)):
        for outcome in itertools.starmap(Outcome, itertools.product((False, True), repeat=2)):
            runs = (readings + 1 if outcome.reading else 0), (commands + 1 if outcome.command else 0)
            if runs[0] <= readings_max and runs[1] <= commands_max:
                yield _Move(readings * width + commands, runs[0] * width + runs[1], readings, outcome)


class _Walks(NormedWalks):
    """The periods, for the search."""

    def __init__(
        self,
        read: Array,
        moves: list[_Move],
        periods: dict[Outcome, _Period],
        boxes: GainBoxes,
        norms: Norms,
        step: SteppedLoad,
    ) -> None:
        super().__init__(norms, step)
        self._read, self._moves, self._periods, self._boxes = read, moves, periods, boxes

    def stepped(self, leaves: Leaves) -> tuple[Leaves, float, float]:
        came, reached, bound = [], 0.0, 0.0
        for move in self._moves:
            own = leaves.part(np.flatnonzero(leaves.node == move.source))
            if not len(own.d):
                continue
            period = self._periods[move.outcome]
            prior = self._boxes.predicted(
                CovarianceRange(*own.memory.reshape(-1, 4, 3, 3).transpose(1, 0, 2, 3))
            )
            lost = period.lost
            if move.outcome.reading:
                later = _flat(prior)
                errors, between = self._step.errors(own.d, own.d @ lost.looks.T, own.d @ lost.inputs.T)
                targets = np.full(len(own.d), move.target)
                came.append(Leaves(targets, own.d @ lost.M.T, own.radius, later))
                reached = max(reached, float(errors.max()))
                bound = max(bound, float((errors + between + own.radius).max()))
                continue
            for taken in (False, True):
                gains = self._boxes.intervals(*(prior[2:] if taken else prior[:2]))
                child, error, most = self._sampled(move, period, own, gains)
                came.append(child._replace(memory=_flat(self._boxes.corrected(prior, taken))))
                reached, bound = max(reached, error), max(bound, most)
        return joined(came), reached, bound

    def _sampled(
        self, move: _Move, period: _Period, own: Leaves, gains: tuple[Array, Array]
    ) -> tuple[Leaves, float, float]:
        middle, half = 0.5 * (gains[0] + gains[1]), 0.5 * (gains[1] - gains[0])
        innovation, lost = own.d @ self._read, period.lost
        added, open_ = middle * innovation[:, None], half * np.abs(innovation)[:, None]
        seen = own.d @ lost.looks.T + added @ period.looks.T
        held = own.d @ lost.inputs.T + added @ period.inputs.T
        held = np.abs(held) + open_ @ np.abs(period.inputs).T
        errors, between = self._step.errors(own.d, seen, held)
        apart = (open_ @ np.abs(period.looks).T).max(axis=1)
        turned = self._norms.first.T[move.target] @ period.M
        wider = np.max([np.linalg.norm((open_ * signs) @ turned.T, axis=1) for signs in _SIGNS], axis=0)
        targets = np.full(len(own.d), move.target)
        child = Leaves(targets, own.d @ lost.M.T + added @ period.M.T, own.radius + wider, own.memory)
        reached, passed = errors - apart - own.radius, errors + between + apart + own.radius
        return child, float(reached.max()), float(passed.max())


def _flat(memory: CovarianceRange) -> Array:
    return np.stack(memory, axis=1).reshape(len(memory.low), -1)
