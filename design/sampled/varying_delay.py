"""Commands that begin to act at any instant of an interval, another one in each period.

A command that acts from tau on, in [a, b], changes the input by delta, a row times the state. The state at
the period's end and the error within it are affine in the response to a step of the input at tau. Between two
neighbours of a grid that departs from its chord by at most width^2/8 times its second derivative, which is
e^{A (t - tau)} A B1: what any tau makes of a state lies, but for that times delta, in the hull of what the
grid makes of it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.errors import NoSolution
from servobench.design.sampled.held_loop import Flow, Jump, Operation

GRIDS = (1e-2, 1e-3)
"""Shares of the largest response by which one may depart from its chord, tried in turn."""
_PARTS = 16
"""Parts of a cell at whose ends its second derivative is evaluated; between them it may only grow."""
_CELLS_MAX = 64
_WHOLE = 1e-9


class DelayRange(NamedTuple):
    """From a sample's instant to that at which its command begins to act, s."""

    least_s: float
    most_s: float


class Begin(NamedTuple):
    """An instant of a grid, and the bounds of the departure from the chords beside it."""

    whole: int
    """Periods between sample and period."""
    at_s: float
    """In that period."""
    state: Array
    """(n,): of the state at the period's end, for a step of 1 of the input."""
    error: float
    """Of the error within the period."""
    at_end: bool = True
    """False: between the least and the largest delay."""


def begins(
    delays: DelayRange, period_s: float, light: SpeedModel, heavy: SpeedModel, close: float
) -> list[Begin]:
    """Return the grid; ``light``, ``heavy``: with the ends of the range of inertias. Raises NoSolution for
    delays on both sides of a sample."""
    whole = math.floor(delays.least_s / period_s + _WHOLE)
    first_s, last_s = (max(0.0, each - whole * period_s) for each in delays)
    if last_s > period_s * (1.0 + _WHOLE):
        raise NoSolution(
            "certificate over delays",
            f"{1e3 * delays.least_s:g} to {1e3 * delays.most_s:g} ms: expected no sample between the two, "
            f"one comes every {1e3 * period_s:g} ms",
        )
    last_s = min(last_s, period_s)
    n = len(light.A)
    if last_s - first_s <= _WHOLE * period_s:
        return [Begin(whole, first_s, np.zeros(n), 0.0)]
    if abs(float(light.C @ light.B1)) > 0.0:
        raise NoSolution("certificate over delays", "the input acts on the error at once")
    bounds = np.abs(light.A)
    np.fill_diagonal(bounds, np.maximum(np.diag(light.A), np.diag(heavy.A)))
    curved = np.abs(light.A) @ np.abs(light.B1)
    unit = np.maximum(_filled(bounds, np.abs(light.B1), period_s), 1e-300)
    onward = expm(bounds * period_s)  # by the next sample what the current loop has left does not count
    everywhere = float(np.abs(light.C) @ _largest(bounds, curved, 0.0, period_s))

    def bend(first: float, last: float) -> tuple[Array, float]:
        share = (last - first) ** 2 / 8.0
        return share * _largest(bounds, curved, period_s - last, period_s - first), share * everywhere

    cells: list[tuple[float, Array, float]] = []
    waiting = [(first_s, last_s)]
    while waiting:
        first, last = waiting.pop()
        state, error = bend(first, last)
        if max(float((onward @ state / unit).max()), error / float(np.abs(light.C) @ unit)) > close:
            middle = 0.5 * (first + last)
            waiting += [(middle, last), (first, middle)]
            if len(cells) + len(waiting) > _CELLS_MAX:
                raise NoSolution("certificate over delays", "the current loop is too fast for these delays")
            continue
        cells.append((last, state, error))
    ends = [first_s, *(last for last, _, _ in cells)]
    beside = [cells[0], *cells], [*cells, cells[-1]]
    return [
        Begin(whole, at_s, np.maximum(one[1], other[1]), max(one[2], other[2]), at_s in (first_s, last_s))
        for at_s, one, other in zip(ends, *beside, strict=True)
    ]


def _largest(bounds: Array, curved: Array, first_s: float, last_s: float) -> Array:
    """Bound e^{A s} ``curved``, entry by entry, for s between the two."""
    step_s = (last_s - first_s) / _PARTS
    at_s = first_s + step_s * np.arange(_PARTS)
    largest = (expm(bounds * at_s[:, None, None]) @ curved).max(axis=0)
    return np.asarray(expm(np.maximum(bounds, 0.0) * step_s) @ largest)


def _filled(bounds: Array, B: Array, period_s: float) -> Array:
    n = len(bounds)
    larger = np.zeros((n + 1, n + 1))
    larger[:n, :n], larger[:n, n] = bounds, B
    return np.asarray(expm(larger * period_s)[:n, n])


def begun(
    chain: Sequence[Operation], newest: int, held: int, begin: Begin, period_s: float
) -> list[Operation]:
    """Return a period in which a command begins to act at ``begin``; one without a command as it is.

    ``newest``: place of the newest command in xi, behind it the ones before; ``held``: that of the input.
    """
    if not acts(chain):
        return list(chain)
    sampled, acting, rest = chain[0], np.eye(len(chain[2].J)), chain[4:]  # type: ignore[union-attr]
    place = newest + begin.whole
    if place >= len(acting):
        raise NoSolution("certificate over delays", "the delays are longer than the loop was made for")
    acting[held], acting[held, place] = 0.0, 1.0
    return [sampled, Flow(begin.at_s), Jump(acting), Flow(period_s - begin.at_s), *rest]


def acts(chain: Sequence[Operation]) -> bool:
    """Return True if a command begins to act in a period."""
    return len(chain) > 3 and isinstance(chain[2], Jump)
