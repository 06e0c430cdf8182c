"""Certificates of a sampled loop for every admissible sequence of losses and delays.

The sequences are the walks of a graph (:mod:`design.admissible_steps`), each edge with the corners of all
that it may mean and the bounds of what lies between (:mod:`design.step_maps`). Quadratic functions
xi' P_i xi, one for each node, with

    value of any step from i to j of P_j  <=  P_i            the gain is proved
    e^{2 alpha h} M' P_j M <= P_i, P_i > 0                   the decay alpha is proved

along every edge hold for every walk (multiple Lyapunov functions; Lee and Dullerud, Automatica 42(2), 2006).
Nodes that remember how the last delivery was reached prove more.

The inequalities are solved for a few of the corners, then all are looked at, and those that do not hold
are added. What is given out has been put into all of them, at its own gain, in numpy.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky

from design.admissible_steps import node_count
from design.delay_loop import Array
from design.errors import NoSolution
from design.held_loop import HeldLoop
from design.lmi import SOLVER, LmiProblem, MatrixInequality, Unknowns, solve
from design.loss_patterns import Pattern
from design.sequence_graph import Edge, edges_of
from design.step_maps import step_maps, value_maps
from design.value_map import ValueMap

_STRICT = 1e-6
"""Margin demanded of the solver, in the same coordinates."""
_MARGIN = 1e-9
"""Smallest eigenvalue that counts as proof."""
_EXCHANGES = 12
_ADDED = 3
"""Corners of an edge that are added in one exchange."""
_BISECTIONS = 14
_DECAY_TOLERANCE = 2e-4
_LEVELS = 4
_RAISED = (1e-4, 1e-3)
"""Relative: so much above the solver's gain the proof is tried."""
_CLOSE = 1.01
"""Certified over found at which nodes need not remember."""
_UNITS_AT = (1.2, 2.0, 1.05, 5.0)
"""Times the largest gain: where the value functions are taken that give the units."""
_SIZE_MAX = 42.0
"""States, times nodes to the power 1/3: it takes minutes, and grows by the sixth power."""
_SIZE_REMEMBERING_MAX = 45.0
"""The same where nodes remember and are squared."""
_FIRST_PARTS = (0.0, 0.2, 0.5, 1.0)
_TOLERANCES = (1e-8, 1e-7, 1e-6, 1e-5)
_DOUBLINGS = 14
_ROUND = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SequenceCertificate:
    """The proof: P_i of each node in the loop's own coordinates, and what it proves."""

    P: list[Array]
    min_margin: float
    """Smallest eigenvalue of all inequalities, in coordinates in which they are of size 1."""
    decay_per_s: float | None = None
    gain: float | None = None
    """rad/s per N m."""
    solver: str = SOLVER
    status: str = "Solved"


class _Inequalities:
    """Those of one graph in good coordinates, for a gain level or for a decay."""

    def __init__(self, loop: HeldLoop, nodes: int, edges: list[Edge], L: Array, level: float | None) -> None:
        self._loop = loop
        self.nodes = nodes
        self.edges = edges
        self.L = L
        self.period_s = loop.network.period_s
        self._inverse = np.linalg.inv(L)
        self.level = level
        self._by_family: dict[int, ValueMap] = {}
        self.maps = [self._maps(edge, level) for edge in edges]
        self.excess = [self._excess(edge) for edge in edges]

    def _maps(self, edge: Edge, level: float | None) -> ValueMap:
        """In good coordinates; the bends cost a factor of the gain. No level: no disturbance, no output."""
        key = id(edge.corners)
        if key not in self._by_family:
            gain = math.inf if level is None else level / math.sqrt(1.0 + edge.epsilon)
            plain = value_maps(edge.loop, edge.corners.family, edge.corners.times_s, gain)
            L, inverse = self.L, self._inverse
            Q = inverse.T @ plain.Q @ inverse if level is not None else np.zeros_like(plain.Q)
            self._by_family[key] = ValueMap(L @ plain.Phi @ inverse, L @ plain.W @ L.T, Q, plain.bounded)
        return self._by_family[key]

    def _excess(self, edge: Edge) -> list[tuple[Array, Array, Array]]:
        """For each window: difference (kept,), bends (N, n), output bends (N,), with their factors."""
        corners = edge.corners
        factor = (1.0 + 1.0 / edge.epsilon) * corners.terms if edge.epsilon else 0.0
        return [
            (
                corners.differences[s] @ self._inverse,
                math.sqrt(factor) * corners.bends[:, s],
                factor * corners.output_bends[:, s] ** 2
                if self.level is not None
                else np.zeros(len(corners.times_s)),
            )
            for s in range(len(corners.differences))
        ]

    def slack(self, P: Sequence[Array], place: int, growth: float, squared: float = 1.0) -> Array:
        """(N,): smallest eigenvalue of each corner's inequality of one edge; -inf for an infinite value.

        ``squared``: of the gain over the level's, for W alone.
        """
        edge, maps = self.edges[place], self.maps[place]
        if self.level is not None:
            maps = replace(maps, W=maps.W / squared)
        value, finite = maps.of(P[edge.target])
        left = P[edge.source] - growth * ((1.0 + edge.epsilon) * value + self._between(P[edge.target], place))
        smallest = np.linalg.eigvalsh(left)[:, 0]
        return np.where(finite, smallest, -np.inf)

    def _between(self, P: Array, place: int) -> Array:
        total = np.zeros((len(self.edges[place].corners.times_s), *P.shape))
        n = len(self._loop.model.A)
        columns = self.L[:, :n]
        sizes = np.sqrt(np.maximum(np.einsum("ki,kl,li->i", columns, P, columns), 0.0))
        for difference, bends, outputs in self.excess[place]:
            size = (bends @ sizes) ** 2 + outputs
            total += size[:, None, None] * np.outer(difference, difference)
        return total

    def between_linear(self, unknowns: Unknowns, name: str, place: int, corner: int) -> Array:
        """A bound of :meth:`_between` linear in P: (entries of P, kept, kept), and its constant last."""
        n = len(self._loop.model.A)
        columns = self.L[:, :n]
        basis = unknowns.basis(name)
        diagonal = np.einsum("ki,ekl,li->ei", columns, basis, columns)
        k = len(self.L)
        found = np.zeros((len(basis) + 1, k, k))
        for difference, bends, outputs in self.excess[place]:
            square = np.outer(difference, difference)
            found[:-1] += (n * (diagonal @ bends[corner] ** 2))[:, None, None] * square
            found[-1] += outputs[corner] * square
        return found


def _problem(system: _Inequalities, chosen: Sequence[Sequence[int]], growth: float) -> LmiProblem:
    """Least gain^2/level^2 that the chosen corners allow; without a level minus the largest margin."""
    k, nodes = len(system.L), system.nodes
    unknowns = Unknowns()
    for node in range(nodes):
        unknowns.symmetric(f"P{node}", k)
    unknowns.symmetric("objective", 1)
    identity = np.eye(k)
    inequalities = []
    for node in range(nodes):
        positive = MatrixInequality.zero(unknowns, k)
        positive.add(unknowns, f"P{node}", identity)
        inequalities.append(positive)
    for place in range(len(system.edges)):
        maps = system.maps[place]
        for corner in chosen[place]:
            inequalities.append(_corner(system, unknowns, place, corner, maps, growth))
    if system.level is None:
        for inequality in inequalities:
            inequality.coefficients[-1] += identity
        bound = MatrixInequality(np.full((1, 1), float(k * nodes)), np.zeros((unknowns.count, 1, 1)))
        for node in range(nodes):
            part = unknowns.slice_of(f"P{node}")
            bound.coefficients[part, 0, 0] -= np.trace(unknowns.basis(f"P{node}"), axis1=1, axis2=2)
        inequalities.append(bound)
    objective = np.zeros(unknowns.count)
    objective[-1] = 1.0
    margin = 0.0 if system.level is None else _STRICT
    return LmiProblem("certificate for every sequence", unknowns, inequalities, objective, margin)


def _corner(
    system: _Inequalities, unknowns: Unknowns, place: int, corner: int, maps: ValueMap, growth: float
) -> MatrixInequality:
    """Schur's complement of P_i - growth ((1 + epsilon) value of P_j + what lies between) >= 0."""
    edge, k = system.edges[place], len(system.L)
    source, target = f"P{edge.source}", f"P{edge.target}"
    Phi, Q = maps.Phi[corner], maps.Q[corner]
    reach = _root(maps.W[corner]) if system.level is not None else np.zeros((k, 0))
    m = k + reach.shape[1]
    found = MatrixInequality.zero(unknowns, m)
    factor = 1.0 / (growth * (1.0 + edge.epsilon))
    rows = np.eye(m)[:, :k]
    found.add(unknowns, source, math.sqrt(factor) * rows)
    part = unknowns.slice_of(target)
    between = system.between_linear(unknowns, target, place, corner) / (1.0 + edge.epsilon)
    found.coefficients[part, :k, :k] -= between[:-1]
    found.constant[:k, :k] -= Q + between[-1]
    both = np.hstack([Phi, reach])
    cross = both.T @ unknowns.basis(target) @ both
    # Phi' P W^(1/2) may have either sign, for the disturbance may
    found.coefficients[part] -= cross
    found.coefficients[-1, k:, k:] += np.eye(m - k)
    return found


def _root(W: Array) -> Array:
    """B with B B' = W, its columns without those that are nothing."""
    values, vectors = np.linalg.eigh(W)
    kept = values > 1e-13 * max(float(values[-1]), 1e-300)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def certify_gain(
    loop: HeldLoop,
    patterns: Sequence[Pattern],
    found: float,
    remembering: Sequence[bool] = (False, True),
    other: HeldLoop | None = None,
) -> SequenceCertificate | None:
    """The least gain that can be certified; None if none can.

    ``patterns``: those that give the units, the worst among them; ``found``: their largest gain,
    rad/s per N m; ``remembering``: what is tried, in turn, until it comes close; ``other``: for every
    rate of the current loop between those of the two loops.
    """
    for units_at in _UNITS_AT:
        # the solver's luck turns with the units; whatever it says, the proof decides
        best: SequenceCertificate | None = None
        L = _coordinates(loop, patterns, units_at * found)
        for way in _ways(loop, remembering):
            nodes, edges = edges_of(loop, L, way, other)
            certificate = _least_gain(loop, nodes, edges, L, found)
            if certificate is not None and (best is None or _gain(certificate) < _gain(best)):
                best = certificate
            if best is not None and _gain(best) < _CLOSE * found:
                break
        if best is not None:
            return best
    return None


def certify_decay(
    loop: HeldLoop,
    patterns: Sequence[Pattern],
    gain: float,
    remembering: Sequence[bool] = (False, True),
    other: HeldLoop | None = None,
) -> SequenceCertificate | None:
    """The fastest decay that can be certified; None if not even stability can.

    ``gain``: the largest of ``patterns``, at which the units are taken; all else as for the gain.
    """
    worst = min(pattern.decay_per_s for pattern in patterns)
    best: SequenceCertificate | None = None
    L = _coordinates(loop, patterns, _UNITS_AT[0] * gain)
    for way in _ways(loop, remembering):
        nodes, edges = edges_of(loop, L, way, other)
        certificate = _fastest(_Inequalities(loop, nodes, edges, L, None), worst)
        if certificate is not None and (best is None or _decay(certificate) > _decay(best)):
            best = certificate
        if best is not None and _decay(best) > worst / _CLOSE:
            break
    return best


def _gain(certificate: SequenceCertificate) -> float:
    assert certificate.gain is not None
    return certificate.gain


def _decay(certificate: SequenceCertificate) -> float:
    assert certificate.decay_per_s is not None
    return certificate.decay_per_s


def _ways(loop: HeldLoop, remembering: Sequence[bool]) -> Sequence[bool]:
    """Whether nodes remember: not where there is nothing to be remembered, or too much.

    Raises NoSolution if the loop is too large for the inequalities.
    """
    nodes = node_count(loop.network)
    if loop.kept * nodes ** (1.0 / 3.0) > _SIZE_MAX:
        raise NoSolution(
            "certificate for arbitrary sequences",
            f"{loop.kept} states and {nodes} nodes are too many",
            "a longer period or a shorter agreed delay makes the loop smaller",
        )
    if nodes == 1 or loop.kept * nodes ** (2.0 / 3.0) > _SIZE_REMEMBERING_MAX:
        return (False,)
    return remembering


def _least_gain(
    loop: HeldLoop, nodes: int, edges: list[Edge], L: Array, found: float
) -> SequenceCertificate | None:
    level = found
    for _ in range(_LEVELS):
        answer = _exchanged(_Inequalities(loop, nodes, edges, L, level), 1.0)
        if answer is None:
            return None
        P, squared = answer
        level *= math.sqrt(max(squared, 1.0))
        for raised in _RAISED:
            margin = _proved(_Inequalities(loop, nodes, edges, L, level * (1.0 + raised)), P, 1.0)
            if margin > _MARGIN:
                proof = [L.T @ matrix @ L for matrix in P]
                return SequenceCertificate(proof, margin, gain=level * (1.0 + raised))
        level *= 1.0 + _RAISED[0]
    return None


def _fastest(system: _Inequalities, worst: float) -> SequenceCertificate | None:
    """By bisection, after no decay at all and nearly the ``worst`` known, which often is proved."""
    low, high, best = 0.0, worst, None
    rates = [0.0, worst * (1.0 - _DECAY_TOLERANCE)]
    for number in range(_BISECTIONS):
        rate = rates[number] if number < len(rates) else 0.5 * (low + high)
        growth = math.exp(2.0 * rate * system.period_s)
        answer = _exchanged(system, growth)
        margin = -math.inf if answer is None else _proved(system, answer[0], growth)
        if answer is None or margin < _MARGIN:
            if best is None:
                return None
            high = rate
        else:
            L = system.L
            low, best = rate, SequenceCertificate([L.T @ matrix @ L for matrix in answer[0]], margin, rate)
        if high - low <= _DECAY_TOLERANCE * high:
            break
    return best


def _exchanged(system: _Inequalities, growth: float) -> tuple[list[Array], float] | None:
    """P_i that meet every corner, and the objective; None if the solver finds none."""
    chosen = [
        sorted({round(part * (len(edge.corners.times_s) - 1)) for part in _FIRST_PARTS})
        for edge in system.edges
    ]
    answer = None
    for _ in range(_EXCHANGES):
        problem = _problem(system, chosen, growth)
        try:
            y = solve(problem, _TOLERANCES).y
        except NoSolution:
            return None
        if system.level is None and y[-1] >= 0.0:
            return None
        P = [problem.unknowns.value(f"P{node}", y) for node in range(system.nodes)]
        answer = P, float(y[-1])
        missing = 0
        for place in range(len(system.edges)):
            slack = system.slack(P, place, growth, float(y[-1]))
            bad = np.flatnonzero(slack < _MARGIN)
            missing += len(bad)
            worst = bad[np.argsort(slack[bad])[:_ADDED]]
            chosen[place] = sorted({*chosen[place], *(int(corner) for corner in worst)})
        if missing == 0:
            return answer
    return answer


def _proved(system: _Inequalities, P: Sequence[Array], growth: float) -> float:
    """Smallest eigenvalue of all inequalities."""
    own = min(float(np.linalg.eigvalsh(matrix)[0]) for matrix in P)
    slacks = (float(system.slack(P, place, growth).min()) for place in range(len(system.edges)))
    return min(own, *slacks)


def _coordinates(loop: HeldLoop, patterns: Sequence[Pattern], gain: float) -> Array:
    """L of xi' = L xi in which the value under ``patterns``, from each of their phases, is of size 1."""
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
