"""Certificates of a sampled loop for every admissible sequence of losses and delays.

The sequences are the walks of a graph (:mod:`servobench.design.sampled.admissible_steps`), each edge with the
corners of all its possible steps and the bounds between them (:mod:`servobench.design.sampled.step_maps`).
Quadratic functions xi' P_i xi, one for each node, with

    value of any stretch from i to j of P_j  <=  P_i         the gain is proved
    e^{2 alpha t} M' P_j M <= P_i, P_i > 0                   the decay alpha is proved, t the stretch's length

along every edge hold for every walk (multiple Lyapunov functions; Lee and Dullerud, Automatica 42(2), 2006).
A stretch lasts from one delivery to the next; for a range of current loops it is a period, as the bound
between two rates holds for one period at a time. Nodes that remember how the last deliveries were reached
prove more: of an H-infinity controller with one reading lost 1.0001 times the gain found, without memory 1.6.

Every result has been put into all inequalities, at its own gain, in numpy.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.lmi import LmiProblem, MatrixInequality
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import delivery_node_count, node_count
from servobench.design.sampled.held_loop import SwitchedLoop
from servobench.design.sampled.loss_patterns import Pattern
from servobench.design.sampled.sequence_graph import Edge, between_deliveries, edges_of
from servobench.design.sampled.sequence_inequalities import (
    MARGIN,
    Inequalities,
    coordinates,
    corner_inequalities,
    exchanged,
    node_unknowns,
    proved,
)

_STRICT = 1e-6
"""Margin demanded of the solver, in the same coordinates."""
_BISECTIONS = 14
"""Bisections at most: two first tries and twelve halvings, to 1/4096 of the worst known, about the
tolerance."""
_DECAY_TOLERANCE = 2e-4
"""Relative: ten times as much gives away 8e-4 of the decay, a tenth wins 6e-5."""
_COARSE_FROM, _COARSE_TOLERANCE = 24, 1e-2
"""Number of states from which a problem takes a minute, and the coarser decay tolerance there, with half the
problems."""
_LEVELS = 5
"""Levels at most: for the paper's loop and a random one the first gives the same gain."""
_RAISED = (1e-4, 1e-3, 1e-2)
"""Relative: raises above the solver's gain at which the proof is tried."""
_LOWERED = (1e-6, 1e-4, 1e-2)
"""Relative: reductions below the decay of the functions at which the proof is tried."""
_NEAR = 2e-3
"""Share of the gain's square: this near to its level the solver's gain equals one at its own level."""
_CLOSE = 1.01
"""Ratio of certified to found at which nodes need not remember."""
REMEMBERED = (0, 1, 2, 3, 4)
"""Numbers of last deliveries that nodes remember, tried in turn."""
_UNITS_AT = (1.2, 2.0, 1.05, 5.0)
"""Multiples of the largest gain at which the value functions give the units."""
_SIZE_MAX = 42.0
"""States, times nodes to the power 1/3: this takes minutes, and grows by the sixth power."""
_SIZE_REMEMBERING_MAX = 45.0
"""The same if nodes remember one delivery and are squared."""
_FURTHER_UNKNOWNS_MAX, _FURTHER_CORNERS_MAX, _FURTHER_UNEVEN_MAX = 1500, 100, 700
"""Of a graph whose nodes remember more: it takes some seconds. The last: corners where periods are uneven,
which are many and alike; with 672 half a minute."""
_WORTH_REMEMBERING = 0.02
"""Share of what lies between certified and found that one more delivery remembered has to win, else the next
is not tried."""


@dataclass(frozen=True, slots=True, eq=False)
class SequenceCertificate:
    """The proof: P_i of each node in the loop's own coordinates, and its result."""

    P: list[Array]
    min_margin: float
    """Smallest eigenvalue of all inequalities, in coordinates in which they are of size 1."""
    figure: float
    """The decay, 1/s, or the gain, rad/s per N m."""


def _problem(system: Inequalities, chosen: Sequence[Sequence[int]], growth: float) -> LmiProblem:
    """Pose the least gain^2/level^2 allowed by the chosen corners; without a level minus the largest
    margin."""
    k, nodes = len(system.L), system.nodes
    unknowns = node_unknowns(system)
    inequalities = [MatrixInequality.positive(unknowns, f"P{node}") for node in range(nodes)]
    inequalities += corner_inequalities(system, unknowns, chosen, growth)
    if system.level is None:
        for inequality in inequalities:
            inequality.coefficients[-1] += np.eye(k)
        bound = MatrixInequality(np.full((1, 1), float(k * nodes)), np.zeros((unknowns.count, 1, 1)))
        for node in range(nodes):
            part = unknowns.slice_of(f"P{node}")
            bound.coefficients[part, 0, 0] -= np.trace(unknowns.basis(f"P{node}"), axis1=1, axis2=2)
        inequalities.append(bound)
    margin = 0.0 if system.level is None else _STRICT
    return LmiProblem("certificate for every sequence", unknowns, inequalities, unknowns.last, margin)


def certify_gain(
    loop: SwitchedLoop,
    patterns: Sequence[Pattern],
    found: float,
    remembered: Sequence[int] = REMEMBERED,
    other: SwitchedLoop | None = None,
) -> SequenceCertificate | None:
    """Return the least gain that can be certified; None if none can.

    ``patterns``: patterns that give the units, the worst included; ``found``: their largest gain, rad/s per N
    m; ``remembered``: numbers of last deliveries that nodes remember, tried in turn until one comes close;
    ``other``: for every rate of the current loop between those of the two loops.
    """
    for units_at in _UNITS_AT:
        # the solver's luck turns with the units; whatever it says, the proof decides
        L = coordinates(loop, patterns, units_at * found)
        best: SequenceCertificate | None = None
        for nodes, edges in _graphs(loop, L, remembered, other):
            certificate = least_gain(loop, nodes, edges, L, found)
            before = math.inf if best is None else best.figure / found - 1.0
            if certificate is not None and (best is None or certificate.figure < best.figure):
                best = certificate
            if best is not None and near_enough(before, best.figure / found - 1.0):
                break
        if best is not None:
            return best
    return None


def near_enough(before: float, now: float) -> bool:
    """Return True where no more needs to be remembered. ``now``: what lies between certified and found, as a
    share; ``before``: with less memory."""
    return now < _CLOSE - 1.0 or (math.isfinite(before) and now > (1.0 - _WORTH_REMEMBERING) * before)


def certify_decay(
    loop: SwitchedLoop,
    patterns: Sequence[Pattern],
    gain: float,
    remembered: Sequence[int] = REMEMBERED,
    other: SwitchedLoop | None = None,
) -> SequenceCertificate | None:
    """Return the fastest decay that can be certified; None if not even stability can.

    ``gain``: the largest of ``patterns``, at which the units are taken; all else as for the gain.
    """
    worst = min(pattern.decay_per_s for pattern in patterns)
    best: SequenceCertificate | None = None
    L = coordinates(loop, patterns, _UNITS_AT[0] * gain)
    for nodes, edges in _graphs(loop, L, remembered, other):
        certificate = _fastest(Inequalities(loop, nodes, edges, L, None), worst)
        before = math.inf if best is None else 1.0 - best.figure / worst
        if certificate is not None and (best is None or certificate.figure > best.figure):
            best = certificate
        if best is not None and near_enough(before, 1.0 - best.figure / worst):
            break
    return best


def _graphs(
    loop: SwitchedLoop, L: Array, remembered: Sequence[int], other: SwitchedLoop | None
) -> Iterator[tuple[int, list[Edge]]]:
    """Yield graphs from delivery to delivery; with an ``other`` loop period by period, as the bounds add
    up."""
    by_period = other is not None or loop.network.uneven_s > 0.0
    count = node_count(loop.network) if by_period else delivery_node_count(loop.network)
    for deliveries in memories_of(loop, remembered, count):
        if other is not None and deliveries > 1:
            return
        nodes, edges = edges_of(loop, L, deliveries, other)
        if not by_period:
            nodes, edges = between_deliveries(edges)
        unknowns = nodes * loop.kept * (loop.kept + 1) // 2
        corners = sum(len(edge.corners.times_s) for edge in edges)
        most = _FURTHER_UNEVEN_MAX if by_period else _FURTHER_CORNERS_MAX
        if deliveries > 1 and (unknowns > _FURTHER_UNKNOWNS_MAX or corners > most):
            return
        yield nodes, edges


def memories_of(loop: SwitchedLoop, remembered: Sequence[int], nodes: int) -> Sequence[int]:
    """Return the numbers of deliveries to remember: none where there is nothing to remember, or too much.

    ``nodes``: their number if they do not remember. Raises NoSolution if the loop is too large.
    """
    if loop.kept * nodes ** (1.0 / 3.0) > _SIZE_MAX:
        raise NoSolution(
            "certificate for arbitrary sequences",
            f"{loop.kept} states and {nodes} nodes are too many",
            "a longer period or a shorter agreed delay makes the loop smaller",
        )
    memories = node_count(loop.network)
    if memories == 1 or loop.kept * memories ** (2.0 / 3.0) > _SIZE_REMEMBERING_MAX:
        return (0,)
    return remembered


def least_gain(
    loop: SwitchedLoop, nodes: int, edges: list[Edge], L: Array, found: float
) -> SequenceCertificate | None:
    """Return the least gain that functions of this graph certify, in coordinates ``L``; None if none can.

    ``found``: gain at which the levels begin, rad/s per N m.
    """
    level, slope = math.log(found), -2.0
    last: tuple[float, float, list[Array]] | None = None
    for _ in range(_LEVELS):
        system = Inequalities(loop, nodes, edges, L, math.exp(level))
        answer = exchanged(system, partial(_problem, system, growth=1.0), 1.0)
        if answer is None or answer[1] <= 0.0:
            break
        excess = math.log(answer[1])
        # the solver's gain is that of its level, and is wanted where it is the level
        if last is not None and (excess - last[1]) * (level - last[0]) < 0.0:
            slope = (excess - last[1]) / (level - last[0])
        last = level, excess, answer[0]
        if abs(excess) < _NEAR:
            break
        level -= excess / slope
    if last is None:
        return None
    level, excess, P = last
    gains = [math.exp(level + 0.5 * excess) * (1.0 + raised) for raised in _RAISED]
    if excess < 0.0:
        gains.append(math.exp(level) * (1.0 + _RAISED[0]))
    for gain in sorted(gains):
        margin = proved(Inequalities(loop, nodes, edges, L, gain), P, 1.0)
        if margin > MARGIN:
            return SequenceCertificate([L.T @ matrix @ L for matrix in P], margin, gain)
    return None


def _fastest(system: Inequalities, worst: float) -> SequenceCertificate | None:
    """Return the fastest decay by bisection, after no decay at all and nearly the ``worst`` known, which
    often is proved."""
    low, high, best = 0.0, worst, None
    tolerance = _DECAY_TOLERANCE if len(system.L) < _COARSE_FROM else _COARSE_TOLERANCE
    rates = [0.0, worst * (1.0 - tolerance)]
    for number in range(_BISECTIONS):
        rate = rates[number] if number < len(rates) else 0.5 * (low + high)
        growth = math.exp(2.0 * rate * system.period_s)
        answer = exchanged(system, partial(_problem, system, growth=growth), growth, objective_max=0.0)
        proof = None if answer is None else _decay_of(system, answer[0], rate)
        if proof is not None:
            low, best = proof.figure, proof
        elif best is None:
            return None
        else:
            high = rate
        if high - low <= tolerance * high:
            break
    return best


def _decay_of(system: Inequalities, P: list[Array], asked: float) -> SequenceCertificate | None:
    """Return the fastest decay that the functions prove, whatever their purpose; ``asked`` if that is all."""
    try:
        fastest = min(
            -math.log(system.share_left(P, place)) / (2.0 * edge.periods * system.period_s)
            for place, edge in enumerate(system.edges)
        )
    except np.linalg.LinAlgError:
        return None
    for rate in (*(fastest * (1.0 - lowered) for lowered in _LOWERED), asked):
        if rate < asked:
            continue
        margin = proved(system, P, math.exp(2.0 * rate * system.period_s))
        if margin > MARGIN:
            return SequenceCertificate([system.L.T @ matrix @ system.L for matrix in P], margin, rate)
    return None
