"""The inequalities of a loop whose samples begin to act at any instant of their windows.

Between two instants of a grid the state at a period's end departs from its chord by at most width^2/8 of the
largest second derivative, and so does the error. So for any eps > 0 the value is at most 1 + eps of the
largest of the corners' values, at a gain smaller by (1 + eps)^{1/2}, plus 1 + 1/eps of the squares of these
departures, times the number of open windows. All windows share the grid: where two overlap, the ordered part
of a square cell is the hull of its ordered corners.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, arb_mat

from servobench.design.verify.balls import (
    GREATER,
    Ball,
    NotProved,
    cut,
    embedded,
    exact,
    joined,
    number,
    of_doubles,
    require_positive,
    rounded,
    whitening,
)
from servobench.design.verify.loops import Operation, RebuiltLoop, RebuiltStep
from servobench.design.verify.proofs import BEYOND, EPS, PARTS_MAX, Proof
from servobench.design.verify.uneven import Ends, ends_us

ROOM = 0.6
"""Departure over eps, both as shares of a value: its square over eps is a third of eps."""
EPS_OF_UNEVEN = 3e-4
"""EPS where periods are uneven: corners count once for each end of a period."""
ROOM_AT_END = 3.0
"""Share of it that the square of what a sample adds counts which begins to act as a period ends."""
CELLS_MAX = 4096
"""Instants of a grid: the loops of docs/control.md need some 500."""


class Windowed(Proof):
    """Of a loop whose samples may begin to act at any instant of their windows."""

    def __init__(
        self, loop: RebuiltLoop, rows: Sequence[Any], gain: arb | None, decay: arb, room: float = ROOM
    ) -> None:
        """``room``: in place of :data:`ROOM`; with a larger one less is proved, never more."""
        super().__init__(loop, rows, gain, decay)
        self._room = room
        self.eps = EPS_OF_UNEVEN if loop.uneven_us else EPS
        k, n = loop.kept, loop.F.nrows() - 1
        mean = rounded(sum(self.P[1:], self.P[0]) / len(self.P)).mid
        L = np.eye(loop.size) * math.sqrt(mean[-1, -1])
        L[:k, :k] = np.linalg.cholesky(mean).T
        self._L, self._inverse = of_doubles(L), of_doubles(L).inv()
        turn = cut(self._inverse, k)
        self._white = joined([rounded(turn.transpose() * each * turn)[None] for each in self.P])
        squares = [[float(P[i, i].upper()) for i in range(n)] for P in self.P]
        self._sizes = np.sqrt(np.array(squares)) * GREATER
        self._flows: dict[tuple[Fraction, bool], tuple[Ball, Ball, Ball, int]] = {}
        self._small, self._energy = self._departures()
        self._pairs = self._differences()
        ends = {at for step in loop.steps for _, *window in step.windows for at in window}
        marks = {Fraction(0), loop.shortest_us, *ends}
        self._grid = [Fraction(0)]
        self._bends: list[tuple[np.ndarray, float]] = []
        for first, last in itertools.pairwise(sorted(marks)):
            self._divide(first, last)
        self._ends = {target: self._before_ends(target) for target in {edge[1] for edge in self.edges}}

    def prove(self) -> None:
        by_step: dict[tuple[Any, ...], list[tuple[int, int, int, RebuiltStep]]] = {}
        for edge in self.edges:
            by_step.setdefault(edge[3].windows, []).append(edge)
        whitened = [whitening(P) for P in self._white.mid]
        for edges in by_step.values():
            for S, target in self._values(edges[0][3], sorted({target for _, target, _, _ in edges})):
                own = [edge for edge in edges if edge[1] == target]
                for idle in range(1 + max(edge[2] for edge in own)):
                    if idle:
                        S = self._grown(S)
                        for operation in reversed(self.loop.idle):
                            S = self._before(S, operation, False)
                        S = S[..., : self.loop.kept, : self.loop.kept]
                    growth = float(self.growth(idle + 1).upper()) * GREATER
                    for source in (edge[0] for edge in own if edge[2] == idle):
                        X = exact(whitened[source])
                        slack = X.T @ (self._white[source] - S.times(growth)) @ X
                        require_positive(slack, f"from node {source} to {target} after {idle} losses")

    def _values(self, step: RebuiltStep, targets: Sequence[int]) -> Iterator[tuple[Ball, int]]:
        """Yield the values (corners, k, k) before ``step`` of the function of each target, in parts."""
        parts = [(0, step.windows)]
        if self.loop.uneven_us and self._lasts(step):
            parts.append((1, step.windows[:-1]))
        for late, windows in parts:
            owners = [target for target in targets for _ in self._ends[target][late].mid]
            S = joined([self._ends[target][late] for target in targets])[:, None]
            values = self._corners(step, windows, owners, self._grown(S))
            for target in targets:
                yield values[[place for place, owner in enumerate(owners) if owner == target]], target

    def _lasts(self, step: RebuiltStep) -> bool:
        """Return True if the newest sample may begin to act up to the period's end."""
        return bool(step.windows) and step.windows[-1][0] + 1 < len(self.loop.applying)

    def _before_ends(self, target: int) -> tuple[Ball, Ball]:
        """Return (.., k, k), in good coordinates: the function of a node before the ends of uneven periods,
        and where the newest sample begins to act at them."""
        loop, turn = self.loop, cut(self._inverse, self.loop.kept)
        if not loop.uneven_us:
            return self._white[[target]], self._white[:0]
        squared = None if self.gain is None else self.gain**2 / (1 + number(self.eps))
        ends = Ends(loop, squared)
        sizes = [size for *_, by_target in self._pairs for size in by_target.values()]
        room = number(ROOM_AT_END * self.eps / max(sizes) ** 2)
        late = ends.late(self.P[target], room) if len(loop.applying) > 1 else []
        own, later = (
            joined([self._white[:0], *(rounded(turn.transpose() * each * turn)[None] for each in found)])
            for found in (ends.before(self.P[target]), late)
        )
        return own, later

    def _turned(self, J: arb_mat) -> Ball:
        """Return a map of xi in good coordinates."""
        return rounded(self._L * J * self._inverse)

    def _turned_flow(self, length_us: Fraction, spread: bool) -> tuple[Ball, Ball, Ball, int]:
        """Return the matrices of a flow in good coordinates."""
        key = length_us, spread
        if key not in self._flows:
            size = self.loop.size
            Phi, W, Q, parts = self.flow(length_us, spread)
            reach = rounded(self._L * embedded(W, size) * self._L.transpose())
            own = rounded(self._inverse.transpose() * embedded(Q, size) * self._inverse)
            self._flows[key] = self._turned(embedded(Phi, size, 1)), reach, own, parts
        return self._flows[key]

    def _grown(self, S: Ball) -> Ball:
        """Return (..., size, size) of (..., kept, kept): the last entry of xi does not count."""
        room = [(0, 0)] * (S.mid.ndim - 2) + [(0, self.loop.size - self.loop.kept)] * 2
        return Ball(np.pad(S.mid, room), np.pad(S.rad, room))

    def _before(self, S: Ball, operation: Operation, spread: bool) -> Ball:
        """Return the values before an operation, S (..., n, n) after it."""
        kind, what = operation
        if kind == "jump":
            J = self._turned(what)
            return J.T @ S @ J
        return self._flowed(S, [what], spread)

    def _flowed(self, S: Ball, lengths_us: Sequence[Fraction], spread: bool) -> Ball:
        """Return the values (.., N, n, n) before flows, one for each of N or one for all."""
        unique = sorted(set(lengths_us))
        parts = max(self._turned_flow(length, spread)[3] for length in unique)
        row = [unique.index(length) for length in lengths_us]
        while parts <= PARTS_MAX:
            maps = [self._turned_flow(length / parts, spread)[:3] for length in unique]
            Phi, W, Q = (joined([each[None] for each in part])[row] for part in zip(*maps, strict=True))
            before = self._over(S, Phi, W, Q, parts)
            if before is not None:
                return before
            parts *= 2
        raise NotProved(BEYOND)

    def _over(self, S: Ball, Phi: Ball, W: Ball, Q: Ball, parts: int) -> Ball | None:
        """Return the values before a flow in so many parts; None if its disturbance reaches too far."""
        for _ in range(parts):
            if self.gain is not None:
                reach = W @ S
                share = np.trace(reach.mid, axis1=-2, axis2=-1) + reach.rad.sum(axis=(-2, -1))
                if not np.all(share < 0.99):
                    return None
                S = S @ (exact(np.eye(S.mid.shape[-1])) - reach).inverse()
            S = Q + Phi.T @ S @ Phi
        return S

    def _departures(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest |A e^{A s} B|, and the integral of (C A e^{A s} B)^2, by parts of a period."""
        loop = self.loop
        m = loop.F.nrows()
        A = arb_mat([[loop.F[i, j] for j in range(m - 1)] for i in range(m - 1)])
        B = arb_mat([[loop.F[i, m - 1]] for i in range(m - 1)])
        C = arb_mat([[loop.C[i, 0] for i in range(m - 1)]])
        h = number(loop.period_us + loop.uneven_us) / 10**6
        parts = 16 + math.ceil(8.0 * float((h * sum((abs(each) for each in A.entries()), arb(0))).upper()))
        near, step = (A * (h / parts * arb(0.5, 0.5))).exp(), (A * (h / parts)).exp()
        largest, energy, total = [], [0.0], 0.0
        for _ in range(parts):
            slope = A * near * B
            largest.append([float(entry.abs_upper()) * GREATER for entry in slope.entries()])
            total += float(((C * slope)[0, 0].abs_upper() ** 2 * h / parts).upper()) * GREATER
            energy.append(total * GREATER)
            B = step * B
        return np.array(largest), np.array(energy)

    def _bend(self, first: Fraction, last: Fraction) -> tuple[np.ndarray, float]:
        """Return how far the state at the period's end, and the error's norm, depart from their chord."""
        h, parts = self.loop.period_us + self.loop.uneven_us, len(self._small)
        rest = max(Fraction(0), self.loop.shortest_us - last)
        low, high = math.floor(rest / h * parts), math.ceil((h - first) / h * parts)
        share = float((last - first) / 10**6) ** 2 / 8.0 * GREATER
        return share * self._small[low:high].max(axis=0), share * math.sqrt(self._energy[high]) * GREATER

    def _differences(self) -> list[tuple[Fraction, Fraction, dict[int, float]]]:
        """Return for each open window the largest |Delta xi| where xi' P_i xi is 1, by the target j."""
        inverse = np.linalg.inv(self._white.mid)
        found: dict[tuple[Fraction, Fraction], dict[int, float]] = {}
        for source, target, _, step in self.edges:
            for (_, first, last), row in zip(step.windows, self._rows(step), strict=True):
                if first < last:
                    size = math.sqrt(float((row.mid @ inverse[source] @ row.mid.T)[0, 0]))
                    by_target = found.setdefault((first, last), {})
                    by_target[target] = max(size, by_target.get(target, 0.0))
        return [(*ends, by_target) for ends, by_target in found.items()]

    def _rows(self, step: RebuiltStep) -> list[Ball]:
        """Return what each sample adds to the input, of xi in good coordinates."""
        rows, loop = [], self.loop
        before = loop.inputs[-1]
        for back, _, _ in step.windows:
            now = loop.inputs[back]
            added = arb_mat([[one - other for one, other in zip(now, before, strict=True)]])
            rows.append(rounded(added * self._inverse)[:, : loop.kept])
            before = now
        return rows

    def _divide(self, first: Fraction, last: Fraction) -> None:
        """Add cells so narrow that the departure is small beside xi' P xi."""
        bend, output = self._bend(first, last)
        sizes = self._sizes @ bend + (output if self.gain is not None else 0.0)
        open_ = [by_target for low, high, by_target in self._pairs if low <= first and last <= high]
        shares = (sizes[target] * size for by_target in open_ for target, size in by_target.items())
        if max(shares, default=0.0) > self._room * self.eps:
            if len(self._grid) > CELLS_MAX:
                raise NotProved(f"more than {CELLS_MAX} cells")
            middle = (first + last) / 2
            self._divide(first, middle)
            self._divide(middle, last)
            return
        self._grid.append(last)
        self._bends.append((bend, output))

    def _corners(self, step: RebuiltStep, windows: Sequence[Any], owners: Sequence[int], S: Ball) -> Ball:
        """Return (rows, corners, k, k): bounds of the value before ``step``, of S (rows, 1, n, n) after the
        shortest period; ``windows``: those of samples that begin to act before S; ``owners``: nodes of S."""
        spread = any(low < high for _, low, high in step.windows)
        places = np.array([[len(self._grid) - 1]])
        earlier = windows
        if windows and windows == step.windows:
            *earlier, (back, first, last) = windows
            places = np.array([[place] for place, at in enumerate(self._grid) if first <= at <= last])
            S = self._through(S, places[:, 0], spread, to_end=True)
            S = self._before(S, ("jump", self.loop.applying[back]), spread)
        for back, first, last in reversed(earlier):
            S, places = self._earlier(S, places, first, last, spread)
            S = self._before(S, ("jump", self.loop.applying[back]), spread)
        S = self._before(self._through(S, places[:, 0], spread), self.loop.idle[0], spread)
        S = S[..., : self.loop.kept, : self.loop.kept]
        return self._spread(S, step, owners, places, windows != step.windows) if spread else S

    def _earlier(
        self, S: Ball, places: np.ndarray, first: Fraction, last: Fraction, spread: bool
    ) -> tuple[Ball, np.ndarray]:
        """Return the values at each instant of an earlier window, before those of S (.., N, n, n)."""
        ends = self._grid.index(last)
        ahead = places[:, 0] > ends
        moving, at = self._through(S[:, ahead], places[ahead, 0], spread, ends), places[ahead]
        found: list[tuple[Ball, np.ndarray]] = []
        for place in range(ends, self._grid.index(first) - 1, -1):
            begins = places[:, 0] == place
            moving, at = joined([moving, S[:, begins]], 1), np.concatenate([at, places[begins]])
            found.append((moving, np.hstack([np.full((len(at), 1), place), at])))
            if place:
                moving = self._before(moving, ("flow", self._grid[place] - self._grid[place - 1]), spread)
        return joined([each for each, _ in found], 1), np.concatenate([each for _, each in found])

    def _through(
        self, S: Ball, places: np.ndarray, spread: bool, begin: int = 0, *, to_end: bool = False
    ) -> Ball:
        """Return the values (.., N, n, n) before the flows to each place of the grid from place ``begin``, or
        from each place to the period's end."""
        if not len(places):
            return S
        grid = self._grid
        lengths = [grid[-1] - grid[place] if to_end else grid[place] - grid[begin] for place in places]
        return self._flowed(S, lengths, spread)

    def _spread(
        self, S: Ball, step: RebuiltStep, targets: Sequence[int], places: np.ndarray, late: bool
    ) -> Ball:
        """Return bounds for the instants between the grid's too; ``late``: of a sample beyond it."""
        wide, eps = sum(first < last for _, first, last in step.windows), self.eps
        total = S.times((1.0 + eps) * GREATER)
        for window, (row, (_, first, last)) in enumerate(zip(self._rows(step), step.windows, strict=True)):
            if first < last:
                size = np.array([self._size(targets, int(place), last) for place in places[:, window]]).T
                if late and window == len(step.windows) - 1:
                    size = np.maximum(size, self._size_at_end(targets)[:, None])
                square = (1.0 + 1.0 / eps) * wide * size * GREATER
                total = total + (row.T @ row).times(square[..., None, None])
        return total

    def _size_at_end(self, targets: Sequence[int]) -> np.ndarray:
        """Return the square of the departure on a cell of the ends of uneven periods."""
        ends = ends_us(self.loop)
        bend, output = self._bend(self.loop.shortest_us, self.loop.shortest_us + ends[1])
        size = (self._sizes[list(targets)] @ bend) ** 2 + (output**2 if self.gain is not None else 0.0)
        return np.asarray(size * GREATER)

    def _size(self, targets: Sequence[int], place: int, last: Fraction) -> np.ndarray:
        """Return the square of the departure on the cells beside an instant of a window that ends with
        ``last``, for each target."""
        total = np.zeros(len(targets))
        for bend, output in self._bends[max(0, place - 1) : place + (self._grid[place] < last)]:
            size = (self._sizes[list(targets)] @ bend) ** 2 + (output**2 if self.gain is not None else 0.0)
            total = np.maximum(total, size * GREATER)
        return total
