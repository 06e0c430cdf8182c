"""The largest error of a predictor after a load step over every sequence of losses and detected steps, and
every inertia of a range.

The search of :mod:`servobench.design.sampled.peak_steps`: a leaf remembers between which covariances that of
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
from servobench.design.sampled.falling_norms import Norms
from servobench.design.sampled.jump_loop import Outcome
from servobench.design.sampled.loss_peak import over_inertias
from servobench.design.sampled.peak_steps import Leaves, PeakBound, bounded_peak, joined
from servobench.design.sampled.stepped_load import LoadedPeriod, NormedWalks, Shafts, SteppedLoad
from servobench.design.sampled.varying_delay import DelayRange
from servobench.design.speed.predictor_gains import CovarianceRange, GainBoxes
from servobench.design.speed.predictor_loop import PredictorLoop, Walks
from servobench.design.speed.predictor_plant import KalmanModel, of_state
from servobench.design.speed.random_loops import sent

_CLOSENESS, _LEAVES_MAX = 1e-2, 300_000
_HISTORIES_MAX = 400
"""Histories behind which the load may come."""
_SAMPLES_BEHIND = 2
"""Samples before the load, of every kind, in the search for the largest error."""
SIGNS = np.array([[1.0, one, other] for one in (-1.0, 1.0) for other in (-1.0, 1.0)])


class SampleMove(NamedTuple):
    """A period: from so many (readings, commands) lost in a row, and its own losses."""

    source: int
    target: int
    readings: int
    outcome: Outcome


class SamplePeriod(NamedTuple):
    """Its maps, those of a lost sample."""

    maps: LoadedPeriod
    entering: Array
    """(k, 3): what the gains times an innovation add to the first jump."""


def periods_of(
    loop: PredictorLoop, step: SteppedLoad, outcome: Outcome, delays: DelayRange | None
) -> list[SamplePeriod]:
    """Return the maps of a period of ``outcome``, one for each begin of its command."""
    lost = step.periods(sent(loop.chain(None), outcome), loop.first_command, delays)
    read = loop.read / (loop.read @ loop.read)
    each = [step.maps(sent(loop.chain(of_state(L)), outcome)).first for L in np.eye(3)]
    entering = np.array([(first - lost[0].first) @ read for first in each]).T
    return [SamplePeriod(maps, entering) for maps in lost]


def first_maps(loop: PredictorLoop, period: SamplePeriod, move: SampleMove, boxes: GainBoxes) -> Array:
    """Return the first jumps (N, k, k) of a period, one for each corner of its gains."""
    maps, entering = period
    corners = [np.zeros(3)] if move.outcome.reading else [L[1:] for L in boxes.corners(move.readings)]
    return np.array([maps.first + np.outer(entering @ L, loop.read) for L in corners])


def predictor_peak(
    loop: PredictorLoop,
    kalman: KalmanModel,
    walks: Walks,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> PeakBound:
    """Return the largest error after a load step of 1 N m, rad/s, certified and reached, with at most so many
    readings and commands lost in a row, and any samples taken for steps.

    ``inertias``: smallest and largest, as multiples of the model's; ``delays``: None: that of the loop.
    Raises NoSolution.
    """
    moves = list(moves_of(readings_max, commands_max))
    nodes = (readings_max + 1) * (commands_max + 1)
    boxes = GainBoxes(kalman, walks, readings_max)
    begins = (
        boxes.exact(_histories(readings_max)),
        GainBoxes(kalman, walks, readings_max, _HISTORIES_MAX).outcomes,
    )

    def peak(shafts: Shafts, known: tuple[float, float], close: float) -> PeakBound:
        step = SteppedLoad(loop, loop.period_s, loop.chain(kalman.observer(walks.quiet)), shafts, close)
        outcomes = {move.outcome for move in moves}
        periods = {outcome: periods_of(loop, step, outcome, delays) for outcome in outcomes}
        edges = []
        for move in moves:
            firsts = first_maps(loop, periods[move.outcome][0], move, boxes)
            for period in periods[move.outcome]:
                edges.append(step.edge(move.source, move.target, period.maps, firsts))
        norms = Norms(edges, nodes, step.starts[:, 0], falling=False)
        walk = _Walks(loop.read, moves, periods, boxes, norms, step)
        known = max(known[0], step.known[0]), max(known[1], step.known[1])
        for begun in begins:
            first = []
            for node in range(nodes):
                memory = boxes.predicted(begun, node // (commands_max + 1))
                first.append(step.begun(node, norms.first, flat(memory)))
            bound = bounded_peak(walk, joined(first), known, _CLOSENESS, _LEAVES_MAX)
            known = bound.reached, known[1]
        return bound

    return over_inertias(peak, inertias, delays)


def _histories(readings_max: int) -> NDArray[np.int_]:
    letters = range(2 * (readings_max + 1))
    return np.array(list(itertools.product(letters, repeat=_SAMPLES_BEHIND)))


def moves_of(readings_max: int, commands_max: int) -> Iterator[SampleMove]:
    """Yield the periods between (readings, commands) lost in a row."""
    width = commands_max + 1
    for readings, commands in itertools.product(range(readings_max + 1), range(width)):
        for outcome in itertools.starmap(Outcome, itertools.product((False, True), repeat=2)):
            runs = (readings + 1 if outcome.reading else 0), (commands + 1 if outcome.command else 0)
            if runs[0] <= readings_max and runs[1] <= commands_max:
                yield SampleMove(readings * width + commands, runs[0] * width + runs[1], readings, outcome)


class _Walks(NormedWalks):
    """The periods, for the search."""

    def __init__(
        self,
        read: Array,
        moves: list[SampleMove],
        periods: dict[Outcome, list[SamplePeriod]],
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
            prior = self._boxes.predicted(
                CovarianceRange(*own.memory.reshape(-1, 4, 3, 3).transpose(1, 0, 2, 3))
            )
            nothing = np.zeros((len(own.d), 3))
            if move.outcome.reading:
                ways = [((nothing, nothing), prior)]
            else:
                ways = [
                    (
                        self._boxes.intervals(*(prior[2:] if taken else prior[:2])),
                        self._boxes.corrected(prior, taken),
                    )
                    for taken in (False, True)
                ]
            for (gains, later), period in itertools.product(ways, self._periods[move.outcome]):
                child, error, most = self._stepped(move, period, own, gains)
                came.append(child._replace(memory=flat(later)))
                reached, bound = max(reached, error), max(bound, most)
        return joined(came), reached, bound

    def _stepped(
        self, move: SampleMove, period: SamplePeriod, own: Leaves, gains: tuple[Array, Array]
    ) -> tuple[Leaves, float, float]:
        middle, half = 0.5 * (gains[0] + gains[1]), 0.5 * (gains[1] - gains[0])
        d, maps, step = self._step.apart(own.d), period.maps, self._step
        innovation = d @ self._read
        z = d @ maps.first.T + (middle[:, None] * innovation[:, :, None]) @ period.entering.T
        open_ = half * np.abs(step.control(innovation)).max(axis=1)[:, None]
        opened = open_ @ np.abs(period.entering).T
        least, most, between = step.errors(z, d, maps, opened)
        later, wider, apart = self.moved(z, opened, maps, move.target)
        T = self._norms.first.T[move.target]
        for M in maps.M.coefficients:
            turned = T @ M @ period.entering
            wider += np.max([np.linalg.norm((open_ * signs) @ turned.T, axis=1) for signs in SIGNS], axis=0)
        left = np.abs(T) @ maps.M.rest @ np.abs(period.entering)
        wider += np.linalg.norm(open_ @ left.T, axis=1)
        targets = np.full(len(own.d), move.target)
        radius, doubt = (self.left * each + wider for each in (own.radius, own.doubt))
        child = Leaves(targets, later, radius + apart, own.memory, doubt)
        reached, passed = least - own.doubt, most + between + own.radius
        return child, float(reached.max()), float(passed.max())


def flat(memory: CovarianceRange) -> Array:
    """Return the covariances of each row side by side."""
    return np.stack(memory, axis=1).reshape(len(memory.low), -1)
