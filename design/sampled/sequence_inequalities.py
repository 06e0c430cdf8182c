"""Inequalities of quadratic functions along every edge of a graph of steps, and their solution.

They are solved for a few corners of the edges, then all are checked, and violated ones are added. Every
result has been put into all of them in numpy (:mod:`servobench.design.sampled.sequence_certificate`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import cholesky

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.lmi import LmiProblem, MatrixInequality, Unknowns, last_answer
from servobench.design.sampled.admissible_steps import Delivery
from servobench.design.sampled.held_loop import SwitchedLoop
from servobench.design.sampled.loss_patterns import Pattern, repeated
from servobench.design.sampled.sequence_graph import Edge
from servobench.design.sampled.step_maps import step_maps, value_maps
from servobench.design.sampled.uneven_ends import ends_covered
from servobench.design.sampled.value_map import ValueMap, nothing

MARGIN = 1e-9
"""Smallest eigenvalue that counts as proof."""
_EXCHANGES = 12
"""Exchanges at most: the problems of the paper's loop and of a random one need one."""
_ADDED = 3
"""Corners of an edge added in one exchange."""
_LOOKED_AT = 1000
"""Corners of an edge to check, evenly spread, until these hold; then all of them."""
_ALL = slice(None)
_FIRST_PARTS = (0.0, 0.2, 0.5, 1.0)
"""Parts of the corners, in their order; an exchange adds missing ones, so that the first alone ends alike."""
_TOLERANCE = 1e-8
"""Relative tolerance of the solver; its result is proved again in any case."""
_DOUBLINGS = 14
"""A pattern is repeated 2^14 times: by then an error has faded, or is beyond bounds."""
_ROUND = 1e-6
"""Added to correlations of 1: Cholesky needs them positive definite, and entries may go together wholly."""

Build = Callable[[Sequence[Sequence[int]]], LmiProblem]
"""Poses the problem of the chosen corners of each edge; its unknowns are P0, P1 .., its objective the
last."""


class Inequalities:
    """The inequalities of one graph in good coordinates, for a gain level or for a decay."""

    def __init__(
        self, loop: SwitchedLoop, nodes: int, edges: list[Edge], L: Array, level: float | None
    ) -> None:
        self._loop = loop
        self.nodes = nodes
        self.edges = edges
        self.L = L
        self.period_s = loop.network.longest_s
        """Time in which a period's decay is reached, at most."""
        self._inverse = np.linalg.inv(L)
        self.level = level
        self._by_family: dict[int, ValueMap] = {}
        self._by_periods: dict[int, ValueMap] = {}
        self.maps = [self._maps(edge, level) for edge in edges]
        self.before = [self._before(edge) for edge in edges]
        self.excess = [self._excess(edge) for edge in edges]

    def _maps(self, edge: Edge, level: float | None) -> ValueMap:
        """Return the maps of the corners' period; the bends cost a factor of the gain. No level: no
        disturbance."""
        key = id(edge.corners)
        if key not in self._by_family:
            gain = math.inf if level is None else level / math.sqrt(edge.spread)
            plain = value_maps(edge.loop, edge.corners, gain)
            self._by_family[key] = self._turned(plain)
        return self._by_family[key]

    def _before(self, edge: Edge) -> ValueMap:
        """Return the map of the periods before that of the corners: all are the same step."""
        periods = len(edge.before)
        if periods not in self._by_periods:
            gain = math.inf if self.level is None else self.level
            total = nothing((), self._loop.kept)
            for step in step_maps(edge.loop, edge.before, gain):
                total = total.then(step)
            self._by_periods[periods] = self._turned(total)
        return self._by_periods[periods]

    def _turned(self, plain: ValueMap) -> ValueMap:
        """Return the maps in good coordinates."""
        L, inverse = self.L, self._inverse
        Q = inverse.T @ plain.Q @ inverse if self.level is not None else np.zeros_like(plain.Q)
        return ValueMap(L @ plain.Phi @ inverse, L @ plain.W @ L.T, Q, plain.bounded)

    def _excess(self, edge: Edge) -> list[tuple[Array, Array, Array]]:
        """Return for each window: difference (kept,), bends (N, n), output bends (N,), with their factors."""
        corners = edge.corners
        factor = (1.0 + 1.0 / edge.epsilon) * corners.terms if edge.epsilon else 0.0
        return [
            (
                corners.differences[s] @ self._inverse,
                math.sqrt(factor) * corners.bends[:, s],
                factor * corners.output_bends[:, s] ** 2 * float(self.level is not None)
                + corners.constants[:, s],
            )
            for s in range(len(corners.differences))
        ]

    def slack(
        self, P: Sequence[Array], place: int, growth: float, squared: float = 1.0, part: slice = _ALL
    ) -> Array:
        """Return (N,): smallest eigenvalue of each corner's inequality of one edge; -inf for an infinite
        value.

        ``squared``: square of the gain over the level's, for W alone; ``part``: corners to check.
        """
        values, finite = self.values(P, place, squared, part)
        edge = self.edges[place]
        smallest = np.linalg.eigvalsh(P[edge.source] - growth**edge.periods * values)[:, 0]
        return np.where(finite, smallest, -np.inf)

    def share_left(self, P: Sequence[Array], place: int) -> float:
        """Return the largest share of xi' P_i xi that one edge leaves, between its corners too."""
        inverse = np.linalg.inv(cholesky(P[self.edges[place].source]))
        values, _ = self.values(P, place)
        return float(np.max(np.linalg.eigvalsh(inverse.T @ values @ inverse)))

    def values(
        self, P: Sequence[Array], place: int, squared: float = 1.0, part: slice = _ALL
    ) -> tuple[Array, np.ndarray]:
        """Return (N, k, k): the images of P_j by the steps of an edge, bounds between corners included; where
        finite."""
        edge, maps, before = self.edges[place], self.maps[place][part], self.before[place]
        if self.level is not None:
            maps, before = (replace(each, W=each.W / squared) for each in (maps, before))
        value, finite = maps.of(P[edge.target])
        value = edge.spread * value + self._between(P[edge.target], place, part)
        if not edge.before:
            return value, finite
        whole, also_finite = before.of(value)
        return whole, finite & also_finite

    def ends_are_covered(self, P: Sequence[Array]) -> bool:
        """Return True if what lies between the ends of uneven periods is within its share of each value."""
        loop = self._loop
        if not loop.network.uneven_s:
            return True
        for target, edge in {edge.target: edge for edge in self.edges}.items():
            gain = math.inf if self.level is None else self.level / math.sqrt(edge.spread)
            if not ends_covered(loop, self.L.T @ P[target] @ self.L, gain, self.L, edge.ends_epsilon):
                return False
        return True

    def _between(self, P: Array, place: int, part: slice) -> Array:
        total = np.zeros((len(self.edges[place].corners.times_s[part]), *P.shape))
        n = len(self._loop.model.A)
        columns = self.L[:, :n]
        sizes = np.sqrt(np.maximum(np.einsum("ki,kl,li->i", columns, P, columns), 0.0))
        for difference, bends, outputs in self.excess[place]:
            size = (bends[part] @ sizes) ** 2 + outputs[part]
            total += size[:, None, None] * np.outer(difference, difference)
        return total

    def between_linear(self, unknowns: Unknowns, name: str, place: int, corner: int) -> Array:
        """Return a bound of :meth:`_between` linear in P: (entries of P, kept, kept), and its constant
        last."""
        n = len(self._loop.model.A)
        columns = self.L[:, :n]
        basis = unknowns.basis(name)
        diagonal = np.einsum("ki,ekl,li->ei", columns, basis, columns)
        k = len(self.L)
        bounds = np.zeros((len(basis) + 1, k, k))
        for difference, bends, outputs in self.excess[place]:
            square = np.outer(difference, difference)
            bounds[:-1] += (n * (diagonal @ bends[corner] ** 2))[:, None, None] * square
            bounds[-1] += outputs[corner] * square
        return bounds


def node_unknowns(system: Inequalities) -> Unknowns:
    """Return P0, P1 .., one for each node, and the objective last."""
    unknowns = Unknowns()
    for node in range(system.nodes):
        unknowns.symmetric(f"P{node}", len(system.L))
    unknowns.symmetric("objective", 1)
    return unknowns


def corner_inequalities(
    system: Inequalities, unknowns: Unknowns, chosen: Sequence[Sequence[int]], growth: float
) -> list[MatrixInequality]:
    """Return the inequalities of the ``chosen`` corners of each edge."""
    return [
        _corner_inequality(system, unknowns, place, corner, growth)
        for place, corners in enumerate(chosen)
        for corner in corners
    ]


def _corner_inequality(
    system: Inequalities, unknowns: Unknowns, place: int, corner: int, growth: float
) -> MatrixInequality:
    """Return Schur's complement of P_i - growth * before((1 + epsilon) value of P_j + bound between corners)
    >= 0.

    In [xi, d, d']: d disturbs the periods before that of the corner, d' the corner's own.
    """
    edge, k, maps, before = system.edges[place], len(system.L), system.maps[place], system.before[place]
    source, target = f"P{edge.source}", f"P{edge.target}"
    spread = edge.spread
    disturbed = system.level is not None
    first = math.sqrt(spread) * _root(before.W) if disturbed and edge.before else np.zeros((k, 0))
    second = _root(maps.W[corner]) if disturbed else np.zeros((k, 0))
    m = k + first.shape[1] + second.shape[1]
    inequality = MatrixInequality.zero(unknowns, m)
    inequality.add(unknowns, source, math.sqrt(1.0 / (growth**edge.periods * spread)) * np.eye(m)[:, :k])
    inequality.constant[:k, :k] -= before.Q / spread
    inequality.coefficients[-1, k:, k:] += np.eye(m - k)
    # xi when the corner's period begins, of [xi, d]; d may have either sign
    begun = np.hstack([before.Phi, first])
    own = len(begun.T)
    between = begun.T @ (system.between_linear(unknowns, target, place, corner) / spread) @ begun
    part = unknowns.slice_of(target)
    inequality.coefficients[part, :own, :own] -= between[:-1]
    inequality.constant[:own, :own] -= begun.T @ maps.Q[corner] @ begun + between[-1]
    ended = np.hstack([maps.Phi[corner] @ begun, second])
    inequality.coefficients[part] -= ended.T @ unknowns.basis(target) @ ended
    return inequality


def _root(W: Array) -> Array:
    """Return B with B B' = W, without its zero columns."""
    values, vectors = np.linalg.eigh(W)
    kept = values > 1e-13 * max(float(values[-1]), 1e-300)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def exchanged(
    system: Inequalities, build: Build, growth: float, objective_max: float = math.inf
) -> tuple[list[Array], float] | None:
    """Return P_i that meet every corner, and the objective; or an objective above ``objective_max``, which is
    too high. None if the solver has none."""
    chosen = [
        sorted({round(part * (len(edge.corners.times_s) - 1)) for part in _FIRST_PARTS})
        for edge in system.edges
    ]
    answer = None
    for _ in range(_EXCHANGES):
        problem = build(chosen)
        y = last_answer(problem, _TOLERANCE)
        if y is None:
            return None
        P = [problem.unknowns.value(f"P{node}", y) for node in range(system.nodes)]
        answer = P, float(y[-1])
        if answer[1] >= objective_max:
            return answer
        for count in (_LOOKED_AT, None):
            broken = _broken(system, P, growth, answer[1], count)
            wider = [sorted({*own, *broken.get(place, ())}) for place, own in enumerate(chosen)]
            if wider != chosen:
                break
        else:
            # met, or as nearly as the solver can
            return answer
        chosen = wider
    return answer


def _broken(
    system: Inequalities, P: Sequence[Array], growth: float, squared: float, count: int | None
) -> dict[int, list[int]]:
    """Return the worst violated corners, by edge, of ``count`` or of all."""
    broken = {}
    for place, edge in enumerate(system.edges):
        stride = 1 if count is None else max(1, len(edge.corners.times_s) // count)
        slack = system.slack(P, place, growth, squared, slice(None, None, stride))
        bad = np.flatnonzero(slack < MARGIN)
        if len(bad):
            broken[place] = (stride * bad[np.argsort(slack[bad])[:_ADDED]]).tolist()
    return broken


def proved(system: Inequalities, P: Sequence[Array], growth: float) -> float:
    """Return the smallest eigenvalue of all inequalities."""
    own = min(float(np.linalg.eigvalsh(matrix)[0]) for matrix in P)
    if own > 0.0 and not system.ends_are_covered(P):
        return -math.inf
    slacks = (float(system.slack(P, place, growth).min()) for place in range(len(system.edges)))
    return min(own, *slacks)


def coordinates(loop: SwitchedLoop, patterns: Sequence[Pattern], gain: float) -> Array:
    """Return L of xi' = L xi in which the value under ``patterns``, from each of their phases, is of size 1.

    Delays of whole periods are included: without them an entry that matters in only one node, perhaps never
    visited by ``patterns``, would count as nothing, and every switching that involves it as large.
    """
    return coordinates_of(loop, [*patterns, *_whole_delays(loop)], gain)


def coordinates_of(loop: SwitchedLoop, patterns: Sequence[Pattern], gain: float) -> Array:
    """Return the same of these patterns alone."""
    total = np.zeros((loop.kept, loop.kept))
    for pattern in patterns:
        maps = step_maps(loop, pattern.steps, gain)
        for phase in range(len(maps)):
            whole = maps[phase]
            for following in (*maps[phase + 1 :], *maps[:phase]):
                whole = whole.then(following)
            for _ in range(_DOUBLINGS):
                whole = whole.then(whole)
            if whole.bounded:
                total = total + whole.Q
    size = np.sqrt(np.diag(total) + 1e-12 * np.trace(total))
    correlation = total / np.outer(size, size)
    return np.asarray(cholesky(correlation + _ROUND * np.eye(len(size))) * size)


def _whole_delays(loop: SwitchedLoop) -> list[Pattern]:
    """Return each delay of whole periods, for ever: there the held sample acts throughout."""
    network = loop.network
    return [
        repeated(loop, (Delivery(1, periods * network.period_s),)) for periods in range(network.behind + 1)
    ]
