"""When what befalls a node: drawn from a plan, or out of a recorded run."""

import math
from collections.abc import Callable
from heapq import heapify, heappop, heappush
from typing import NamedTuple, Protocol

from drivers.timebase import NS_PER_S, Duration
from virtual_bus.faults.fault_log import FRAME_KINDS, NONE
from virtual_bus.faults.fault_plan import COB_IDS, FaultPlan, FrameClass
from virtual_bus.faults.fault_streams import uniform_stream
from virtual_bus.faults.node_fault_plan import (
    BusOff,
    ClockDrift,
    DriveFailure,
    DriveFault,
    EventFault,
    NodeFault,
    Occasion,
    Range,
    Silence,
    SlowDrive,
)
from virtual_bus.faults.replay import RecordedFaults

NEVER = 2**63 - 1
NODE_FAILS = DriveFault.kind
_FAILURES = list(DriveFailure)
_HELD_CLASSES = (FrameClass.SDO, FrameClass.PDO)


class NodeEvent(NamedTuple):
    """Something strikes a node; its numbers are those of an entry of the fault log."""

    at_ns: int
    """Since the plan's time zero."""
    kind: str
    a: int
    b: int = 0
    c: int = 0


class NodeSource(Protocol):
    """Tells one node's fate."""

    def next_at(self) -> int:
        """When the next event strikes, ns after time zero; NEVER if none does."""
        ...

    def take(self) -> NodeEvent:
        """That event, and go on to the one after it."""
        ...

    def lateness(self, can_id: int) -> Duration:
        """For how long the node, a slow one, keeps its next frame with ``can_id`` back."""
        ...

    def boot_time(self) -> Duration:
        """How long its next boot takes."""
        ...


class DrawnNode:
    """The faults that ``plan`` has for ``node``, each with a random stream of its own."""

    def __init__(self, plan: FaultPlan, node: int, seed: int, link: str = "bus") -> None:
        mine = [fault for fault in plan.node_faults if not fault.nodes or node in fault.nodes]
        self._events: list[tuple[int, int, NodeEvent | None]] = []
        self._chances: list[tuple[EventFault, Callable[[], float]]] = []
        self._slow: list[tuple[SlowDrive, tuple[Callable[[], float], ...]]] = []
        name = f"{link}/node {node}"
        for place, fault in enumerate(mine):
            stem = f"{name}/{_label(fault)}/{_place(mine[:place], fault)}"
            self._add(fault, seed, stem)
        heapify(self._events)

    @property
    def idle(self) -> bool:
        """Nothing ever befalls this node."""
        return not self._events and not self._slow

    @property
    def fails(self) -> bool:
        """Whether faults of a drive may strike."""
        return any(isinstance(fault, DriveFault) for fault, _ in self._chances)

    def _add(self, fault: NodeFault, seed: int, stem: str) -> None:
        if isinstance(fault, SlowDrive):
            streams = tuple(uniform_stream(seed, f"{stem}/{part}") for part in ("sdo", "tpdo", "boot"))
            self._slow.append((fault, streams))
        elif isinstance(fault, ClockDrift):
            self._schedule(NodeEvent(fault.from_ns, fault.kind, fault.drift_ppb))
            if fault.until_ns is not None:
                self._schedule(NodeEvent(fault.until_ns, fault.kind, -fault.drift_ppb))
        else:
            self._chances.append((fault, uniform_stream(seed, stem)))
            self._draw(len(self._chances) - 1, fault.occasion.from_ns)

    def _schedule(self, event: NodeEvent) -> None:
        self._events.append((event.at_ns, -1 - len(self._events), event))

    def _draw(self, index: int, since_ns: int) -> None:
        fault, draw = self._chances[index]
        at_ns = next_strike(fault.occasion, since_ns, draw)
        if at_ns is not None:
            heappush(self._events, (at_ns, index, None))

    def next_at(self) -> int:
        """See :class:`NodeSource`."""
        return self._events[0][0] if self._events else NEVER

    def take(self) -> NodeEvent:
        """See :class:`NodeSource`."""
        at_ns, index, event = heappop(self._events)
        if event is not None:
            return event
        fault, draw = self._chances[index]
        event = _event(fault, at_ns, draw)
        if fault.occasion.at_ns is None:
            self._draw(index, at_ns)
        return event

    def lateness(self, can_id: int) -> Duration:
        """See :class:`NodeSource`."""
        held = 0
        for fault, streams in self._slow:
            for part, frames, stream in zip((fault.sdo, fault.tpdo), _HELD_CLASSES, streams, strict=False):
                if can_id in COB_IDS[frames]:
                    held += drawn(part, stream)
        return Duration(held)

    def boot_time(self) -> Duration:
        """See :class:`NodeSource`."""
        return Duration(sum(drawn(fault.boot, streams[2]) for fault, streams in self._slow))


def next_strike(occasion: Occasion, since_ns: int, draw: Callable[[], float]) -> int | None:
    """The next instant after ``since_ns`` (ns); None if there is none in the window."""
    if occasion.at_ns is not None:
        return occasion.at_ns
    if occasion.every_ns is not None:
        return _within(occasion, since_ns + occasion.every_ns)
    rate_per_s = -math.log1p(-occasion.probability_per_s)
    gap_s = -math.log1p(-draw()) / rate_per_s
    return _within(occasion, since_ns + max(1, round(gap_s * 1e6) * (NS_PER_S // 1_000_000)))


def _within(occasion: Occasion, at_ns: int) -> int | None:
    return None if occasion.until_ns is not None and at_ns >= occasion.until_ns else at_ns


def _event(fault: EventFault, at_ns: int, draw: Callable[[], float]) -> NodeEvent:
    if isinstance(fault, Silence):
        return NodeEvent(at_ns, fault.kind, fault.lasts_ns)
    if isinstance(fault, BusOff):
        return NodeEvent(
            at_ns, fault.kind, NONE if fault.recover_after_ns is None else fault.recover_after_ns
        )
    if isinstance(fault, DriveFault):
        place = _FAILURES.index(fault.failure)
        return NodeEvent(at_ns, fault.kind, place, fault.detected_after_ns, fault.lasts_ns)
    return NodeEvent(at_ns, fault.kind, drawn(Range(fault.min_ns, fault.max_ns), draw))


def drawn(part: Range, draw: Callable[[], float]) -> int:
    """A time out of ``part``, ns."""
    if part.max_ns == part.min_ns:
        return part.min_ns
    return part.min_ns + int(draw() * (part.max_ns - part.min_ns + 1))


def _label(fault: NodeFault) -> str:
    """Each kind of drive fault counts for itself: one more over-current shifts no under-voltage."""
    return f"{fault.kind} {fault.failure.label}" if isinstance(fault, DriveFault) else fault.kind


def _place(before: list[NodeFault], fault: NodeFault) -> int:
    return sum(_label(other) == _label(fault) for other in before)


class ReplayedNode:
    """What befell ``node`` in a recorded run."""

    def __init__(self, recorded: RecordedFaults, node: int) -> None:
        mine = [item for item in recorded.entries if item.link == node and item.kind not in FRAME_KINDS]
        self._events: list[tuple[int, int, NodeEvent]] = []
        self._late: dict[tuple[int, int], int] = {}
        self._boots: dict[int, int] = {}
        for order, item in enumerate(mine):
            if item.kind == "late":
                self._late[item.can_id, item.n] = item.a
            elif item.kind == "boot":
                self._boots[item.n] = item.a
            else:
                event = NodeEvent(item.at_ns, item.kind, item.a, item.b, item.c)
                self._events.append((item.at_ns, order, event))
        heapify(self._events)
        self._frames: dict[int, int] = {}
        self._booted = 0

    @property
    def idle(self) -> bool:
        """Nothing ever befalls this node."""
        return not (self._events or self._late or self._boots)

    @property
    def fails(self) -> bool:
        """Whether faults of a drive strike."""
        return any(event.kind == DriveFault.kind for _, _, event in self._events)

    def next_at(self) -> int:
        """See :class:`NodeSource`."""
        return self._events[0][0] if self._events else NEVER

    def take(self) -> NodeEvent:
        """See :class:`NodeSource`."""
        return heappop(self._events)[2]

    def lateness(self, can_id: int) -> Duration:
        """See :class:`NodeSource`."""
        n = self._frames.get(can_id, 0)
        self._frames[can_id] = n + 1
        return Duration(self._late.get((can_id, n), 0))

    def boot_time(self) -> Duration:
        """See :class:`NodeSource`."""
        self._booted += 1
        return Duration(self._boots.get(self._booted - 1, 0))


def node_source(faults: FaultPlan | RecordedFaults, node: int, seed: int) -> DrawnNode | ReplayedNode | None:
    """What befalls ``node``; None if nothing ever does."""
    source = DrawnNode(faults, node, seed) if isinstance(faults, FaultPlan) else ReplayedNode(faults, node)
    return None if source.idle else source
