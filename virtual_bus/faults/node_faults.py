"""When what befalls a node: drawn from a plan, or out of a recorded run."""

from collections.abc import Iterator
from functools import partial
from heapq import merge

from servobench.drivers.timebase import NEVER, Duration
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_log import FRAME_KINDS
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.fault_streams import uniform_stream
from servobench.virtual_bus.faults.node_fault import NodeEvent, NodeFault, Slowness
from servobench.virtual_bus.faults.register import LOG_KINDS, TABLE_OF


class Events:
    """Events in order of time, one ahead."""

    def __init__(self, events: Iterator[NodeEvent]) -> None:
        self._events = events
        self._next = next(events, None)

    def next_at(self) -> int:
        """When the next one strikes, ns after time zero; NEVER if none does."""
        return NEVER if self._next is None else self._next.at_ns

    def take(self) -> NodeEvent:
        """That one, and go on to the one after it."""
        event = self._next
        assert event is not None
        self._next = next(self._events, None)
        return event


class DrawnNode(Events):
    """The faults that ``plan`` has for ``node``, each with a random stream of its own."""

    def __init__(self, plan: FaultPlan, node: int, seed: int, link: str = "bus") -> None:
        mine = [fault for fault in plan.node_faults if not fault.nodes or node in fault.nodes]
        slow: list[Slowness | None] = []
        events: list[Iterator[NodeEvent]] = []
        for index, fault in enumerate(mine):
            place = sum(other.stream_name == fault.stream_name for other in mine[:index])
            stem = f"{link}/node {node}/{fault.stream_name}/{place}"
            streams = partial(uniform_stream, seed, stem)
            events.append(fault.events(streams))
            slow.append(fault.slowness(streams))
        super().__init__(merge(*events, key=lambda event: event.at_ns))
        self._slow = [one for one in slow if one is not None]
        self.from_power_on = [each for fault in mine if (each := fault.from_power_on()) is not None]
        """Faults from power-on."""
        self.needs_drive = next((fault.kind for fault in mine if fault.needs_drive), "")
        """A kind that may strike and needs a device with a motor inside; empty: none."""

    @property
    def idle(self) -> bool:
        """Nothing ever befalls this node."""
        return self._next is None and not (self._slow or self.from_power_on)

    def lateness(self, can_id: int) -> Duration:
        """For how long the node, a slow one, keeps its next frame with ``can_id`` back."""
        return Duration(sum(one.lateness(can_id) for one in self._slow))

    def boot_time(self) -> Duration:
        """How long its next boot takes."""
        return Duration(sum(one.boot_time() for one in self._slow))


class ReplayedNode(Events):
    """Faults of ``node`` in a recorded run."""

    def __init__(self, recorded: RecordedFaults, node: int) -> None:
        mine = [entry for entry in recorded.entries if entry.link == node and entry.kind not in FRAME_KINDS]
        self._late = {(entry.can_id, entry.n): entry.a for entry in mine if entry.kind == "late"}
        self._boots = {entry.n: entry.a for entry in mine if entry.kind == "boot"}
        events = [
            NodeEvent(entry.at_ns, entry.kind, entry.a, entry.b, entry.c)
            for entry in mine
            if not LOG_KINDS[entry.code].since_power_on
        ]
        super().__init__(iter(sorted(events, key=lambda event: event.at_ns)))
        self.from_power_on = [
            NodeEvent(0, entry.kind, entry.a, entry.b, entry.c)
            for entry in mine
            if LOG_KINDS[entry.code].since_power_on and entry.kind not in ("late", "boot")
        ]
        """Faults from power-on; see :class:`DrawnNode`."""
        self._frames: dict[int, int] = {}
        self._booted = 0
        self.needs_drive = next((each.kind for each in events if node_kind(each.kind).needs_drive), "")
        """The first kind that needs a drive; see :class:`DrawnNode`."""

    @property
    def idle(self) -> bool:
        """Nothing ever befalls this node."""
        return self._next is None and not (self._late or self._boots or self.from_power_on)

    def lateness(self, can_id: int) -> Duration:
        """Return the lateness; see :class:`DrawnNode`."""
        n = self._frames.get(can_id, 0)
        self._frames[can_id] = n + 1
        return Duration(self._late.get((can_id, n), 0))

    def boot_time(self) -> Duration:
        """Return the boot time; see :class:`DrawnNode`."""
        self._booted += 1
        return Duration(self._boots.get(self._booted - 1, 0))


NodeSource = DrawnNode | ReplayedNode
"""Tells one node's fate."""


def node_source(faults: FaultPlan | RecordedFaults, node: int, seed: int) -> NodeSource | None:
    """Return the fault source of ``node``; None if it has none."""
    source = DrawnNode(faults, node, seed) if isinstance(faults, FaultPlan) else ReplayedNode(faults, node)
    return None if source.idle else source


def node_kind(kind: str) -> type[NodeFault]:
    """Return the fault class with events of that kind."""
    table = TABLE_OF[kind]
    assert issubclass(table, NodeFault)
    return table
