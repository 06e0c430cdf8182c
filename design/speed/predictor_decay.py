"""The slowest decay of a predictor over every sequence of losses and detected steps, every inertia of a
range, and delays that vary.

The walks of :mod:`servobench.design.sampled.walk_decay`, begun behind every past of the filter; each
remembers between which covariances its filter's lies, as in :mod:`servobench.design.speed.predictor_peaks`.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.falling_norms import NormedEdge
from servobench.design.sampled.loss_decay import CLOSE, DecayPerSecond, decay_over_inertias, shares_of
from servobench.design.sampled.stepped_load import Shafts, SteppedLoad
from servobench.design.sampled.taylor_map import control_points
from servobench.design.sampled.varying_delay import DelayRange
from servobench.design.sampled.walk_decay import Continued, FollowedWalks, WalkedGraph
from servobench.design.speed.predictor_gains import CovarianceRange, GainBoxes
from servobench.design.speed.predictor_loop import PredictorLoop, Walks
from servobench.design.speed.predictor_peaks import (
    SIGNS,
    SampleMove,
    SamplePeriod,
    first_maps,
    flat,
    moves_of,
    periods_of,
)
from servobench.design.speed.predictor_plant import KalmanModel

_HISTORIES_MAX = 60
"""Histories behind which a walk may begin: 200 give the same decay of Ling's motor."""
_ROUNDS = 8
"""Repetitions of a pattern after which its gains repeat as well."""


def predictor_decay(
    loop: PredictorLoop,
    kalman: KalmanModel,
    walks: Walks,
    losses: tuple[int, int],
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> DecayPerSecond:
    """Return the decay with at most so many readings and commands lost in a row, and any samples taken for
    steps.

    ``inertias``, ``delays``: as for the peak. Raises NoSolution.
    """
    boxes = GainBoxes(kalman, walks, losses[0])
    past = GainBoxes(kalman, walks, losses[0], _HISTORIES_MAX).outcomes

    def graph(shafts: Shafts) -> tuple[WalkedGraph, Sequence[NormedEdge]]:
        own = _Sampled(loop, kalman, walks, losses, shafts, delays, boxes, past)
        return own, own.edges

    return decay_over_inertias(graph, loop.period_s, inertias)


class _Letter(NamedTuple):
    """A period of a walk; ``taken``: its sample counts as a step."""

    move: SampleMove
    period: SamplePeriod
    edge: NormedEdge
    taken: bool


class _Sampled:
    """The periods around some shafts."""

    def __init__(
        self,
        loop: PredictorLoop,
        kalman: KalmanModel,
        walks: Walks,
        losses: tuple[int, int],
        shafts: Shafts,
        delays: DelayRange | None,
        boxes: GainBoxes,
        past: CovarianceRange,
    ) -> None:
        self._loop, self._kalman, self._walks, self._boxes, self._past = loop, kalman, walks, boxes, past
        self._shafts, self._width = shafts, losses[1] + 1
        step = self._step(shafts)
        self.nodes, self.order = (losses[0] + 1) * self._width, step.order
        self._points = control_points(step.order)
        self._letters = []
        moves = list(moves_of(*losses))
        periods = {each: periods_of(loop, step, each, delays) for each in {move.outcome for move in moves}}
        for move in moves:
            firsts = first_maps(loop, periods[move.outcome][0], move, boxes)
            for period in periods[move.outcome]:
                edge = step.edge(move.source, move.target, period.maps, firsts)
                ways = (False,) if move.outcome.reading else (False, True)
                self._letters += [_Letter(move, period, edge, taken) for taken in ways]
        self.edges = [letter.edge for letter in self._letters if not letter.taken]

    def _step(self, shafts: Shafts) -> SteppedLoad:
        usual = self._loop.chain(self._kalman.observer(self._walks.quiet))
        return SteppedLoad(self._loop, self._loop.period_s, usual, shafts, CLOSE)

    def begun(self) -> list[tuple[int, Array]]:
        return [
            (node, flat(self._boxes.predicted(self._past, node // self._width))) for node in range(self.nodes)
        ]

    def continued(self, walks: FollowedWalks, T: Array, inverse: Array) -> Iterator[Continued]:
        read = self._loop.read
        for number, (move, period, edge, taken) in enumerate(self._letters):
            rows = np.flatnonzero(walks.node == move.source)
            if not len(rows):
                continue
            own, maps = walks.part(rows), period.maps
            prior = self._boxes.predicted(_range(own.memory))
            middle = half = np.zeros((len(rows), 3))
            later = prior
            if not move.outcome.reading:
                low, high = self._boxes.intervals(*(prior[2:] if taken else prior[:2]))
                middle, half = 0.5 * (low + high), 0.5 * (high - low)
                later = self._boxes.corrected(prior, taken)
            turned = T[move.target] @ maps.M.coefficients
            first = maps.first + (middle @ period.entering.T)[:, :, None] * read
            seen = np.einsum("ij,njl->nil", self._points, (read @ inverse[move.source]) @ own.product)
            entered = turned @ period.entering
            wider = np.zeros(len(rows))
            for each in entered:
                wider += np.max([np.linalg.norm((half * signs) @ each.T, axis=1) for signs in SIGNS], axis=0)
            wider *= np.linalg.norm(seen, axis=2).max(axis=1)
            left, unsure = shares_of(edge, T)
            steps = turned[:, None] @ first @ inverse[move.source]
            yield Continued(rows, move.target, steps, left, unsure, wider, flat(later), number)

    def radius(self, letters: Sequence[int]) -> float:
        chosen = [self._letters[letter] for letter in letters]
        ends = self._shafts.middle - self._shafts.half, self._shafts.middle + self._shafts.half
        return max(self._repeated(chosen, end) for end in ends)

    def _repeated(self, letters: Sequence[_Letter], inverse_inertia: float) -> float:
        step, boxes, read = self._step(Shafts(inverse_inertia)), self._boxes, self._loop.read
        known = boxes.exact(np.zeros((1, 0), dtype=int))
        maps = [step.maps(letter.period.maps.chain) for letter in letters]
        for _ in range(_ROUNDS):
            total = np.eye(self._loop.size)
            for letter, own in zip(letters, maps, strict=True):
                known, first = boxes.predicted(known), own.first
                if not letter.move.outcome.reading:
                    P = (known.bold_low if letter.taken else known.low)[0]
                    gain = self._kalman.gain(P)
                    first = first + np.outer(letter.period.entering @ gain, read)
                    known = boxes.corrected(known, letter.taken)
                total = own.M.coefficients[0] @ first @ total
        return math.pow(float(np.abs(np.linalg.eigvals(total)).max()), 1.0 / len(letters))


def _range(memory: Array) -> CovarianceRange:
    return CovarianceRange(*memory.reshape(-1, 4, 3, 3).transpose(1, 0, 2, 3))
