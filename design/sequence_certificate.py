"""Certificates of a sampled loop for every admissible sequence of losses and delays.

The sequences are the walks of a graph (:mod:`design.admissible_steps`), each edge with the corners of all
that it may mean and the bounds of what lies between (:mod:`design.step_maps`). Quadratic functions
xi' P_i xi, one for each node, with

    value of any step from i to j of P_j  <=  P_i            the gain is proved
    e^{2 alpha h} M' P_j M <= P_i, P_i > 0                   the decay alpha is proved

along every edge hold for every walk (multiple Lyapunov functions; Lee and Dullerud, Automatica 42(2), 2006).
Nodes that remember how the last delivery was reached prove more.

What is given out has been put into all inequalities, at its own gain, in numpy.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from design.admissible_steps import node_count
from design.delay_loop import Array
from design.errors import NoSolution
from design.held_loop import HeldLoop
from design.lmi import SOLVER, LmiProblem, MatrixInequality, Unknowns
from design.loss_patterns import Pattern
from design.sequence_graph import Edge, edges_of
from design.sequence_inequalities import (
    MARGIN,
    Inequalities,
    coordinates,
    corner_inequality,
    exchanged,
    proved,
)

_STRICT = 1e-6
"""Margin demanded of the solver, in the same coordinates."""
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


def _problem(system: Inequalities, chosen: Sequence[Sequence[int]], growth: float) -> LmiProblem:
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
            inequalities.append(corner_inequality(system, unknowns, place, corner, maps, growth))
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
        L = coordinates(loop, patterns, units_at * found)
        for way in ways_of(loop, remembering):
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
    L = coordinates(loop, patterns, _UNITS_AT[0] * gain)
    for way in ways_of(loop, remembering):
        nodes, edges = edges_of(loop, L, way, other)
        certificate = _fastest(Inequalities(loop, nodes, edges, L, None), worst)
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


def ways_of(loop: HeldLoop, remembering: Sequence[bool]) -> Sequence[bool]:
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
        system = Inequalities(loop, nodes, edges, L, level)
        answer = exchanged(system, partial(_problem, system, growth=1.0), 1.0)
        if answer is None:
            return None
        P, squared = answer
        level *= math.sqrt(max(squared, 1.0))
        for raised in _RAISED:
            margin = proved(Inequalities(loop, nodes, edges, L, level * (1.0 + raised)), P, 1.0)
            if margin > MARGIN:
                proof = [L.T @ matrix @ L for matrix in P]
                return SequenceCertificate(proof, margin, gain=level * (1.0 + raised))
        level *= 1.0 + _RAISED[0]
    return None


def _fastest(system: Inequalities, worst: float) -> SequenceCertificate | None:
    """By bisection, after no decay at all and nearly the ``worst`` known, which often is proved."""
    low, high, best = 0.0, worst, None
    rates = [0.0, worst * (1.0 - _DECAY_TOLERANCE)]
    for number in range(_BISECTIONS):
        rate = rates[number] if number < len(rates) else 0.5 * (low + high)
        growth = math.exp(2.0 * rate * system.period_s)
        answer = exchanged(system, partial(_problem, system, growth=growth), growth, objective_max=0.0)
        margin = -math.inf if answer is None else proved(system, answer[0], growth)
        if answer is None or margin < MARGIN:
            if best is None:
                return None
            high = rate
        else:
            L = system.L
            low, best = rate, SequenceCertificate([L.T @ matrix @ L for matrix in answer[0]], margin, rate)
        if high - low <= _DECAY_TOLERANCE * high:
            break
    return best
