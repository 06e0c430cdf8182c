"""The largest speed error after a load step, bounded for every admissible sequence.

The load steps by 1 N m at rest, anywhere in a period. Under it there is one state at rest, xi_r, for every
sequence. A loop that never switches is simulated (:mod:`servobench.design.sampled.unswitched_peak`). Else
quadratic functions |xi - xi_r|_i^2 fall by rho^2 in each period (multiple Lyapunov functions), fast ones, and
wide ones that fall slowly but enclose less. The reachable states at node i are enclosed by

    conv(S_i, ellipsoid of the wide function) + ball of radius r in the fast |.|_i

the ellipsoid so small that what follows from it cannot exceed the largest error already reached. S_i grows
from the states at the first sample: each of its states is stepped through every corner of every edge, and the
result is added unless it is within (1 - rho) r, less the bound between corners, of the hull: steps are
affine, a ball of r becomes one of rho r, and the ellipsoids step into each other. When nothing more is
added, the enclosure holds for ever; the largest error of S_i, plus that of a ball of r, is the bound. The
states of S_i are really reached, so their largest error is found as well. r is made smaller until S_i grows
too large; if even the first does, the quadratic functions alone remain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import cholesky

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.lmi import LmiProblem, MatrixInequality
from servobench.design.sampled.admissible_steps import node_count
from servobench.design.sampled.growing_hull import GrowingHull
from servobench.design.sampled.held_loop import HeldLoop
from servobench.design.sampled.loss_patterns import Pattern
from servobench.design.sampled.peak_steps import (
    LoadedSteps,
    PeakBound,
    between_instants,
    first_states,
    inputs_of,
    instants_for,
    loaded_steps,
    rest_under_load,
    start_curvature,
)
from servobench.design.sampled.sequence_certificate import memories_of
from servobench.design.sampled.sequence_graph import Edge, edges_of
from servobench.design.sampled.sequence_inequalities import (
    Inequalities,
    coordinates,
    corner_inequalities,
    exchanged,
    node_unknowns,
)
from servobench.design.sampled.step_maps import corners_of
from servobench.design.sampled.unswitched_peak import only_step, unswitched_peak

_UNITS_AT = 1.2
"""Multiple of the largest gain at which the value functions give the units."""
_DECAY_PARTS = (0.85, 0.5, 0.2)
"""Shares of the decay certified: the faster the functions fall, the larger steps may be left out of the
hull."""
_SHARES = (0.25, 0.08, 0.03, 0.01)
"""Shares of the largest error that a ball of r may add to it."""
_STATES_MAX = 15_000
"""States of all S_i together, for one share."""
_HELD_MAX = 60_000_000
"""Limit of hull points compared with candidates, for one share: some 30 s of processor time."""
_REFINED = 0.6
"""Share of that limit, times that of r, up to which a smaller r is tried: it takes some ten times as many."""
_WIDE_PART = 0.1
"""Share of the decay at which the functions enclose least: what they enclose need not be stepped."""
_CORNERS_SHARE = 0.5
"""Share of the omission allowed that may lie between the corners of an edge."""
_COARSER = (64.0, 16.0, 4.0, 1.0)
"""Multiples of that: denser corners only for the states that need them."""
_INSTANTS_SHARE = 0.1
"""Share of a ball's error that may lie between two instants."""
_START_PARTS = 16
"""Number of parts of the period in which the load may step."""


@dataclass(frozen=True, slots=True, eq=False)
class _Norm:
    """|xi|_i = |T_i xi|, falling by ``rho`` each period; |C xi| <= spread |xi|_i."""

    T: list[Array]
    inverses: list[Array]
    rho: float
    spread: float


def certify_peak(
    loop: HeldLoop, patterns: Sequence[Pattern], gain: float, decay_per_s: float, peak_found: float
) -> PeakBound | None:
    """Return the least bound found; None if there are no quadratic functions.

    ``patterns``, ``gain``: as for :func:`servobench.design.sampled.sequence_certificate.certify_decay`;
    ``decay_per_s``: decay certified there; ``found``: the largest error known, rad/s per N m.
    """
    only = only_step(loop)
    if only is not None:
        return unswitched_peak(loop, only)
    L = coordinates(loop, patterns, _UNITS_AT * gain)
    for remembered in memories_of(loop, (0, 1), node_count(loop.network)):
        for part in _DECAY_PARTS:
            norm = _norm(loop, L, remembered, part * decay_per_s)
            if norm is not None:
                wide = _norm(loop, L, remembered, _WIDE_PART * decay_per_s) or norm
                return _bound(loop, L, norm, wide, peak_found, remembered)
    return None


def _bound(
    loop: HeldLoop, L: Array, norm: _Norm, wide: _Norm, peak_found: float, remembered: int
) -> PeakBound:
    """Bound by finer and finer balls, until the sets grow too large."""
    best: PeakBound | None = None
    for share in _SHARES:
        tube = _Tube(loop, L, norm, wide, peak_found, share, remembered)
        if best is None:
            best = PeakBound(tube.bound_without_hull(), peak_found)
        closed = tube.close()
        peak_found = tube.reached
        best = PeakBound(min(best.certified, tube.bound()) if closed else best.certified, peak_found)
        if not closed or tube.compared > _REFINED * share * _HELD_MAX:
            break
    assert best is not None
    return best


def _norm(loop: HeldLoop, L: Array, remembered: int, rate_per_s: float) -> _Norm | None:
    """Return functions that fall at ``rate_per_s`` or nearly so, and are smallest where the load begins."""
    nodes, edges = edges_of(loop, L, remembered)
    system = Inequalities(loop, nodes, edges, L, None)
    n, h = len(loop.model.A), loop.network.period_s
    inverse = np.linalg.inv(L)
    row = np.append(loop.model.C, np.zeros(loop.kept - n)) @ inverse
    starts = [L @ (start - rest_under_load(loop)) for start in first_states(loop, 2)]
    growth = math.exp(2.0 * rate_per_s * h)
    answer = exchanged(system, partial(_problem, system, row, starts, growth=growth), growth)
    if answer is None:
        return None
    try:
        roots = [cholesky(P) for P in answer[0]]
    except np.linalg.LinAlgError:
        return None
    rho = math.sqrt(max(system.share_left(answer[0], place) for place in range(len(edges))))
    spread = max(float(np.linalg.norm(np.linalg.solve(root.T, row))) for root in roots)
    T = [root @ L for root in roots]
    return _Norm(T, [np.linalg.inv(each) for each in T], rho, spread) if rho < 1.0 else None


def _problem(
    system: Inequalities, row: Array, starts: Sequence[Array], chosen: Sequence[Sequence[int]], growth: float
) -> LmiProblem:
    """Pose the least b with start' P_i start <= b, P_i >= row' row, falling by ``growth`` at the chosen
    corners."""
    unknowns = node_unknowns(system)
    inequalities = []
    for node in range(system.nodes):
        above = MatrixInequality.positive(unknowns, f"P{node}")
        above.constant -= np.outer(row, row)
        inequalities.append(above)
        for start in starts:
            below = MatrixInequality.zero(unknowns, 1)
            below.add_form(unknowns, f"P{node}", start[None, :], -1.0)
            below.coefficients[-1] += 1.0
            inequalities.append(below)
    inequalities += corner_inequalities(system, unknowns, chosen, growth)
    return LmiProblem("certificate of the peak", unknowns, inequalities, unknowns.last)


def _loaded(
    loop: HeldLoop, L: Array, edges: Sequence[Edge], target: float, instants: int
) -> list[LoadedSteps]:
    """Return the steps of each edge, with corners as dense as
    :func:`servobench.design.sampled.step_maps.corners_of` says."""
    corners = {id(edge.corners): corners_of(loop, edge.corners.family, L, target) for edge in edges}
    return [
        loaded_steps(loop, edge.source, edge.target, corners[id(edge.corners)], instants) for edge in edges
    ]


class _Tube:
    """The sets S_i while they grow, for one r."""

    def __init__(
        self, loop: HeldLoop, L: Array, norm: _Norm, wide: _Norm, found: float, share: float, remembered: int
    ) -> None:
        self._loop = loop
        self._norm = norm
        self._wide = wide
        self._rest = rest_under_load(loop)
        self._rest_error = abs(float(loop.model.C @ self._rest[: len(loop.model.C)]))
        self.reached = found
        self._r = share * found / norm.spread
        self._starts = first_states(loop, _START_PARTS)
        size = max(float(np.linalg.norm(L @ (start - self._rest))) for start in self._starts)
        turned = max(float(np.linalg.norm(T @ np.linalg.inv(L), 2)) for T in norm.T)
        target = _CORNERS_SHARE * (1.0 - norm.rho) * self._r / (size * turned)
        nodes, edges = edges_of(loop, L, remembered)
        self._instants = self._instants_for(edges, _INSTANTS_SHARE * share * found)
        self._levels = [_loaded(loop, L, edges, factor * target, self._instants) for factor in _COARSER]
        self._edges = self._levels[-1]
        self._spread = self._spread_of(norm)
        self._wide_spread = self._spread_of(wide)
        self._states = [np.zeros((0, loop.kept)) for _ in range(nodes)]
        self.compared = 0

    def _instants_for(self, edges: Sequence[Edge], allowed: float) -> int:
        """Return the number of instants between which the error of what the sets may hold departs by
        ``allowed``."""
        wide, n = self._wide, len(self._loop.model.A)
        size = max(float(np.linalg.norm((self._starts - self._rest) @ T.T, axis=1).max()) for T in wide.T)
        bends = []
        for edge in edges:
            inverse, rows = wide.inverses[edge.source], inputs_of(self._loop, edge.corners.family)
            x = np.abs(self._rest[:n]) + size * np.linalg.norm(inverse[:n], axis=1)
            held = np.abs(rows @ self._rest) + size * np.linalg.norm(rows @ inverse, axis=1)
            bends.append(between_instants(self._loop, x, float(np.max(held)), 1))
        return instants_for(max(bends), allowed)

    @property
    def _small(self) -> float:
        """Size around rest, in the wide norm, from which no error exceeds what is reached."""
        return max(0.0, (self.reached - self._rest_error) / self._wide_spread)

    def close(self) -> bool:
        """Grow the sets until nothing is left to add; False if they grow too large."""
        first = np.vstack([self._rest, self._starts])
        if self._start_bend(self._norm) > self._r:
            return False
        new = [self._taken_in(node, first, np.zeros(len(first))) for node in range(len(self._states))]
        while any(len(states) for states in new):
            came: list[list[tuple[Array, Array]]] = [[] for _ in self._states]
            for number, edge in enumerate(self._edges):
                if len(new[edge.source]):
                    came[edge.target].append(self._stepped(number, new[edge.source]))
            new = []
            for node, pairs in enumerate(came):
                states = np.vstack([pair[0] for pair in pairs]) if pairs else first[:0]
                allowed = np.concatenate([pair[1] for pair in pairs]) if pairs else np.zeros(0)
                if np.any(allowed <= 0.0):
                    return False
                new.append(self._taken_in(node, states, allowed))
            if sum(map(len, self._states)) > _STATES_MAX or self.compared > _HELD_MAX:
                return False
        return True

    def bound(self) -> float:
        """Return the bound of the closed sets."""
        added = self._spread * self._r
        largest = self.reached + added
        for edge in self._edges:
            inner, outer = (norm.inverses[edge.source] for norm in (self._norm, self._wide))
            rest = self._between_instants(edge, self._rest[None, :], (self._r, inner), (self._small, outer))
            states = self._states[edge.source]
            errors = np.abs(states @ edge.rows.T + edge.errors).max(axis=1) + _between(edge, states)
            bend = self._between_instants(edge, states, (self._r, inner))
            largest = max(largest, self.reached + added + rest, float(np.max(errors)) + added + bend)
        return largest

    def bound_without_hull(self) -> float:
        """Return the bound by the quadratic functions alone: a state so near to rest at first remains so."""
        bounds = []
        for norm, spread in ((self._norm, self._spread), (self._wide, self._wide_spread)):
            starts = self._starts - self._rest
            size = max(float(np.linalg.norm(starts @ T.T, axis=1).max()) for T in norm.T)
            size += self._start_bend(norm)
            bends = [
                self._between_instants(edge, self._rest[None, :], (size, norm.inverses[edge.source]))
                for edge in self._edges
            ]
            bounds.append(self._rest_error + spread * size + max(bends))
        return min(bounds)

    def _between_instants(self, edge: LoadedSteps, states: Array, *near: tuple[float, Array]) -> float:
        """Return how far the error may depart from its chords where a period begins near one of ``states``.

        ``near``: sizes of what is added to it, and the inverses of T in which they are measured.
        """
        n = len(self._loop.model.A)
        x = np.abs(states[:, :n]).max(axis=0)
        held = np.abs(states @ edge.inputs.T).max(axis=0)
        for size, inverse in near:
            x = x + size * np.linalg.norm(inverse[:n], axis=1)
            held = held + size * np.linalg.norm(edge.inputs @ inverse, axis=1)
        return between_instants(self._loop, x, float(np.max(held)), self._instants)

    def _stepped(self, number: int, states: Array) -> tuple[Array, Array]:
        """Return the corners' images of ``states``, and how far from a hull each may lie and be left out.

        Each state is stepped through the fewest corners that leave half of that.
        """
        allowed_max = (1.0 - self._norm.rho) * self._r
        came: list[Array] = []
        allowed: list[Array] = []
        for level, edges in enumerate(self._levels):
            edge = edges[number]
            sizes = np.linalg.norm(self._norm.T[edge.target], axis=0)[: edge.bends.shape[1]]
            left = allowed_max - np.abs(states @ edge.differences.T) @ (edge.bends @ sizes)
            here = left >= 0.5 * allowed_max
            if level == len(self._levels) - 1:
                here[:] = True
            own = states[here]
            if len(own):
                errors = np.abs(own @ edge.rows.T + edge.errors)
                self.reached = max(self.reached, float(np.max(errors)))
                stepped = np.einsum("cij,sj->csi", edge.M, own) + edge.m[:, None, :]
                came.append(stepped.reshape(-1, states.shape[1]))
                allowed.append(np.tile(left[here], len(edge.M)))
            states = states[~here]
        return np.vstack(came), np.concatenate(allowed)

    def _taken_in(self, node: int, states: Array, allowed: Array) -> Array:
        """Return the ``states`` added to S_node: the ones farthest from rest first."""
        T, wide = self._norm.T[node], self._wide.T[node]
        distance = np.linalg.norm((states - self._rest) @ wide.T, axis=1)
        matter = distance > self._small
        if not len(self._states[node]):
            matter[:] = True
        order = np.argsort(-distance, kind="stable")
        taken: list[Array] = []
        inverse = self._norm.inverses[node]
        hull = GrowingHull((self._states[node] - self._rest) @ T.T, wide @ inverse, self._small)
        for place in order[matter[order]]:
            self.compared += hull.count
            if self.compared > _HELD_MAX:
                break
            turned = T @ (states[place] - self._rest)
            if hull.is_near(turned, float(allowed[place])):
                continue
            hull.add(turned)
            taken.append(states[place])
        inside = np.array(taken).reshape(-1, states.shape[1])
        self._states[node] = np.vstack([self._states[node], inside])
        return inside

    def _spread_of(self, norm: _Norm) -> float:
        """Return how much a state of size 1 may add to the error at any of the instants."""
        spread = norm.spread
        for edge in self._edges:
            inverse = norm.inverses[edge.source]
            sizes = np.linalg.norm(edge.differences @ inverse, axis=1)
            largest = np.linalg.norm(edge.rows @ inverse, axis=1).max() + edge.output_bends @ sizes
            spread = max(spread, float(largest))
        return spread

    def _start_bend(self, norm: _Norm) -> float:
        """Return how far the first states depart from the chords between the evaluated ones."""
        width = self._loop.network.period_s / _START_PARTS
        bend = width**2 / 8.0 * start_curvature(self._loop.model, self._loop.network.period_s)
        return max(float(np.linalg.norm(T, axis=0)[: len(bend)] @ bend) for T in norm.T)


def _between(edge: LoadedSteps, states: Array) -> Array:
    """Return how much the instants between the corners may add to the error of each state."""
    return np.asarray(np.abs(states @ edge.differences.T) @ edge.output_bends)
