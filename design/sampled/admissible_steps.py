"""The effects of a network on a sampled loop, as walks of a graph whose edges take one period each.

The nodes define the possible next steps. With ``arrival``, node i means: the acting sample was taken i + 1
periods ago. The sample acting at a time t is some s(t) that never goes back; any such s is possible that

    is at most T old when it begins to act, and at least floor((t - T)/h) - D,

because one of D + 1 samples in a row comes, and later than t only if it was taken after t - T. With
``stamp``, node i means: i samples in a row were lost. With ``history`` there is one node.

A family of steps leaves the instants of its switchings open, each within its window and none before that of
an older sample. It includes overtaken samples: they act for no time.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from servobench.design.sampled.held_loop import PeriodStep, SampledNetwork, Strategy, Switch, periods_of


@dataclass(frozen=True, slots=True)
class Window:
    """The interval in which the sample of ``back`` periods ago may begin to act, s after the period's
    begin."""

    back: int
    first_s: float
    last_s: float
    to_end: bool = False
    """True if it lasts to the period's end: where periods are uneven, beyond the shortest."""


@dataclass(frozen=True, slots=True)
class Family:
    """Steps from node to node."""

    source: int
    target: int
    windows: tuple[Window, ...]

    def over(self, parts: Sequence[float]) -> Iterator[PeriodStep]:
        """Yield the steps whose switchings are at these parts of their windows, in every admissible order."""
        tried = [
            sorted({window.first_s + part * (window.last_s - window.first_s) for part in parts})
            for window in self.windows
        ]
        for times_s in itertools.product(*tried):
            if all(earlier <= later for earlier, later in itertools.pairwise(times_s)):
                yield self.at(times_s)

    def at(self, times_s: Sequence[float], longer_s: float = 0.0) -> PeriodStep:
        """Return the step whose switchings are at ``times_s``; see :class:`PeriodStep`."""
        switches = [Switch(window.back, time_s) for window, time_s in zip(self.windows, times_s, strict=True)]
        return PeriodStep(self.source, self.target, tuple(switches), longer_s)


def node_count(network: SampledNetwork) -> int:
    """Return the number of nodes of the graph."""
    if network.strategy is Strategy.HISTORY:
        return 1
    return network.losses_max + 1 + (network.behind if network.strategy is Strategy.ARRIVAL else 0)


def delivery_node_count(network: SampledNetwork) -> int:
    """Return the number of nodes at which a sample has just begun to act."""
    return network.behind + 1 if network.strategy is Strategy.ARRIVAL else 1


def families(network: SampledNetwork) -> list[Family]:
    """Return every step that the network admits."""
    if network.strategy is Strategy.ARRIVAL:
        by_node = [_arrivals(network, node) for node in range(node_count(network))]
        return list(itertools.chain.from_iterable(by_node))
    comes = (Window(network.behind, network.offset_s, network.offset_s),)
    nodes = node_count(network)
    return [Family(node, 0, comes) for node in range(nodes)] + [
        Family(node, node + 1, ()) for node in range(nodes - 1)
    ]


def _arrivals(network: SampledNetwork, node: int) -> Iterator[Family]:
    """Yield the edges out of ``node``: for each sample that finally acts, all in between as steps on the
    way."""
    behind, h = network.behind, network.shortest_s
    forced = node == node_count(network) - 1
    if not forced:
        yield Family(node, node + 1, ())
    windows = []
    for back in range(min(node, behind), -1, -1):
        windows.append(Window(back, 0.0, network.offset_s if back == behind else h, back != behind))
    for count in range(1, len(windows) + 1):
        chosen = windows[:count]
        yield Family(node, chosen[-1].back, tuple(chosen))
        # the oldest may be lost, and the next come after the oldest's last moment
        if count > 1 and chosen[0].back == behind and not forced and network.offset_s < h:
            yield Family(node, chosen[-1].back, tuple(chosen[1:]))


@dataclass(frozen=True, slots=True)
class Delivery:
    """A sample that acted ``delay_s`` after it was taken; the next is ``interval`` periods younger."""

    interval: int
    delay_s: float


def steps_of(network: SampledNetwork, deliveries: Sequence[Delivery]) -> tuple[PeriodStep, ...]:
    """Return the periods of a pattern of deliveries repeated for ever; overtaken samples are dropped."""
    total = sum(delivery.interval for delivery in deliveries)
    rounds = 2 + (network.behind + total) // total
    began: list[tuple[int, float, int]] = []
    taken = 0
    for delivery in [*deliveries] * (2 * rounds):
        if network.strategy is Strategy.ARRIVAL:
            back, at_s = periods_of(delivery.delay_s, network.period_s)
        else:
            back, at_s = network.behind, network.offset_s
        began.append((taken + back, at_s, taken))
        taken += delivery.interval
    return tuple(_periods(network, began, rounds * total, total))


def _periods(
    network: SampledNetwork, began: list[tuple[int, float, int]], first: int, count: int
) -> Iterator[PeriodStep]:
    """Yield ``count`` periods from ``first`` of what ``began`` to act: (period, time in it, sample), in any
    order."""
    newest = -(10**9)
    by_period: dict[int, list[Switch]] = {}
    acting: dict[int, int] = {}
    for period, at_s, sample in sorted(began):
        if sample > newest:
            newest = sample
            by_period.setdefault(period, []).append(Switch(period - sample, at_s))
            acting[period] = sample
    source = _node_at(network, acting, first)
    for period in range(first, first + count):
        target = _node_at(network, acting, period + 1)
        yield PeriodStep(source, target, tuple(by_period.get(period, ())))
        source = target


def _node_at(network: SampledNetwork, acting: dict[int, int], period: int) -> int:
    """Return the node at the begin of ``period``."""
    sample = max(value for when, value in acting.items() if when < period)
    if network.strategy is Strategy.HISTORY:
        return 0
    behind = 0 if network.strategy is Strategy.ARRIVAL else network.behind
    return period - 1 - sample - behind


def deliveries_of(network: SampledNetwork, steps: Iterable[PeriodStep]) -> tuple[Delivery, ...]:
    """Return the deliveries of a pattern of periods repeated for ever."""
    steps = list(steps)
    acted: list[tuple[int, float]] = []
    for period, step in enumerate(steps):
        for number, switch in enumerate(step.switches):
            overtaken = number + 1 < len(step.switches) and step.switches[number + 1].at_s <= switch.at_s
            if not overtaken:
                acted.append((period - switch.back, switch.back * network.period_s + switch.at_s))
    after = [sample for sample, _ in acted[1:]] + [acted[0][0] + len(steps)]
    return tuple(
        Delivery(following - sample, delay_s)
        for (sample, delay_s), following in zip(acted, after, strict=True)
    )
