"""Ends of periods that are uneven: a grid of them, with a bound of what lies between.

After the shortest period the rest of an uneven one is a flow of s = 0 to s_max under a held input. With S(s)
the value, before it, of a quadratic function after it, and cells of s of width d,

    S(s)  <=  a chord of two neighbours  +  d^2/8 max(-S'')  <=  (1 + epsilon) of that chord

    where    -d^2/8 S''(sigma) <= epsilon S      at both ends of the cell, for sigma in it
             S' = F' S + S F + C'C + S W S,  W = E E'/gain^2

and what comes before is convex in S, as the largest of functions that are linear in it. A sample that begins
to act within the rest does so at an instant of the same grid; at the period's very end the input before it
counts no more, so that S is made definite by room times the square of what the sample adds to it.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.sampled.held_loop import HeldLoop, SwitchedLoop
from servobench.design.sampled.step_maps import Corners, bend_of, embedded_flows

_CELL_TURN = 0.015
"""Fastest rate of the plant times the width of a cell."""
_ROOM = 0.4
"""room, as a share of epsilon where the value is of size 1."""
_WITHIN = 1.5
"""The largest of -S'' within a cell over that at its ends: by less than a tenth of it S'' changes there."""


def with_ends(loop: SwitchedLoop, corners: Corners, coordinates: Array, epsilon: float) -> Corners:
    """Return ``corners`` with every end of its period. Raises NoSolution for samples that act later still."""
    grid = _grid(loop)
    count, ends = len(corners.times_s), len(grid)
    rows, longer_s = np.tile(np.arange(count), ends), np.repeat(grid - loop.network.uneven_s, count)
    whole = _rows(corners, rows, longer_s)
    windows = corners.family.windows
    if not (isinstance(loop, HeldLoop) and windows and windows[-1].to_end):
        return whole
    if len(windows) > 2 or loop.network.behind > 1:
        raise NoSolution(
            "certificate for uneven periods", "a sample may act after two of the shortest periods"
        )
    last_s, width_s = loop.network.shortest_s, float(grid[1])
    late = np.flatnonzero(corners.times_s[:, -1] >= last_s * (1.0 - 1e-12))
    bend, output = bend_of(loop, last_s, last_s + width_s)
    parts = [whole]
    for begun, end in itertools.combinations_with_replacement(range(ends), 2):
        part = _rows(corners, late, np.full(len(late), grid[end] - loop.network.uneven_s))
        for each, value in (
            (part.times_s, last_s + grid[begun]),
            (part.bends, bend),
            (part.output_bends, output),
            (part.constants, _room(loop, coordinates, epsilon) if begun == end else 0.0),
        ):
            each[:, -1] = value
        parts.append(part)
    return _joined(parts)


def ends_covered(loop: SwitchedLoop, P: Array, gain: float, coordinates: Array, epsilon: float) -> bool:
    """Return True if of the function P (kept, kept) what lies between the ends is within ``epsilon``."""
    n, k, grid = len(loop.model.A) + 1, loop.kept, _grid(loop)
    F, W, Q = np.zeros((k, k)), np.zeros((k, k)), np.zeros((k, k))
    F[:n, :n] = loop.generator[:n, :n]
    if math.isfinite(gain):
        W[: n - 1, : n - 1] = np.outer(loop.model.B2, loop.model.B2) / gain**2
        Q[: n - 1, : n - 1] = np.outer(loop.model.C, loop.model.C)
    functions = [P]
    if isinstance(loop, HeldLoop) and loop.network.behind:
        # the newest sample begins to act as the period ends
        J = loop.applying(0)[:k, :k]
        apart = np.eye(k)[n - 1] - np.eye(k)[n]
        functions.append(J.T @ P @ J + _room(loop, coordinates, epsilon) * np.outer(apart, apart))
    flow = embedded_flows(loop, grid, gain)
    flow = replace(flow, Phi=flow.Phi[:, :k, :k], W=flow.W[:, :k, :k], Q=flow.Q[:, :k, :k] * (Q.any()))
    share = _WITHIN * float(grid[1]) ** 2 / 8.0 / epsilon
    for function in functions:
        values, finite = flow.of(function)
        if not finite.all():
            return False
        bends = []
        for S in values:
            slope = F.T @ S + S @ F + Q + S @ W @ S
            bends.append(-(F.T @ slope + slope @ F + slope @ W @ S + S @ W @ slope))
        for place in range(len(grid) - 1):
            for S in values[place : place + 2]:
                for bend in bends[place : place + 2]:
                    try:
                        most = float(eigh(bend, S, eigvals_only=True)[-1])
                    except np.linalg.LinAlgError:
                        return False
                    if share * most > 1.0:
                        return False
    return True


def _grid(loop: SwitchedLoop) -> Array:
    """Return (ends,) s from 0 to the difference of the longest and the shortest period."""
    rate = float(np.max(np.abs(np.linalg.eigvals(loop.model.A))))
    whole_s = loop.network.longest_s - loop.network.shortest_s
    return np.linspace(0.0, whole_s, 1 + math.ceil(whole_s * rate / _CELL_TURN))


def _room(loop: HeldLoop, coordinates: Array, epsilon: float) -> float:
    """Return room, so that it adds a share of epsilon where the value is of size 1 in ``coordinates``."""
    rows = [loop.differences(backs)[-1] for backs in ([0], [1, 0])]
    largest = max(float(np.linalg.norm(row @ np.linalg.inv(coordinates))) for row in rows)
    return _ROOM * epsilon / largest**2


def _rows(corners: Corners, rows: NDArray[np.intp], longer_s: Array) -> Corners:
    return replace(
        corners,
        times_s=corners.times_s[rows],
        bends=corners.bends[rows],
        output_bends=corners.output_bends[rows],
        constants=corners.constants[rows],
        longer_s=longer_s,
    )


def _joined(parts: list[Corners]) -> Corners:
    return replace(
        parts[0],
        times_s=np.concatenate([each.times_s for each in parts]),
        bends=np.concatenate([each.bends for each in parts]),
        output_bends=np.concatenate([each.output_bends for each in parts]),
        constants=np.concatenate([each.constants for each in parts]),
        longer_s=np.concatenate([each.longer_s for each in parts]),
    )
