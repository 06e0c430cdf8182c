"""The slowest decay over every walk of a graph: norms of its nodes, and where they are loose a tree of
products.

In norms |T_i xi| of the nodes a walk w of n periods from i to j leaves at most |T_j M_w T_i^{-1}| of a size.
If every walk has a beginning that leaves at most r^n, every walk falls apart into such beginnings, and the
loop decays at -log r a period (Gripenberg, Linear Algebra and its Applications 234, 1996). The tree follows
the walks until they do. A closed walk that is repeated for ever decays at its spectral radius: that is found.
"""

import math
import operator
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.lmi import LmiProblem, MatrixInequality, Unknowns, last_answer
from servobench.design.sampled.falling_norms import NormedEdge, coordinates, left_by
from servobench.design.sampled.peak_steps import covered
from servobench.design.sampled.taylor_map import control_points, products

CLOSENESS = 0.045
"""Share of the found decay that may be given away: a quarter less takes twice as many walks."""
_PARTS = (0.99, 0.95, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2, 0.1, 0.0)
"""Shares of the decay found that norms are asked for, until they leave less no more."""
_WALKS_MAX = 200_000
"""Periods of walks followed; with H-infinity and single losses 20 000 suffice."""
_ALIVE_MAX = 20_000
_BEAM, _BEAM_LENGTH = 100, 16
"""Walks kept of each length, and the longest, of the search before norms are known."""
_CROWDED = 2000
"""Walks of which those near each other are merged."""
_MERGED = 0.02
"""Share of the size aimed at to which that may widen them."""
_POSED_MAX, _POSED_LENGTH = 40, 4
"""Walks that the solver is given at most, and periods of each: where nothing is left out of their maps norms
need not contract in every period."""
_WORSE = 2
"""Norms in a row that leave more than the best, after which no others are tried."""
_TOLERANCE, _ROUNDING = 1e-8, 1e-9


class FollowedWalks(NamedTuple):
    """Walks so far, (N, ..) each."""

    start: NDArray[np.intp]
    node: NDArray[np.intp]
    product: Array
    """(N, m + 1, k, k): coefficients of what they make of xi, in the norms' coordinates."""
    radius: Array
    """What these leave out, at most."""
    least: Array
    """Smallest share of a size left in a period, over their beginnings."""
    memory: Array
    """(N, q): what the controller knows of the past, if its node does not tell."""
    letters: NDArray[np.intp]
    """(N, periods)."""

    def part(self, which: NDArray[np.intp]) -> "FollowedWalks":
        """Return some of them."""
        return FollowedWalks(*map(operator.itemgetter(which), self))


class Continued(NamedTuple):
    """Some walks, each with one more period."""

    rows: NDArray[np.intp]
    target: int
    maps: Array
    """(m + 1, N or 1, k, k), in the norms' coordinates."""
    left: float
    """What the period leaves of a size, at most."""
    unsure: float
    """Part of that by which it may differ from ``maps``."""
    wider: Array | float
    """(N,): the same of these products alone."""
    memory: Array
    letter: int


class WalkedGraph(Protocol):
    """The periods."""

    nodes: int
    order: int
    """Of the polynomials."""

    def begun(self) -> list[tuple[int, Array]]:
        """Return the nodes at which a walk may begin, each with (N, q) memories."""

    def continued(self, walks: FollowedWalks, T: Array, inverse: Array) -> Iterator[Continued]:
        """Yield every period of each."""

    def radius(self, letters: Sequence[int]) -> float:
        """Return the largest spectral radius of a period, of the loop that repeats ``letters``; exact."""


class DecayBound(NamedTuple):
    """Shares of a size that a period leaves."""

    certified: float
    found: float


def joined(parts: Sequence[FollowedWalks]) -> FollowedWalks:
    """Return all of them as one."""
    return FollowedWalks(*map(np.concatenate, zip(*parts, strict=True)))


def slowest_walk(graph: WalkedGraph, edges: Sequence[NormedEdge]) -> float:
    """Return the share that the slowest closed walk found leaves in a period."""
    T = coordinates(edges, graph.nodes)
    if T is None:
        return math.inf
    return _followed(graph, T, 0.0, 0.0, _BEAM).found


def contracting_norms(edges: Sequence[NormedEdge], nodes: int, found: float) -> tuple[Array, float] | None:
    """Return T (nodes, k, k) that leave least of all tried, and how much a period leaves; None: none are
    found.

    ``found``: the share that a walk is known to leave.
    """
    L = coordinates(edges, nodes)
    if L is None:
        return None
    best: tuple[Array, float] | None = None
    posed, least, worse = _posed(edges), 1.0, 0
    for part in _PARTS:
        T = _norms(posed, nodes, L, found**-part)
        if T is not None:
            inverse = np.linalg.inv(T)
            each = (
                float(_sizes(T[target] @ M @ inverse[source]).max()) ** (1.0 / length)
                for length, source, target, M in posed
            )
            left = max(each) + _ROUNDING
            worse += best is not None and left >= least
            if left < least:
                best, least, worse = (T, max(left_by(edge, T) for edge in edges)), left, 0
        if worse == _WORSE:
            break
    return best


def _posed(edges: Sequence[NormedEdge]) -> list[tuple[int, int, int, Array]]:
    """Return walks, as long as there are not too many: periods, begin, end, and their maps (N, k, k)."""
    single = [(1, edge.source, edge.target, (1.0 + edge.room) * edge.M) for edge in edges if edge.posed]
    walks, variants = single, {len(M) for _, _, _, M in single}
    exact = not any(edge.room for edge in edges)
    while exact and variants == {1}:
        longer = [
            (length + 1, source, beyond, step @ M)
            for length, source, target, M in walks
            for _, begin, beyond, step in single
            if begin == target
        ]
        if len(longer) > _POSED_MAX:
            break
        walks = longer
        if walks[0][0] == _POSED_LENGTH:
            break
    return walks


def bounded_decay(graph: WalkedGraph, norms: tuple[Array, float], found: float, goal: float) -> DecayBound:
    """Return what every walk leaves in a period, and what some leave.

    ``found``: known to be left; ``goal``: what suffices.
    """
    T, left = norms
    if left <= goal:
        return DecayBound(left, found)
    bound = _followed(graph, T, found, goal, None)
    return DecayBound(min(left, bound.certified), bound.found)


def _norms(posed: Sequence[tuple[int, int, int, Array]], nodes: int, L: Array, growth: float) -> Array | None:
    """Return T with the largest margin in P_i >= growth^(2 n) M' P_j M for walks of n periods; None: the
    solver has none."""
    inverse, k = np.linalg.inv(L), L.shape[1]
    unknowns = Unknowns()
    for node in range(nodes):
        unknowns.symmetric(f"P{node}", k)
    unknowns.symmetric("objective", 1)
    inequalities = [MatrixInequality.positive(unknowns, f"P{node}") for node in range(nodes)]
    for length, source, target, maps in posed:
        for M in maps:
            turned = growth**length * L[target] @ M @ inverse[source]
            falls = MatrixInequality.positive(unknowns, f"P{source}")
            falls.add_form(unknowns, f"P{target}", turned.T, -1.0)
            inequalities.append(falls)
    for inequality in inequalities:
        inequality.coefficients[-1] += np.eye(k)
    size = MatrixInequality(np.full((1, 1), float(k * nodes)), np.zeros((unknowns.count, 1, 1)))
    for node in range(nodes):
        trace = np.trace(unknowns.basis(f"P{node}"), axis1=1, axis2=2)
        size.coefficients[unknowns.slice_of(f"P{node}"), 0, 0] -= trace
    problem = LmiProblem("norms that contract", unknowns, [*inequalities, size], unknowns.last)
    y = last_answer(problem, _TOLERANCE)
    if y is None:
        return None
    try:
        return np.array([cholesky(unknowns.value(f"P{node}", y)) for node in range(nodes)]) @ L
    except np.linalg.LinAlgError:
        return None


def _followed(graph: WalkedGraph, T: Array, found: float, goal: float, beam: int | None) -> DecayBound:
    """Follow every walk until it leaves at most ``goal`` a period; with a ``beam`` only the slowest, to find
    one."""
    inverse = np.asarray(np.linalg.inv(T), dtype=np.float64)
    walks = _begun(graph, T.shape[1])
    sizes, done, count = np.ones(len(walks.start)), 0.0, 0
    points = control_points(graph.order)
    for length in range(1, _BEAM_LENGTH + 1 if beam else _WALKS_MAX):
        walks, sizes = _longer(graph, walks, sizes, points, T, inverse)
        count += len(sizes)
        share, letters = _slowest_closed(walks, length)
        if share > found:
            found = max(found, graph.radius(letters))
        if beam:
            walks = walks._replace(radius=np.zeros_like(sizes))
            order = np.argsort(-sizes, kind="stable")[:beam]
            walks, sizes = walks.part(order), np.asarray(sizes[order])
            continue
        if found >= 1.0:
            break
        goal = max(goal, found ** (1.0 - CLOSENESS))
        shares = (sizes + walks.radius) ** (1.0 / length)
        walks = walks._replace(least=np.minimum(walks.least, shares))
        alive = np.flatnonzero(walks.least > goal)
        done = max(done, float(np.delete(walks.least, alive).max(initial=0.0)))
        walks, sizes = walks.part(alive), sizes[alive]
        if len(alive) > _CROWDED:
            kept, radii = _merged(walks, points, _MERGED * goal**length)
            walks, sizes = walks._replace(radius=radii).part(kept), sizes[kept]
        if not len(alive) or len(alive) > _ALIVE_MAX or count > _WALKS_MAX:
            break
    return DecayBound(max(done, float(walks.least.max(initial=0.0))), found)


def _begun(graph: WalkedGraph, k: int) -> FollowedWalks:
    parts = []
    for node, memory in graph.begun():
        count = len(memory)
        nodes = np.full(count, node)
        product = np.zeros((count, graph.order + 1, k, k))
        product[:, 0] = np.eye(k)
        none = np.zeros((count, 0), dtype=np.intp)
        parts.append(
            FollowedWalks(nodes, nodes, product, np.zeros(count), np.full(count, math.inf), memory, none)
        )
    return joined(parts)


def _longer(
    graph: WalkedGraph, walks: FollowedWalks, sizes: Array, points: Array, T: Array, inverse: Array
) -> tuple[FollowedWalks, Array]:
    """Return the walks with one more period, and what their products leave of a size."""
    parts = []
    for step in graph.continued(walks, T, inverse):
        before = walks.part(step.rows)
        later = products(step.maps, before.product.transpose(1, 0, 2, 3))
        radius = step.left * before.radius + step.unsure * sizes[step.rows] + step.wider
        for beyond in later[graph.order + 1 :]:
            radius = radius + _sizes(beyond)
        letters = np.column_stack([before.letters, np.full(len(step.rows), step.letter)])
        product = np.stack(later[: graph.order + 1], axis=1)
        nodes = np.full(len(step.rows), step.target)
        parts.append(FollowedWalks(before.start, nodes, product, radius, before.least, step.memory, letters))
    longer = joined(parts)
    return longer, _sizes(_hull(longer, points)).max(axis=1)


def _hull(walks: FollowedWalks, points: Array) -> Array:
    """Return the (N, m + 1, k, k) in whose hull the products of every inertia lie."""
    return np.asarray(np.einsum("ij,njkl->nikl", points, walks.product))


def _sizes(matrices: Array) -> Array:
    """Return the largest singular values of (.., k, k), from squares: faster, and no smaller than they
    are."""
    squares = np.linalg.eigvalsh(np.swapaxes(matrices, -1, -2) @ matrices)[..., -1]
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)) * (1.0 + _ROUNDING))


def _merged(walks: FollowedWalks, points: Array, radius: float) -> tuple[NDArray[np.intp], Array]:
    """Return which walks to keep so that they stand for all: one takes in those around it, until it has this
    radius; and the radii of all."""
    keys = np.column_stack([walks.start, walks.node, walks.memory])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    hull = _hull(walks, points).reshape(len(walks.start), len(points), -1)
    kept, wider = [], walks.radius.copy()
    for number in range(int(group.max()) + 1):
        own = np.flatnonzero(group.ravel() == number)
        covers, radii = covered(hull[own], walks.radius[own], radius)
        kept.append(own[covers])
        wider[own[covers]] = radii
    return np.concatenate(kept), wider


def _slowest_closed(walks: FollowedWalks, length: int) -> tuple[float, tuple[int, ...]]:
    """Return the largest share left by a closed walk at either end of the range, nearly, and its letters."""
    closed = np.flatnonzero(walks.start == walks.node)
    if not len(closed):
        return 0.0, ()
    product = walks.product[closed]
    order = product.shape[1] - 1
    ends = np.vander([-1.0, 1.0] if order else [0.0], order + 1, increasing=True)
    radii = np.abs(np.linalg.eigvals(np.einsum("ej,njkl->nekl", ends, product))).max(axis=(1, 2))
    place = int(np.argmax(radii))
    return float(radii[place]) ** (1.0 / length), tuple(walks.letters[closed[place]].tolist())
