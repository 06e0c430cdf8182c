"""The steps of a sampled loop as value maps, on a grid of switching times with a bound between grid points.

With u(t) = w + sum_s Delta_s xi 1[t >= tau_s] the state at a period's end and the error within it are
affine in F(tau_s), the response to a step of the input at tau_s. Between two neighbours of the grid F
departs from its chord by at most width^2/8 times the largest of F'' (the output too: a step of the input
moves neither it nor its slope). So for any tau in a cell, and any epsilon > 0,

    value(tau) <= (1 + epsilon) max over the cell's corners of value at gain/sqrt(1 + epsilon)
                  + (1 + 1/epsilon) sum_s r (R_s' P R_s + |Z_s|^2) (Delta_s xi)^2

with R_s and Z_s the bounds of the departure of the state and of the output, r the number of open
windows; for the square of a norm is convex. Where windows overlap, order cuts a cell: the corners of what is
left count, some of them between the instants of a window's own grid.

The rate a of the current loop may lie anywhere between two: the disturbance does not reach the current,
so state and output are affine in e^{-a t}, the response to i_q - u at the begin and to every Delta_s.
Its chord between the two rates is bounded in the same way, each such response adding one term to r.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import Family, Window
from servobench.design.sampled.held_loop import Flow, HeldLoop, Jump, Operation, PeriodStep, SwitchedLoop
from servobench.design.sampled.value_map import ValueMap, flows, stacked

_SUBCELL_TURN = 0.2
"""Norm of |A| times the width of the part of a cell on which |F''| is bounded from its value at one end."""
_CELLS_MAX = 512
"""Cells of one window."""
_SAME_S = 1e-15
"""Difference of two instants that are one: ends of a window are rounded to 1e-19 s."""


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """All corners of a family: steps, and the bounds between them.

    ``bends``: (N, windows, n) R_s above; ``output_bends``: (N, windows) Z_s, zero where a window is a point.
    """

    family: Family
    times_s: Array
    """(N, windows)."""
    bends: Array
    output_bends: Array
    differences: Array
    """(windows, kept): Delta_s."""
    constants: Array
    """(N, windows): what is added to the value, times the square of Delta_s xi."""
    longer_s: Array
    """(N,): by which the period is longer."""

    @property
    def terms(self) -> int:
        """r above."""
        return int(np.count_nonzero(self.bends.any(axis=(0, 2)))) if self.bends.size else 0

    def between_rates(self, loop: SwitchedLoop, other: SwitchedLoop) -> "Corners":
        """Return the same with the terms for every rate of the current loop between those of the two
        loops."""
        n = len(loop.model.A)
        start = np.zeros(loop.kept)
        start[0], start[n] = 1.0, -1.0
        rows = np.vstack([start, self.differences])
        bend, output = _rate_bend(loop, other)
        count, added = len(self.times_s), len(rows)
        return Corners(
            self.family,
            self.times_s,
            np.concatenate([self.bends, np.broadcast_to(bend, (count, added, n))], axis=1),
            np.hstack([self.output_bends, np.full((count, added), output)]),
            np.vstack([self.differences, rows]),
            np.zeros((count, rows.shape[0] + self.differences.shape[0])),
            self.longer_s,
        )


def corners_of(loop: SwitchedLoop, family: Family, coordinates: Array, target: float) -> Corners:
    """Return corners so dense that no bend times its difference exceeds ``target`` in ``coordinates``."""
    differences = loop.differences([window.back for window in family.windows])
    if not isinstance(loop, HeldLoop):  # whose switchings alone may come sooner or later
        ends_s = [window.last_s for window in family.windows]
        variants, windows = len(loop.variants(family.at(ends_s))), len(ends_s)
        none = np.zeros((variants, windows))
        bends = np.zeros((variants, windows, len(loop.model.A)))
        times_s = np.tile(ends_s, (variants, 1))
        return Corners(family, times_s, bends, none, differences, none, np.zeros(variants))
    n = len(loop.model.A)
    inverse = np.linalg.inv(coordinates)
    grids, bounds = [], []
    for window, difference in zip(family.windows, differences, strict=True):
        share = target / max(float(np.linalg.norm(difference @ inverse)), 1e-300)
        times, bends, outputs = _grid(loop, window, coordinates[:, :n], share)
        grids.append(times)
        bounds.append((bends, outputs))
    corners = list(_ordered(family.windows, grids))
    count, windows = len(corners), len(grids)
    all_bends, outputs_s = np.zeros((count, windows, n)), np.zeros((count, windows))
    for row, chosen in enumerate(corners):
        for s, time_s in enumerate(chosen):
            # between two instants of a grid the bound of the later covers their cell
            place = min(int(np.searchsorted(grids[s], time_s - _SAME_S)), len(grids[s]) - 1)
            all_bends[row, s], outputs_s[row, s] = bounds[s][0][place], bounds[s][1][place]
    times_s, none = np.array(corners).reshape(count, windows), np.zeros((count, windows))
    return Corners(family, times_s, all_bends, outputs_s, differences, none, np.zeros(count))


def _ordered(windows: Sequence[Window], grids: Sequence[Array]) -> Iterator[tuple[float, ...]]:
    """Yield the corners of the ordered parts of all cells.

    A cell is a box of one interval of each grid. Where windows overlap, order cuts it: at a corner of what is
    left, samples that begin to act together do so at an instant of the grid of one of them.
    """
    count = len(windows)
    for cuts in itertools.product((False, True), repeat=max(0, count - 1)):
        ends = [place + 1 for place, cut in enumerate(cuts) if cut]
        groups = list(itertools.pairwise([0, *ends, count])) if count else []
        instants = []
        for begin, end in groups:
            first_s = max(window.first_s for window in windows[begin:end])
            last_s = min(window.last_s for window in windows[begin:end])
            own = np.unique(np.concatenate(grids[begin:end]))
            instants.append(own[(own >= first_s) & (own <= last_s)])
        for chosen in itertools.product(*instants):
            # of two groups at one instant another choice of groups has the corner
            if all(one + _SAME_S < other for one, other in itertools.pairwise(chosen)):
                sizes = [end - begin for begin, end in groups]
                yield tuple(np.repeat(chosen, sizes).tolist())


def _grid(loop: SwitchedLoop, window: Window, coordinates: Array, share: float) -> tuple[Array, Array, Array]:
    """Return times from the window's begin to its end; at each the larger of the bounds of the adjacent
    cells."""
    n = len(loop.model.A)
    if window.last_s - window.first_s <= 1e-12 * loop.network.period_s:
        return np.array([window.first_s]), np.zeros((1, n)), np.zeros(1)
    times, bends, outputs = [window.first_s], [], []
    stack = [(window.first_s, window.last_s)]
    while stack:
        first_s, last_s = stack.pop()
        bend, output = bend_of(loop, first_s, last_s)
        size = math.hypot(float(np.sum(np.linalg.norm(coordinates, axis=0) * bend)), output)
        if size > share and len(times) + len(stack) < _CELLS_MAX:
            middle_s = 0.5 * (first_s + last_s)
            stack += [(middle_s, last_s), (first_s, middle_s)]
            continue
        times.append(last_s)
        bends.append(bend)
        outputs.append(output)
    cells, cell_outputs = np.array(bends), np.array(outputs)
    left, right = np.vstack([cells[:1], cells]), np.vstack([cells, cells[-1:]])
    own = np.append(cell_outputs[:1], cell_outputs), np.append(cell_outputs, cell_outputs[-1:])
    return np.array(times), np.maximum(left, right), np.maximum(*own)


def bend_of(loop: SwitchedLoop, first_s: float, last_s: float) -> tuple[Array, float]:
    """Return width^2/8 times the largest of F'' on a cell: of the state at the period's end (n,), of the
    output."""
    A, B1, C = loop.model.A, loop.model.B1, loop.model.C
    if abs(C @ B1) > 0.0:
        raise NoSolution("certificate for arbitrary sequences", "the input acts on the output at once")
    width = last_s - first_s
    size = np.abs(A)
    parts = max(1, math.ceil(width * float(np.linalg.norm(size, 2)) / _SUBCELL_TURN))
    step = expm(A * (width / parts))
    grow = expm(size * (width / parts))
    vector = A @ expm(A * max(0.0, loop.network.shortest_s - last_s)) @ B1
    largest = np.zeros(len(A))
    uneven_s = loop.network.longest_s - loop.network.shortest_s
    for _ in range(parts + math.ceil(parts * uneven_s / width)):
        largest = np.maximum(largest, grow @ np.abs(vector))
        vector = step @ vector
    slope = C @ A
    # the square integral of the output's second derivative, over the whole rest of the period
    rest_s = loop.network.longest_s - first_s
    energy = _energy(A, B1, slope, rest_s)
    return width**2 / 8.0 * largest, width**2 / 8.0 * math.sqrt(energy)


def _rate_bend(loop: SwitchedLoop, other: SwitchedLoop) -> tuple[Array, float]:
    """Return (difference of the rates)^2/8 times the largest second derivative by the rate: state (n,),
    output.

    That of e^{-at} is t^2 e^{-at}, at most 4/(e a)^2, its integral 2/a^3; friction makes it only less.
    """
    A, h = loop.model.A, loop.network.period_s
    slow, fast = sorted(-each.model.A[0, 0] for each in (loop, other))
    share = (fast - slow) ** 2 / 8.0
    speed = float(A[1, 0]) * 2.0 / slow**3
    state = [4.0 / (math.e * slow) ** 2, speed, speed * h]
    return share * np.array(state[: len(A)]), share * speed * math.sqrt(h)


def _energy(A: Array, B1: Array, row: Array, length_s: float) -> float:
    """Return the integral over [0, length] of (row e^{At} B1)^2 (Van Loan, IEEE Trans. Autom. Control 23(3),
    1978)."""
    n = len(A)
    halvings = max(0, math.ceil(math.log2(max(length_s * float(np.linalg.norm(A, 2)), 1.0))))
    M = np.block([[-A.T, np.outer(row, row)], [np.zeros((n, n)), A]]) * (length_s / 2.0**halvings)
    turned = expm(M)
    Phi = turned[n:, n:]
    gramian = Phi.T @ turned[:n, n:]
    for _ in range(halvings):
        gramian = gramian + Phi.T @ gramian @ Phi
        Phi = Phi @ Phi
    return max(float(B1 @ gramian @ B1), 0.0)


def value_maps(loop: SwitchedLoop, corners: Corners, gain: float) -> ValueMap:
    """Return the value maps (N,) of the steps of ``corners``, between the entries kept."""
    family, times_s = corners.family, corners.times_s
    if not isinstance(loop, HeldLoop):
        ends = dict.fromkeys(corners.longer_s.tolist())
        steps = [family.at(times_s[0].tolist(), longer_s) for longer_s in ends]
        return stacked(_chain_maps(loop, [each for step in steps for each in loop.variants(step)], gain))
    h = loop.network.period_s
    count = len(times_s)
    edges = np.hstack([np.zeros((count, 1)), times_s, h + corners.longer_s[:, None]])
    lengths = np.maximum(np.diff(edges, axis=1), 0.0)
    unique, places = np.unique(np.round(lengths / h, 14), return_inverse=True)
    places = places.reshape(lengths.shape)
    flow = embedded_flows(loop, unique * h, gain)
    total = flow[places[:, 0]].after_jump(loop.sampling)
    for s, window in enumerate(family.windows):
        total = total.then_jump(loop.applying(window.back)).then(flow[places[:, s + 1]])
    k = loop.kept
    return ValueMap(total.Phi[:, :k, :k], total.W[:, :k, :k], total.Q[:, :k, :k], total.bounded)


def embedded_flows(loop: SwitchedLoop, lengths_s: Array, gains: ArrayLike) -> ValueMap:
    """Return the flows of x and w over ``lengths_s``, all else of xi standing still."""
    n = len(loop.model.A) + 1
    E, C = np.append(loop.model.B2, 0.0), np.append(loop.model.C, 0.0)
    own = flows(loop.generator[:n, :n], E, C, gains, lengths_s)
    shape = (*own.bounded.shape, loop.size, loop.size)
    Phi, W, Q = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    Phi[:] = np.eye(loop.size)
    Phi[..., :n, :n], W[..., :n, :n], Q[..., :n, :n] = own.Phi, own.W, own.Q
    return ValueMap(Phi, W, Q, own.bounded)


def step_maps(loop: SwitchedLoop, steps: Sequence[PeriodStep], gains: ArrayLike) -> list[ValueMap]:
    """Return the value map of each of ``steps`` at each of ``gains``."""
    return _chain_maps(loop, [loop.chain(step) for step in steps], gains)


def _chain_maps(
    loop: SwitchedLoop, chains: Sequence[Sequence[Operation]], gains: ArrayLike
) -> list[ValueMap]:
    unique = sorted({max(0.0, each.length_s) for chain in chains for each in chain if isinstance(each, Flow)})
    flow = embedded_flows(loop, np.array(unique), gains)
    k = loop.kept
    maps = []
    for first, *rest in chains:
        total: ValueMap | None = None
        assert isinstance(first, Jump)
        for operation in rest:
            if isinstance(operation, Jump):
                assert total is not None
                total = total.then_jump(operation.J)
                continue
            own = flow[unique.index(max(0.0, operation.length_s))]
            total = own.after_jump(first.J) if total is None else total.then(own)
        assert total is not None
        parts = (total.Phi[..., :k, :k], total.W[..., :k, :k], total.Q[..., :k, :k])
        maps.append(ValueMap(*parts, total.bounded))
    return maps
