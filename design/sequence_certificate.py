"""Certificates of a sampled loop for every admissible sequence of losses and delays.

The sequences are the walks of a graph: a node is what the network has done lately, an edge what it does
next, with the transition matrices that this may mean and the time that it takes. Quadratic functions
xi' P_i xi, one for each node, that fall along every edge i -> j by the factor e^{-2 alpha time},

    M' P_j M <= e^{-2 alpha time} P_i     for every matrix M of the edge,        P_i > 0,

prove that xi decays at the rate alpha under any walk (multiple Lyapunov functions; with one node it is
the common one). The condition is convex in M, so where the delay may lie anywhere in an interval it is
enough that it holds at the corners of a polytope around the matrices of that interval.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, expm, solve_discrete_lyapunov

from design.delay_loop import Array
from design.errors import NoSolution
from design.held_loop import Delivery, HeldLoop, Strategy
from design.lmi import SOLVER, LmiProblem, MatrixInequality, Unknowns, smallest_eigenvalues, solve

SIZE_MAX = 24
"""States, times nodes to the power 1/3, up to which the inequalities are solved at all."""
_CELL_TURN = 0.15
"""Width of an interval of delays, times the plant's fastest rate."""
_CELLS_MAX = 48
_BISECTIONS = 16
_MARGIN = 1e-9
"""Smallest eigenvalue, of inequalities of size 1, that counts as proof."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """What the network does next: from node to node, corners of its transition matrices, its time in s."""

    source: int
    target: int
    corners: list[Array]
    time_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SequenceCertificate:
    """The proof: P_i of each node in the loop's own coordinates, and the rate that it proves."""

    decay_per_s: float
    P: list[Array]
    min_margin: float
    """Smallest eigenvalue of all inequalities, in coordinates in which they are of size 1."""
    solver: str = SOLVER
    status: str = "Solved"


def graph_of(loop: HeldLoop, by_last_interval: bool) -> tuple[int, list[Edge]]:
    """Number of nodes, and the edges.

    ``by_last_interval``: a node for each interval that may lie before a delivery, which proves more.
    Without it arrival has one node, stamp one for each number of losses in a row; history has one always.
    """
    network = loop.network
    h = network.period_s
    if network.strategy is Strategy.HISTORY:
        return 1, [Edge(0, 0, [loop.kept_transition(loop.sample_step(True))], h)]
    intervals = range(1, network.losses_max + 2)
    if network.strategy is Strategy.STAMP:
        if not by_last_interval:
            return _stamp_steps(loop)
        corners = {
            interval: [loop.kept_transition(loop.step(Delivery(interval, 0.0)))] for interval in intervals
        }
    else:
        corners = {interval: _arrival_corners(loop, interval) for interval in intervals}
    if not by_last_interval:
        return 1, [Edge(0, 0, corners[interval], interval * h) for interval in intervals]
    return len(intervals), [
        Edge(before - 1, interval - 1, corners[interval], interval * h)
        for before in intervals
        for interval in intervals
    ]


def _stamp_steps(loop: HeldLoop) -> tuple[int, list[Edge]]:
    """Period by period, with a node for each number of losses in a row: many small inequalities."""
    network = loop.network
    came, lost = (loop.kept_transition(loop.sample_step(which)) for which in (True, False))
    edges = [Edge(node, 0, [came], network.period_s) for node in range(network.losses_max + 1)]
    edges += [Edge(node, node + 1, [lost], network.period_s) for node in range(network.losses_max)]
    return network.losses_max + 1, edges


def certify(loop: HeldLoop, decay_max_per_s: float) -> SequenceCertificate | None:
    """The fastest decay that can be certified, at most ``decay_max_per_s``; None if not even stability can.

    ``decay_max_per_s``: that of the worst pattern known, which no certificate can exceed.
    Raises NoSolution if the loop is too large for the inequalities.
    """
    best: SequenceCertificate | None = None
    for by_last_interval in (False, True):
        nodes, edges = graph_of(loop, by_last_interval)
        if loop.kept * nodes ** (1.0 / 3.0) > SIZE_MAX:
            raise NoSolution(
                "certificate for arbitrary sequences",
                f"{loop.kept} states and {nodes} nodes are too many",
                "a longer period or a shorter agreed delay makes the loop smaller",
            )
        found = _fastest(loop, nodes, edges, decay_max_per_s)
        if found is not None and (best is None or found.decay_per_s > best.decay_per_s):
            best = found
        close = best is not None and best.decay_per_s > 0.98 * decay_max_per_s
        if close or loop.network.strategy is Strategy.HISTORY or loop.network.losses_max == 0:
            break
    return best


def _fastest(
    loop: HeldLoop, nodes: int, edges: list[Edge], decay_max_per_s: float
) -> SequenceCertificate | None:
    L = _coordinates(loop, edges)
    inverse = np.linalg.inv(L)
    turned = [
        Edge(edge.source, edge.target, [L @ M @ inverse for M in edge.corners], edge.time_s) for edge in edges
    ]
    low, high = 0.0, decay_max_per_s
    if not high > 0.0:
        return None
    best = _at(turned, nodes, low)
    if best is None:
        return None
    if math.isinf(high):
        high = 100.0 / max(edge.time_s for edge in edges)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        found = _at(turned, nodes, middle)
        if found is None:
            high = middle
        else:
            low, best = middle, found
    P, margin = best
    return SequenceCertificate(low, [L.T @ matrix @ L for matrix in P], margin)


def _at(edges: list[Edge], nodes: int, decay_per_s: float) -> tuple[list[Array], float] | None:
    """P_i and the margin with which they prove ``decay_per_s``; None if the solver finds none that do."""
    problem = _problem(edges, nodes, decay_per_s)
    try:
        y = solve(problem, (1e-8,)).y
    except NoSolution:
        return None
    proof = y.copy()
    proof[-1] = 0.0
    margin = min(smallest_eigenvalues(problem, proof)[: nodes + sum(len(edge.corners) for edge in edges)])
    if margin < _MARGIN:
        return None
    return [problem.unknowns.value(f"P{node}", y) for node in range(nodes)], margin


def _problem(edges: list[Edge], nodes: int, decay_per_s: float) -> LmiProblem:
    """Largest margin, with the traces bounded; the last unknown is minus the margin."""
    n = len(edges[0].corners[0])
    unknowns = Unknowns()
    for node in range(nodes):
        unknowns.symmetric(f"P{node}", n)
    unknowns.symmetric("minus_margin", 1)
    identity = np.eye(n)
    inequalities = []
    for node in range(nodes):
        positive = MatrixInequality.zero(unknowns, n)
        positive.add(unknowns, f"P{node}", identity)
        inequalities.append(positive)
    for edge in edges:
        factor = math.exp(-decay_per_s * edge.time_s)
        for M in edge.corners:
            falls = MatrixInequality.zero(unknowns, n)
            falls.add(unknowns, f"P{edge.source}", factor * identity)
            part = unknowns.slice_of(f"P{edge.target}")
            falls.coefficients[part] -= M.T @ unknowns.basis(f"P{edge.target}") @ M
            inequalities.append(falls)
    for inequality in inequalities:
        inequality.coefficients[-1] += identity
    bound = MatrixInequality(np.full((1, 1), float(n * nodes)), np.zeros((unknowns.count, 1, 1)))
    for node in range(nodes):
        part = unknowns.slice_of(f"P{node}")
        bound.coefficients[part, 0, 0] -= np.trace(unknowns.basis(f"P{node}"), axis1=1, axis2=2)
    objective = np.zeros(unknowns.count)
    objective[-1] = 1.0
    what = f"certificate of a decay of {decay_per_s:.6g} per s for every sequence"
    return LmiProblem(what, unknowns, [*inequalities, bound], objective)


def _coordinates(loop: HeldLoop, edges: list[Edge]) -> Array:
    """L of xi' = L xi, in which one edge's own Lyapunov function is the unit ball: for the solver's sake."""
    model = loop.model
    w_scale = max(float(np.abs(loop.K) @ model.state_scale), 1e-12)
    scale = np.concatenate([model.state_scale, np.full(loop.kept - len(model.A), w_scale)])
    M = edges[0].corners[0] * scale / scale[:, None]
    radius = max(float(np.max(np.abs(np.linalg.eigvals(M)))), 0.3)
    X = solve_discrete_lyapunov((M / (1.02 * radius)).T, np.eye(len(M)))
    return np.asarray(cholesky(X) / scale)


def _arrival_corners(loop: HeldLoop, interval: int) -> list[Array]:
    """Corners around the transitions of an interval for all delays from 0 to T.

    The transition is affine in g(theta) = integral of e^{As} B1 over [0, theta], theta = interval h - delay.
    On a cell of theta g departs from its chord by at most width^2/8 times a bound of its second derivative.
    """
    network, model = loop.network, loop.model
    n = len(model.A)
    end_s = interval * network.period_s
    base = loop.kept_transition(loop.step(Delivery(interval, 0.0)))
    rate = float(np.linalg.norm(model.A * model.state_scale / model.state_scale[:, None], 2))
    cells = min(_CELLS_MAX, max(1, math.ceil(network.delay_max_s * rate / _CELL_TURN)))
    if network.delay_max_s == 0.0:
        return [base]
    width = network.delay_max_s / cells
    corners = []
    signs = 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1) - 1.0
    for cell in range(cells):
        delays = (cell * width, (cell + 1) * width)
        ends = [_held_effect(loop, end_s) - _held_effect(loop, end_s - delay) for delay in delays]
        start = expm(model.A * (end_s - delays[1])) @ model.B1
        A = np.abs(model.A)
        bend = width**2 / 8.0 * (A @ expm(A * width) @ np.abs(start))
        for g in ends:
            for sign in signs:
                late = g + sign * bend
                M = base.copy()
                # what the new input does not do while the old one still acts
                M[:n, :n] -= np.outer(late, loop.K)
                M[:n, n] += late
                corners.append(M)
    return corners


def _held_effect(loop: HeldLoop, time_s: float) -> Array:
    """g(time): what a unit input, held for ``time_s``, does to x."""
    model = loop.model
    n = len(model.A)
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n] = model.A, model.B1
    return np.asarray(expm(M * time_s)[:n, n])
