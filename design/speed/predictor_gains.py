"""All gains of a predictor's filter, for any losses and any detected load steps.

The covariance after a sample follows from the previous one, from the losses before the sample, and from
whether the bold one replaced it. Every such map is monotone: a covariance between two before a history of
samples lies between their outcomes after it, and the longer the history, the nearer these are. So histories
that cover every past, each begun between the least and the largest possible covariance, enclose every
possible gain: in a box for each number of losses before the sample, along the axes in which it is thin.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.speed.predictor_loop import Walks
from servobench.design.speed.predictor_plant import READ, KalmanModel, of_state

_HISTORIES_MAX = 6000
"""Five losses in a row need 1629; with 500 their certified gain is 40 % higher. At 6000 the boxes have cost
up to 23 s."""
_SAMPLES_MAX = 12
"""Six are enough for five losses in a row, as the past is then forgotten to the width below; with four the
box of the load's gain is 14 % wider."""
_NARROW = 1e-2
"""Half of the relative uncertainty of a gain that a history may leave: none is extended beyond that."""
_ROUNDS = 2000
"""Rounds of the search for the largest covariance."""
_ROUNDING, _SLACK = 1e-12, 1e-6
"""Relative: rounding, and the enlargement of that covariance."""
_ROOM = 1e-3
"""Share of a gain: the possible difference of the host's filter, in scalars and from six digits."""


class CovarianceRange(NamedTuple):
    """Covariances (N, 3, 3) between two, each for the filter and the bold one."""

    low: Array
    high: Array
    bold_low: Array
    bold_high: Array

    def put(self, rows: NDArray[np.intp], other: "CovarianceRange") -> None:
        """Put ``other`` in place of ``rows``."""
        for own, new in zip(self, other, strict=True):
            own[rows] = new

    def part(self, rows: NDArray[np.intp]) -> "CovarianceRange":
        """Return some of them."""
        return CovarianceRange(*(own[rows] for own in self))


class GainBoxes:
    """Gains of a filter that loses at most ``losses_max`` samples in a row."""

    def __init__(
        self, kalman: KalmanModel, walks: Walks, losses_max: int, histories_max: int = _HISTORIES_MAX
    ) -> None:
        self._kalman, self._walks, self._losses_max = kalman, walks, losses_max
        self._histories_max = histories_max
        self._largest = self._largest_covariance()
        self.outcomes = self._histories()
        """All possible covariances after a sample."""

    def corners(self, lost: int) -> list[Array]:
        """Return the corners of the box of all gains, each L (4,), after so many losses in a row."""
        prior = self._prior(self.outcomes, lost)
        low = np.concatenate([prior.low, prior.bold_low])
        high = np.concatenate([prior.high, prior.bold_high])
        middle, width = 0.5 * (low + high), high - low
        noise = self._kalman.R
        centres = middle @ READ / (middle @ READ @ READ + noise)[:, None]
        size = np.abs(centres).max(axis=0)
        axes = np.linalg.svd(centres / size - (centres / size).mean(axis=0))[2]
        divisors = low @ READ @ READ + noise, high @ READ @ READ + noise
        ends = []
        for axis in axes:
            u = axis / size
            about = middle @ READ @ u
            reach = _reach(width, u)
            quotients = [(about + sign * reach) / each for sign in (-1.0, 1.0) for each in divisors]
            ends.append((float(np.min(quotients)) - _ROOM, float(np.max(quotients)) + _ROOM))
        return [of_state(size * (axes.T @ np.array(corner))) for corner in itertools.product(*ends)]

    def _histories(self) -> CovarianceRange:
        """Return all possible covariances after a sample."""
        letters = np.arange(2 * (self._losses_max + 1))
        settled: list[CovarianceRange] = []
        count, open_ = 0, np.zeros((1, 0), dtype=int)
        for _ in range(_SAMPLES_MAX):
            outcomes = self._outcome(open_)
            widths = self._widths(outcomes)
            room = max(0, self._histories_max - count - len(open_)) // len(letters)
            split = np.argsort(-widths, kind="stable")[:room]
            split = split[widths[split] > _NARROW]
            kept = np.setdiff1d(np.arange(len(open_)), split)
            settled.append(outcomes.part(kept))
            count += len(kept)
            older = np.repeat(letters, len(split))[:, None]
            open_ = np.hstack([older, np.tile(open_[split], (len(letters), 1))])
            if not len(open_):
                break
        settled.append(self._outcome(open_))
        return CovarianceRange(*map(np.concatenate, zip(*settled, strict=True)))

    def _outcome(self, histories: NDArray[np.int_]) -> CovarianceRange:
        """Return the outcomes of (N, samples), the oldest first: twice the losses before a sample, and 1 if a
        step was seen."""
        quiet, bold = (self._kalman.settled(walk) for walk in (self._walks.quiet, self._walks.bold))
        starts = (quiet, self._largest, bold, self._largest)
        begun = CovarianceRange(*(np.repeat(start[None], len(histories), axis=0) for start in starts))
        return self._followed(begun, histories)

    def _followed(self, boxes: CovarianceRange, histories: NDArray[np.int_]) -> CovarianceRange:
        for column in histories.T:
            for letter in np.unique(column):
                rows = np.flatnonzero(column == letter)
                prior = self._prior(boxes.part(rows), int(letter) // 2)
                boxes.put(rows, self.corrected(prior, bool(letter % 2)))
        return boxes

    def _widths(self, outcomes: CovarianceRange) -> Array:
        """Return (N,): how much each leaves open of the next gain of the load, or of the speed, relative."""
        prior = self._prior(outcomes, 0)
        widths = np.zeros(len(prior.low))
        for low, high in ((prior.low, prior.high), (prior.bold_low, prior.bold_high)):
            for u in np.eye(3):
                widths = np.maximum(widths, _reach(high - low, u) / np.abs(low @ READ @ u))
        return widths

    def _prior(self, given: CovarianceRange, lost: int) -> CovarianceRange:
        """Return the covariances before the sample that comes after so many losses."""
        return self.predicted(given, lost + 1)

    def predicted(self, given: CovarianceRange, periods: int = 1) -> CovarianceRange:
        """Return the covariances some periods later."""
        quiet, bold = self._walks.quiet, self._walks.bold
        low, high, bold_low, bold_high = given
        return CovarianceRange(
            self._predicted(low, quiet, periods),
            self._predicted(high, quiet, periods),
            self._predicted(bold_low, bold, periods),
            self._predicted(bold_high, bold, periods),
        )

    def exact(self, histories: NDArray[np.int_]) -> CovarianceRange:
        """Return the covariances after (N, samples), told as in :meth:`_outcome`, behind which all came."""
        quiet, bold = (self._kalman.settled(walk) for walk in (self._walks.quiet, self._walks.bold))
        begun = (np.repeat(P[None], len(histories), axis=0) for P in (quiet, quiet, bold, bold))
        return self._followed(CovarianceRange(*begun), histories)

    def intervals(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return (N, 3) the least and the largest gain of each entry, of covariances between two."""
        noise = self._kalman.R
        middle, width = 0.5 * (low + high), high - low
        along = np.diagonal(width, axis1=1, axis2=2) * (width @ READ @ READ)[:, None]
        reach = 0.5 * np.sqrt(np.maximum(along, 0.0))
        divisors = (low @ READ @ READ + noise)[:, None], (high @ READ @ READ + noise)[:, None]
        about = middle @ READ
        ends = np.array([(about + sign * reach) / each for sign in (-1.0, 1.0) for each in divisors])
        room = _ROOM * np.abs(about / divisors[0])
        return ends.min(axis=0) - room, ends.max(axis=0) + room

    def _predicted(self, P: Array, walk: float, periods: int) -> Array:
        """Return (..., 3, 3) some periods later."""
        for _ in range(periods):
            P = self._kalman.Phi @ P @ self._kalman.Phi.T + self._kalman.process(walk)
        return P

    def corrected(self, prior: CovarianceRange, taken: bool) -> CovarianceRange:
        """Correct the covariances. ``taken``: a step was seen, and the bold covariance with it."""
        low, high, *bold = map(self._after, prior)
        return CovarianceRange(*bold, *bold) if taken else CovarianceRange(low, high, *bold)

    def _after(self, P: Array) -> Array:
        read = P @ READ
        return np.asarray(
            P - read[:, :, None] * read[:, None, :] / (read @ READ + self._kalman.R)[:, None, None]
        )

    def _largest_covariance(self) -> Array:
        """Return the covariance after a sample of the bold filter that no losses exceed. Raises NoSolution.

        Made a little larger it remains one: no such map grows faster than its covariance does.
        """
        kalman, walk = self._kalman, self._walks.bold
        P = kalman.settled(walk)
        for _ in range(_ROUNDS):
            beyond = [
                kalman.corrected(self._predicted(P, walk, lost + 1)) - P
                for lost in range(self._losses_max + 1)
            ]
            if all(np.linalg.eigvalsh(each)[-1] <= _ROUNDING * np.trace(P) for each in beyond):
                return P * (1.0 + _SLACK)
            P = P + sum(_positive(each) for each in beyond)
        raise NoSolution("gains of the filter", "no covariance was found that losses do not lead beyond")


def _reach(width: Array, u: Array) -> Array:
    """Return (N,): how far u' P r may depart from that of the middle of two covariances, ``width`` apart."""
    along, across = np.einsum("i,nij,j->n", u, width, u), width @ READ @ READ
    return np.asarray(0.5 * np.sqrt(np.maximum(along * across, 0.0)))


def _positive(M: Array) -> Array:
    """Return the positive part of M."""
    values, vectors = np.linalg.eigh(M)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
