"""Norms that no step of a graph enlarges, and that no later error exceeds.

V_i(d) = |T_i d| at node i, d the departure from rest, with

    V_j(M d) <= V_i(d)   along every edge i -> j,    |c d| <= V_i(d)   for the errors c d along it

so that from d at node i no error ever exceeds V_i(d) (multiple quadratic functions).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.lmi import LmiProblem, MatrixInequality, Unknowns, last_answer
from servobench.design.errors import NoSolution

_ROWS = 4
"""Error rows of an edge given to the solver; the norms are then scaled to all."""
_MARGIN, _SLACK = 1e-5, 1e-9
"""Margin asked of the solver, where P is of size 1, and the share of a size that rounding may add."""
_TOLERANCE = 1e-8
_ROUNDS, _CLOSE = 4000, 1e-6
_FLOOR = 1e-3
"""Share of the largest value that every direction is given, so that none is without a size."""
_DECAY_PARTS = (0.7, 0.4, 0.15)
"""Shares of the decay of the slowest cycle known, asked of norms in turn."""
_CYCLES_MAX = 100_000
_SHRUNK = 0.97
"""Factor of the steps in the search for coordinates, where they do not decay on average."""


class Elsewhere(NamedTuple):
    """A step's departure, where its command acts at another instant: at most ``row`` d times these."""

    row: Array
    """(k,), on d after its first jump."""
    state: Array
    """(k,), entry by entry."""
    error: float
    at_end: bool
    """True for the least and the largest delay: the solver is asked for these alone."""


class NormedEdge(NamedTuple):
    """A step that the norms have to bear: images of d, and errors on the way."""

    source: int
    target: int
    M: Array
    """(N, k, k): each variant."""
    rows: Array
    """(R, k)."""
    firsts: Array
    """(N, k, k): what d passes first, in one of these variants or their hull."""
    between: Array
    """(N, B, k) for each of these: between its instants an error is larger by at most the sum of |b d|."""
    unsure: Array
    """(k, k): M may differ by X times the first, |X| at most this, entry by entry."""
    rows_unsure: Array
    """(W, k): the same of rows."""
    room: float
    """Share by which the norms fall, for that and for other begins of a command."""
    elsewhere: Elsewhere | None
    posed: bool
    """False: the solver is not asked; the norms have to bear it all the same."""


@dataclass(frozen=True, slots=True, eq=False)
class FallingNorms:
    """T (nodes, k, k)."""

    T: Array
    left: float
    """What every step leaves of a size, at most."""

    def directions(self, size: float) -> tuple[NDArray[np.intp], Array]:
        """Return the (N,) nodes and (N, k) multiples of unit vectors that are of this size."""
        nodes, k, _ = self.T.shape
        lengths = size / np.linalg.norm(self.T, axis=1)
        return np.repeat(np.arange(nodes), k), (lengths[:, :, None] * np.eye(k)).reshape(-1, k)

    def sizes(self, nodes: NDArray[np.intp], d: Array) -> Array:
        """Return V of each row of ``d`` (N, k) at its node (N,)."""
        sizes = np.empty(len(d))
        for node in np.unique(nodes):
            own = nodes == node
            sizes[own] = np.linalg.norm(d[own] @ self.T[node].T, axis=1)
        return sizes


class Norms:
    """Norms of one graph, one that is smallest at the begin and others that are at states reached later."""

    def __init__(
        self, edges: Sequence[NormedEdge], nodes: int, starts: Array, *, falling: bool = True
    ) -> None:
        """``falling``: the first is to fall with every step, and may be larger at the begin for it. Raises
        NoSolution where there are none."""
        self._edges, self._nodes = edges, nodes
        at, tiled = np.repeat(np.arange(nodes), len(starts)), np.tile(starts, (nodes, 1))
        first = falling_norms(edges, nodes, at, tiled)
        if first is None:
            raise NoSolution("certificate of the peak", "no norms were found that fall along every sequence")
        faster = self._faster(first, float(first.sizes(at, tiled).max())) if falling else first
        self.first = faster
        """That of radii."""
        self._all = [first] if faster is first else [first, faster]

    def _faster(self, first: FallingNorms, size: float) -> FallingNorms:
        """Return norms that fall faster than ``first``; this one where none were found."""
        decay = -math.log(slowest_cycle(self._edges, self._nodes))
        at, units = first.directions(size)
        for part in _DECAY_PARTS if decay > 0.0 else ():
            faster = falling_norms(self._edges, self._nodes, at, units, math.exp(part * decay))
            if faster is not None:
                return faster
        return first

    def sizes(self, nodes: NDArray[np.intp], d: Array) -> Array:
        """Return (N,): what no error behind each of ``d`` (N, k) exceeds, by the best norm."""
        return np.asarray(np.min([norms.sizes(nodes, d) for norms in self._all], axis=0))

    def refine(self, nodes: NDArray[np.intp], d: Array) -> None:
        """Add norms that are smallest at ``d`` (N, k)."""
        further = falling_norms(self._edges, self._nodes, nodes, d)
        if further is not None:
            self._all.append(further)


def falling_norms(
    edges: Sequence[NormedEdge], nodes: int, at: NDArray[np.intp], starts: Array, growth: float = 1.0
) -> FallingNorms | None:
    """Return norms that are smallest at ``starts`` (N, k), each at its node of ``at`` (N,).

    ``growth``: by how much every step is to make them fall. None if the solver has none that can be proved.
    """
    L = coordinates(edges, nodes)
    if L is None:
        return None
    inverses = np.linalg.inv(L)
    turned = [
        NormedEdge(
            edge.source,
            edge.target,
            growth * (1.0 + edge.room) * L[edge.target] @ edge.M @ inverses[edge.source],
            edge.rows @ inverses[edge.source],
            *edge[4:],
        )
        for edge in edges
    ]
    problem = _problem(turned, nodes, at, np.einsum("nij,nj->ni", L[at], starts))
    y = last_answer(problem, _TOLERANCE)
    if y is None:
        return None
    P = [problem.unknowns.value(f"P{node}", y) for node in range(nodes)]
    try:
        T = np.array([cholesky(each) for each in P])
    except np.linalg.LinAlgError:
        return None
    own = T @ L
    left = max(left_by(edge, own) for edge in edges)
    if left > 1.0:
        return None
    return FallingNorms(max(_largest_error(edge, own) for edge in edges) * own, left)


def left_by(edge: NormedEdge, T: Array) -> float:
    """Return what ``edge`` leaves of a size, at most."""
    inverse = np.linalg.inv(T[edge.source])
    left = float(np.linalg.norm(T[edge.target] @ edge.M @ inverse, 2, axis=(1, 2)).max()) + _SLACK
    if not edge.room:
        return left
    passed = np.abs(edge.firsts @ inverse).max(axis=0)
    left += float(np.linalg.norm(np.abs(T[edge.target]) @ edge.unsure @ passed, 2))
    if edge.elsewhere is not None:
        changed = float(np.linalg.norm(edge.elsewhere.row @ edge.firsts @ inverse, axis=1).max())
        left += changed * float(np.linalg.norm(np.abs(T[edge.target]) @ edge.elsewhere.state))
    return left


def slowest_cycle(edges: Sequence[NormedEdge], nodes: int) -> float:
    """Return the largest spectral radius of a period, over cycles of a few steps."""
    walks = [(edge.source, edge.target, edge.M[[0, -1]]) for edge in edges]
    slowest, ways = 0.0, walks
    for length in range(1, nodes + 1):
        for source, target, M in ways:
            if source == target:
                radius = float(np.abs(np.linalg.eigvals(M)).max())
                slowest = max(slowest, radius ** (1.0 / length))
        if length * len(ways) * len(walks) > _CYCLES_MAX:
            break
        ways = [
            (source, beyond, (step[:, None] @ M[None]).reshape(-1, *M.shape[1:])[[0, -1]])
            for source, target, M in ways
            for begin, beyond, step in walks
            if begin == target
        ]
    return slowest


def _largest_error(edge: NormedEdge, T: Array) -> float:
    """Return the largest error along ``edge`` from a d of size 1."""
    inverse = np.linalg.inv(T[edge.source])
    between = np.linalg.norm(edge.between @ inverse, axis=2).sum(axis=1).max()
    largest = float(np.linalg.norm(edge.rows @ inverse, axis=1).max() + between)
    if not edge.room:
        return largest
    passed = np.abs(edge.firsts @ inverse).max(axis=0)
    largest += float(np.linalg.norm(edge.rows_unsure @ passed, axis=1).max())
    if edge.elsewhere is not None:
        changed = float(np.linalg.norm(edge.elsewhere.row @ edge.firsts @ inverse, axis=1).max())
        largest += changed * edge.elsewhere.error
    return largest


def _problem(edges: Sequence[NormedEdge], nodes: int, at: NDArray[np.intp], starts: Array) -> LmiProblem:
    """Pose the least b with start' P_i start <= b, P_i >= row' row, P_i >= M' P_j M."""
    unknowns = Unknowns()
    for node in range(nodes):
        unknowns.symmetric(f"P{node}", starts.shape[1])
    unknowns.symmetric("objective", 1)
    inequalities = []
    for node, start in zip(at, starts, strict=True):
        below = MatrixInequality.zero(unknowns, 1)
        below.add_form(unknowns, f"P{node}", start[None, :], -1.0)
        below.coefficients[-1] += 1.0
        inequalities.append(below)
    for edge in edges:
        chosen = np.unique(np.linspace(0, len(edge.rows) - 1, _ROWS).round().astype(int))
        for row in edge.rows[chosen]:
            above = MatrixInequality.positive(unknowns, f"P{edge.source}")
            above.constant -= np.outer(row, row)
            inequalities.append(above)
        for M in edge.M if edge.posed else ():
            falls = MatrixInequality.positive(unknowns, f"P{edge.source}")
            falls.add_form(unknowns, f"P{edge.target}", M.T, -1.0)
            inequalities.append(falls)
    return LmiProblem("norms of a load step", unknowns, inequalities, unknowns.last, _MARGIN)


def coordinates(edges: Sequence[NormedEdge], nodes: int) -> Array | None:
    """Return (nodes, k, k) in which the squares of all later errors, on average over walks, are of size 1."""
    k = edges[0].M.shape[1]
    leaving = np.bincount([edge.source for edge in edges], minlength=nodes)
    for shrunk in (1.0, _SHRUNK, _SHRUNK**4, _SHRUNK**16):
        X = np.zeros((nodes, k, k))
        for _ in range(_ROUNDS):
            later = np.zeros_like(X)
            for edge in edges:
                images = (edge.M.transpose(0, 2, 1) @ X[edge.target] @ edge.M).mean(axis=0)
                seen = edge.rows.T @ edge.rows / len(edge.rows)
                later[edge.source] += (shrunk**2 * images + seen) / leaving[edge.source]
            apart, X = np.abs(later - X).max(), later
            if not np.isfinite(apart) or apart <= _CLOSE * np.abs(X).max():
                break
        if np.isfinite(apart) and apart <= _CLOSE * np.abs(X).max():
            sizes = np.sqrt(np.diagonal(X, axis1=1, axis2=2))
            largest = sizes.max(axis=0)
            sizes = np.maximum(sizes, np.where(largest > 0.0, _FLOOR * largest, 1.0))
            shape = X / (sizes[:, :, None] * sizes[:, None, :])
            roots = [cholesky(each + _FLOOR * np.eye(k)) for each in shape]
            return np.array(roots) * sizes[:, None, :]
    return None
