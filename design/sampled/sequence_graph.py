"""The graph of a certificate: nodes, and edges with the corners of every possible step.

A node may remember from which nodes the last deliveries came: then more is proved, with more unknowns. Nodes
at which nothing was delivered may be left out: the periods up to the next delivery are then one edge, which
proves no less, with fewer unknowns.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.admissible_steps import families, node_count
from servobench.design.sampled.held_loop import PeriodStep, SwitchedLoop
from servobench.design.sampled.step_maps import Corners, corners_of
from servobench.design.sampled.uneven_ends import with_ends

_EPSILON = 2e-5
"""epsilon of :mod:`servobench.design.sampled.step_maps`: the loss of a certificate, per period, between
corners."""
_BEND = 0.7 * _EPSILON
"""Bound of a bend where P is of size 1; its square over epsilon is of the order of epsilon."""
_EPSILON_OF_RATES = 5e-4
"""The same where the rate of the current loop lies between two."""
_EPSILON_OF_ENDS = 5e-4
"""The same where periods are uneven, of switchings as of ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """An edge of the graph with the corners of its steps."""

    source: int
    target: int
    corners: Corners
    loop: SwitchedLoop
    epsilon: float
    """epsilon of :mod:`servobench.design.sampled.step_maps`; without an open window nothing lies between the
    corners."""
    before: tuple[PeriodStep, ...] = ()
    """Periods without a delivery, before that of the corners."""
    ends_epsilon: float = 0.0
    """The same of the ends of uneven periods (:mod:`servobench.design.sampled.uneven_ends`)."""

    @property
    def spread(self) -> float:
        """Factor of a value that covers what lies between the corners."""
        return (1.0 + self.epsilon) * (1.0 + self.ends_epsilon)

    @property
    def periods(self) -> int:
        """Length in periods."""
        return len(self.before) + 1


def edges_of(
    loop: SwitchedLoop, coordinates: Array, remembered: int, other: SwitchedLoop | None = None
) -> tuple[int, list[Edge]]:
    """Return the number of nodes, and the edges.

    ``remembered``: of so many last deliveries nodes know from which node each came; ``other``: the loop with
    another rate of the current loop, for every rate between the two.
    """
    plain = []
    for family in families(loop.network):
        if loop.network.uneven_s:
            epsilon = _EPSILON_OF_ENDS
            corners = with_ends(
                loop, corners_of(loop, family, coordinates, 0.7 * epsilon), coordinates, epsilon
            )
            own = epsilon if corners.terms else 0.0
            plain.append(Edge(family.source, family.target, corners, loop, own, ends_epsilon=epsilon))
            continue
        if other is None:
            corners = corners_of(loop, family, coordinates, _BEND)
            plain.append(
                Edge(family.source, family.target, corners, loop, _EPSILON if corners.terms else 0.0)
            )
            continue
        for one, end in ((loop, other), (other, loop)):
            corners = corners_of(one, family, coordinates, _BEND).between_rates(one, end)
            plain.append(Edge(family.source, family.target, corners, one, _EPSILON_OF_RATES))
    count = node_count(loop.network)
    memories = count**remembered
    edges = []
    for edge in plain:
        for memory in range(memories):
            kept = (memory * count + edge.source) % memories if edge.corners.family.windows else memory
            source, target = edge.source + count * memory, edge.target + count * kept
            edges.append(replace(edge, source=source, target=target))
    return _reachable(count * memories, edges)


def between_deliveries(edges: list[Edge]) -> tuple[int, list[Edge]]:
    """Return the same graph with only the nodes at which a sample has just come: their number, and the
    edges."""
    nodes = sorted({edge.target for edge in edges if edge.corners.family.windows})
    number = {node: place for place, node in enumerate(nodes)}
    by_source: dict[int, list[Edge]] = {}
    for edge in edges:
        by_source.setdefault(edge.source, []).append(edge)
    return len(nodes), [
        replace(edge, source=number[node], target=number[edge.target])
        for node in nodes
        for edge in _until_delivery(by_source, node, ())
    ]


def _until_delivery(
    by_source: dict[int, list[Edge]], node: int, before: tuple[PeriodStep, ...]
) -> Iterator[Edge]:
    for edge in by_source[node]:
        if edge.corners.family.windows:
            yield replace(edge, before=before)
        else:
            yield from _until_delivery(by_source, edge.target, (*before, edge.corners.family.at(())))


def _reachable(count: int, edges: list[Edge]) -> tuple[int, list[Edge]]:
    """Remove the nodes to which no walk returns."""
    alive = set(range(count))
    while True:
        entered = {edge.target for edge in edges if edge.source in alive and edge.target in alive}
        if entered == alive:
            break
        alive = entered
    number = {node: place for place, node in enumerate(sorted(alive))}
    kept = [edge for edge in edges if edge.source in alive and edge.target in alive]
    return len(alive), [
        replace(edge, source=number[edge.source], target=number[edge.target]) for edge in kept
    ]
