"""The probability that the error after a load step exceeds a threshold at any time, from both sides.

Sequences of outcomes branch from period to period, each with its probability and its own error. One that has
exceeded the threshold counts whole. Those that can still add most are followed, the others closed by
Chebyshev's inequality, summed over all later instants: on average the squares of the errors to come add up to
xi' V xi, and no threshold c is exceeded with more than that over c^2. What is exceeded for certain, and that
with all that is closed, are the two ends.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.jump_loop import JumpLoop

_PATHS = 8192
"""Sequences that are followed at once."""
_SHARE, _OPEN = 1e-4, 1e-7
"""What may be closed in a period, of the probability found so far, and beside it."""
_PERIODS_MAX = 5000


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
    for _ in range(_PERIODS_MAX):
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
