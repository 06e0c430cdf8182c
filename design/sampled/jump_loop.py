"""A loop under random losses, as a Markov jump linear system: decay in mean square, mean and variance.

    mode      what the controller knows of past losses (its memory), and the hidden state of the links
    period    xi' = A xi, A by memory and outcome; the memory that follows by both as well

Second moments of xi, one matrix for each mode, follow a linear map from period to period. Its spectral radius
decides whether the loop is stable in mean square, and how fast (Costa, Fragoso, Marques, Discrete-Time Markov
Jump Linear Systems, 2005, ch. 3). The load is a further, constant entry of xi: so means and variances after a
step of it are exact.

The probability that the error after a load step exceeds a threshold at any time, from both sides.

Sequences of outcomes branch from period to period, each with its probability and its own error. One that has
exceeded the threshold counts whole. Those that can still add most are followed, the others closed by
Chebyshev's inequality, summed over all later instants: on average the squares of the errors to come add up to
xi' V xi, and no threshold c is exceeded with more than that over c^2. What is exceeded for certain, and that
with all that is closed, are the two ends.

Losses as a network makes them at random: independent, or in bursts; on the way to the host and back.

A link is in a good or in a bad state, which moves before each frame; each state loses frames with its own
probability (Gilbert 1960, Elliott 1963). Both links together are a chain of up to four hidden states. A
period's outcome tells which of its two frames were lost.
"""

import math
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.held_loop import HeldInput, LoadedPeriods, Operation


class LossyLink(NamedTuple):
    """Losses on one link, each figure a probability; independent ones have ``loss_good`` alone."""

    p_good_to_bad: float = 0.0
    p_bad_to_good: float = 1.0
    loss_bad: float = 1.0
    loss_good: float = 0.0

    @property
    def loss(self) -> float:
        """Share of lost frames in the long run."""
        came, lost = self.outcomes()
        at = stationary(came + lost)
        return float((at @ lost).sum())

    def outcomes(self) -> Array:
        """Return (2, m, m) probabilities to move from state to state and have the frame come, or be lost."""
        if self.p_good_to_bad == 0.0:
            return np.array([[[1.0 - self.loss_good]], [[self.loss_good]]])
        up, down = self.p_good_to_bad, self.p_bad_to_good
        moves = np.array([[1.0 - up, up], [down, 1.0 - down]])
        lost = np.array([self.loss_good, self.loss_bad])
        return np.array([moves * (1.0 - lost), moves * lost])


class Outcome(NamedTuple):
    """Frames of one period that were lost."""

    reading: bool
    command: bool


class Fates(NamedTuple):
    """Outcomes that have a probability, and for each of them (m, m) from hidden state to hidden state."""

    outcomes: tuple[Outcome, ...]
    moves: Array
    """(outcomes, m, m)."""


def fates_of(readings: LossyLink, commands: LossyLink) -> Fates:
    """Return those of two links that know nothing of one another."""
    both = {
        Outcome(bool(i), bool(j)): np.kron(reading, command)
        for i, reading in enumerate(readings.outcomes())
        for j, command in enumerate(commands.outcomes())
    }
    possible = {outcome: moves for outcome, moves in both.items() if moves.any()}
    return Fates(tuple(possible), np.array(list(possible.values())))


def stationary(moves: Array) -> Array:
    """Return the (m,) distribution that ``moves`` (m, m), rows from, leaves as it is."""
    one = np.ones(len(moves))
    return np.asarray(np.linalg.solve(np.eye(len(moves)) - moves.T + 1.0, one))


WITHIN = 16
"""Instants of a period at which the error is evaluated: with four times as many a peak rises by 0.1 %."""
_OVER = 1e-3
"""Share of the largest mean and deviation below which a load step counts as over."""
_CLOSE = 1e-12
_PERIODS_MAX = 20_000
_ROUNDS = 2000


class Remembering(Protocol):
    """A controller's periods under losses."""

    @property
    def loop(self) -> HeldInput:
        """Its loop."""

    @property
    def period_s(self) -> float:
        """From sample to sample."""

    @property
    def newest(self) -> int:
        """Place of its newest command in xi; behind it are the ones before."""

    @property
    def quiet(self) -> Hashable:
        """A memory without losses, long after the last load step."""

    def after(self, memory: Any, outcome: Outcome) -> Hashable:
        """Return the memory that follows."""

    def struck(self, memory: Any) -> Hashable:
        """Return what a load step makes of ``memory``."""

    def chain(self, memory: Any, outcome: Outcome) -> Sequence[Operation]:
        """Return the operations of a period."""


class Moments(NamedTuple):
    """The error after a load step of 1 N m, at :data:`WITHIN` instants of each period."""

    mean: Array
    """(n,) rad/s."""
    deviation: Array
    """(n,) standard deviation, rad/s."""


class JumpLoop:
    """``controller`` under ``fates``, met at rest by a load of 1 N m that comes just after a sample."""

    def __init__(self, controller: Remembering, fates: Fates) -> None:
        self.period_s, self.fates = controller.period_s, fates
        quiet, lasting = _reached(controller, fates, [controller.quiet])
        memories, following = _reached(controller, fates, list(map(controller.struck, quiet)))
        self.following = following
        """(memories, outcomes): number of the memory that follows."""
        numbers = {memory: number for number, memory in enumerate(memories)}
        loaded = LoadedPeriods(controller.loop, controller.period_s, WITHIN)
        periods = [
            [loaded.period(controller.chain(memory, outcome)) for outcome in fates.outcomes]
            for memory in memories
        ]
        self.maps = np.array([[whole for whole, _ in row] for row in periods])
        """(memories, outcomes, N, N): of xi and the load, from sample to sample."""
        self.looks = np.array([[looks for _, looks in row] for row in periods])
        """(memories, outcomes, WITHIN, N): the error within a period."""
        self.begun, self.at_first = loaded.begin()
        """(N,) at the first sample under the load, and the (WITHIN,) errors until then."""
        shares = _shares(lasting, fates)
        self.start = np.zeros((len(memories), shares.shape[1]))
        """(memories, m) probabilities of the modes at that sample."""
        for memory, share in zip(quiet, shares, strict=True):
            self.start[numbers[controller.struck(memory)]] += share
        A, b = self.maps[0, 0, :-1, :-1], self.maps[0, 0, :-1, -1]
        self.rest = np.append(np.linalg.solve(np.eye(len(A)) - A, b), 1.0)
        """(N,): at rest under the load."""

    @property
    def error_at_rest(self) -> float:
        """Error that remains, rad/s per N m."""
        return float(self.looks[0, 0, -1] @ self.rest)

    def decay_per_s(self) -> float:
        """Return the rate at which the rms of xi decays, 1/s; negative: unstable in mean square."""
        size = self.maps.shape[2] - 1
        shape = (*self.start.shape, size, size)

        def moved(X: Array) -> Array:
            return self._moved(X.reshape(shape), self.maps[:, :, :-1, :-1]).ravel()

        first = np.broadcast_to(np.eye(size), shape).ravel()
        radius = _radius(LinearOperator((first.size, first.size), matvec=moved, dtype=float), first)
        return math.inf if radius <= 0.0 else -0.5 * math.log(radius) / self.period_s

    def moments(self) -> Moments:
        """Return mean and deviation after the step until both are over; the loop decays in mean square."""
        X = self.start[:, :, None, None] * np.outer(self.begun, self.begun)
        means, variances = [self.at_first], [np.zeros(WITHIN)]
        largest = widest = 0.0
        for _ in range(_PERIODS_MAX):
            mean, square = np.zeros(WITHIN), np.zeros(WITHIN)
            for outcome, moves in enumerate(self.fates.moves):
                weighed, looks = np.einsum("i,mi...->m...", moves.sum(axis=1), X), self.looks[:, outcome]
                mean += np.einsum("mwn,mn->w", looks, weighed[..., -1])
                square += ((looks @ weighed) * looks).sum(axis=(0, 2))
            means.append(mean)
            variances.append(np.maximum(square - mean * mean, 0.0))
            apart, wide = np.abs(mean - self.error_at_rest).max(), variances[-1].max()
            largest, widest = max(largest, apart), max(widest, wide)
            if apart <= _OVER * largest and wide <= _OVER**2 * max(widest, largest**2):
                break
            X = self._moved(X, self.maps)
        return Moments(np.concatenate(means), np.sqrt(np.concatenate(variances)))

    def squares_to_come(self) -> Array:
        """Return (memories, m, N, N) V: what the squares of all later errors add up to on average.

        Of xi beside its rest, in a loop that decays in mean square: V = Q + sum over outcomes of A' V A.
        """
        squared = np.einsum("mown,mowk->monk", self.looks, self.looks)
        Q = np.einsum("oij,monk->mink", self.fates.moves, squared)
        V: Array = np.zeros_like(Q)
        for _ in range(_PERIODS_MAX):
            later = Q.copy()
            for outcome, moves in enumerate(self.fates.moves):
                A = self.maps[:, outcome, None]
                ahead = np.einsum("ij,mjnk->mink", moves, V[self.following[:, outcome]])
                later += A.transpose(0, 1, 3, 2) @ ahead @ A
            later[..., -1, :] = later[..., -1] = 0.0
            if np.abs(later - V).max() <= _CLOSE * np.abs(later).max():
                break
            V = later
        return V

    def _moved(self, X: Array, maps: Array) -> Array:
        """Return the moments (memories, m, N, N) a period later."""
        later = np.zeros_like(X)
        for outcome, moves in enumerate(self.fates.moves):
            A = maps[:, outcome, None]
            moved = np.einsum("ij,mink->mjnk", moves, A @ X @ A.transpose(0, 1, 3, 2))
            np.add.at(later, self.following[:, outcome], moved)
        return later


def _reached(
    controller: Remembering, fates: Fates, first: Sequence[Hashable]
) -> tuple[list[Hashable], NDArray[np.intp]]:
    """Return the memories that follow from ``first``, and (memories, outcomes) the number of each next
    one."""
    numbers = {memory: number for number, memory in enumerate(dict.fromkeys(first))}
    following: list[list[int]] = []
    waiting = list(numbers)
    for memory in waiting:
        row = []
        for outcome in fates.outcomes:
            later = controller.after(memory, outcome)
            if later not in numbers:
                numbers[later] = len(numbers)
                waiting.append(later)
            row.append(numbers[later])
        following.append(row)
    return list(numbers), np.array(following)


def _shares(following: NDArray[np.intp], fates: Fates) -> Array:
    """Return (memories, m): how often each mode occurs in the long run."""
    memories, m = len(following), fates.moves.shape[1]
    moves = np.zeros((memories, m, memories, m))
    for memory, row in enumerate(following):
        for outcome, later in enumerate(row):
            moves[memory, :, later] += fates.moves[outcome]
    return stationary(moves.reshape(memories * m, memories * m)).reshape(memories, m)


def _radius(moved: LinearOperator, first: Array) -> float:
    """Return the spectral radius of a map of second moments: its largest eigenvalue, which is real."""
    try:
        return float(np.abs(eigs(moved, k=1, v0=first, tol=1e-10, return_eigenvectors=False)[0]))
    except ArpackNoConvergence:  # eigenvalues of equal size: the trace's growth tells it as well
        X, grown = first, 1.0
        for _ in range(_ROUNDS):
            X = moved.matvec(X)
            grown = float(np.abs(X).max())
            X = X / grown
        return grown


_PATHS = 8192
"""Sequences that are followed at once."""
_SHARE, _OPEN = 1e-4, 1e-7
"""What may be closed in a period, of the probability found so far, and beside it."""
_EXCEEDANCE_PERIODS_MAX = 5000


class Between(NamedTuple):
    """Bounds of a probability."""

    low: float
    high: float


def exceedance(loop: JumpLoop, threshold: float, squares_to_come: Array | None) -> Between:
    """Bound the probability that the error exceeds ``threshold``, rad/s per N m, at any of the instants.

    ``squares_to_come``: of :meth:`JumpLoop.squares_to_come`; None for a loop that does not decay in mean
    square.
    """
    room = threshold - abs(loop.error_at_rest)
    if room <= 0.0 or np.abs(loop.at_first).max() > threshold:
        return Between(1.0, 1.0)
    memories = np.flatnonzero(loop.start.sum(axis=1) > 0.0)
    weights = loop.start[memories]
    states = np.repeat(loop.begun[None], len(memories), axis=0)
    exceeded = closed = 0.0
    for _ in range(_EXCEEDANCE_PERIODS_MAX):
        parts = []
        for memory in np.unique(memories):
            here = memories == memory
            for outcome, moves in enumerate(loop.fates.moves):
                errors = states[here] @ loop.looks[memory, outcome].T
                after = weights[here] @ moves
                beyond = np.abs(errors).max(axis=1) > threshold
                exceeded += float(after[beyond].sum())
                kept = ~beyond & (after.sum(axis=1) > 0.0)
                moved = states[here][kept] @ loop.maps[memory, outcome].T
                parts.append((moved, np.full(len(moved), loop.following[memory, outcome]), after[kept]))
        states, memories, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
        most = _most(loop, states, memories, weights, squares_to_come, room)
        order = np.argsort(-most, kind="stable")
        # of the smallest, and of those beyond the limit
        few = np.cumsum(most[order[::-1]])[::-1] <= _SHARE * exceeded + _OPEN
        few[_PATHS:] = True
        closed += float(most[order[few]].sum())
        order = order[~few]
        if not len(order):
            break
        states, memories, weights = states[order], memories[order], weights[order]
    else:
        closed += float(most.sum())
    return Between(exceeded, min(1.0, exceeded + closed))


def _most(
    loop: JumpLoop,
    states: Array,
    memories: NDArray[np.intp],
    weights: Array,
    squares_to_come: Array | None,
    room: float,
) -> Array:
    """Return (paths,) the largest probability of each that it exceeds yet."""
    most = np.asarray(weights.sum(axis=1))
    if squares_to_come is None:
        return most
    apart = states - loop.rest
    for memory in np.unique(memories):
        here = memories == memory
        for hidden, V in enumerate(squares_to_come[memory]):
            to_come = ((apart[here] @ V) * apart[here]).sum(axis=1) / room**2
            most[here] -= weights[here, hidden] * np.maximum(0.0, 1.0 - to_come)
    return most
