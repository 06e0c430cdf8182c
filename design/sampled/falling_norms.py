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
"""Margin asked of the solver, and the least eigenvalue that counts as proof, where P is of size 1."""
_TOLERANCE = 1e-8
_ROUNDS, _CLOSE = 4000, 1e-6
_FLOOR = 1e-3
"""Share of the largest value that every direction is given, so that none is without a size."""
_SHRUNK = 0.97
"""Factor of the steps in the search for coordinates, where they do not decay on average."""


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
    unsure: Array | None = None
    """(k, k): M may differ by X times the first, |X| at most this, entry by entry; None: not at all."""
    rows_unsure: Array | None = None
    """(W, k): the same of rows."""
    room: float = 0.0
    """Share by which the norms fall, for that."""


class Norms:
    """Norms of one graph, one that is smallest at the begin and others that are at states reached later."""

    def __init__(self, edges: Sequence[NormedEdge], nodes: int, starts: Array) -> None:
        """Raises NoSolution where there are none."""
        self._edges, self._nodes = edges, nodes
        at = np.repeat(np.arange(nodes), len(starts))
        first = falling_norms(edges, nodes, at, np.tile(starts, (nodes, 1)))
        if first is None:
            raise NoSolution("certificate of the peak", "no norms were found that fall along every sequence")
        self.first, self._all = first, [first]

    def sizes(self, nodes: NDArray[np.intp], d: Array) -> Array:
        """Return (N,): what no error behind each of ``d`` (N, k) exceeds, by the best norm."""
        return np.asarray(np.min([norms.sizes(nodes, d) for norms in self._all], axis=0))

    def refine(self, nodes: NDArray[np.intp], d: Array) -> None:
        """Add norms that are smallest at ``d`` (N, k)."""
        further = falling_norms(self._edges, self._nodes, nodes, d)
        if further is not None:
            self._all.append(further)


@dataclass(frozen=True, slots=True, eq=False)
class FallingNorms:
    """T (nodes, k, k)."""

    T: Array

    def sizes(self, nodes: NDArray[np.intp], d: Array) -> Array:
        """Return V of each row of ``d`` (N, k) at its node (N,)."""
        sizes = np.empty(len(d))
        for node in np.unique(nodes):
            own = nodes == node
            sizes[own] = np.linalg.norm(d[own] @ self.T[node].T, axis=1)
        return sizes


def falling_norms(
    edges: Sequence[NormedEdge], nodes: int, at: NDArray[np.intp], starts: Array
) -> FallingNorms | None:
    """Return norms that are smallest at ``starts`` (N, k), each at its node of ``at`` (N,).

    None if the solver has none that can be proved.
    """
    coordinates = _coordinates(edges, nodes)
    if coordinates is None:
        return None
    inverses = np.linalg.inv(coordinates)
    turned = [
        NormedEdge(
            edge.source,
            edge.target,
            (1.0 + edge.room) * coordinates[edge.target] @ edge.M @ inverses[edge.source],
            edge.rows @ inverses[edge.source],
            edge.firsts,
            edge.between,
        )
        for edge in edges
    ]
    problem = _problem(turned, nodes, at, np.einsum("nij,nj->ni", coordinates[at], starts))
    y = last_answer(problem, _TOLERANCE)
    if y is None:
        return None
    P = [problem.unknowns.value(f"P{node}", y) for node in range(nodes)]
    for edge in turned:
        images = edge.M.transpose(0, 2, 1) @ P[edge.target] @ edge.M
        if np.linalg.eigvalsh(P[edge.source] - images)[:, 0].min() < _SLACK:
            return None
    try:
        T = np.array([cholesky(each) for each in P])
    except np.linalg.LinAlgError:
        return None
    own = T @ coordinates
    within = [_largest_error(edge, own) for edge in edges]
    return FallingNorms(max(within) * own) if np.isfinite(within).all() else None


def _largest_error(edge: NormedEdge, T: Array) -> float:
    """Return the largest error along ``edge`` from a d of size 1; inf where what is unsure of M may enlarge a
    norm."""
    inverse = np.linalg.inv(T[edge.source])
    between = np.linalg.norm(edge.between @ inverse, axis=2).sum(axis=1).max()
    largest = float(np.linalg.norm(edge.rows @ inverse, axis=1).max() + between)
    if edge.unsure is None or edge.rows_unsure is None:
        return largest
    passed = np.abs(edge.firsts @ inverse).max(axis=0)
    if 1.0 / (1.0 + edge.room) + np.linalg.norm(np.abs(T[edge.target]) @ edge.unsure @ passed, 2) > 1.0:
        return math.inf
    return largest + float(np.linalg.norm(edge.rows_unsure @ passed, axis=1).max())


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
        for M in edge.M:
            falls = MatrixInequality.positive(unknowns, f"P{edge.source}")
            falls.add_form(unknowns, f"P{edge.target}", M.T, -1.0)
            inequalities.append(falls)
    return LmiProblem("norms of a load step", unknowns, inequalities, unknowns.last, _MARGIN)


def _coordinates(edges: Sequence[NormedEdge], nodes: int) -> Array | None:
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
