"""What a bad day on the bus looks like: faults as values, each with the frames that it may strike.

A plan says nothing about chance: the seed belongs to :class:`.fault_injector.FaultInjector`.
A further kind of fault is one more class here, one more row in ``fault_plan_toml.py`` and one more
behaviour in ``fault_injector.py``. What befalls a node rather than its frames: :mod:`.node_fault_plan`.
"""

from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise
from typing import ClassVar, Literal

from drivers.canopen.nmt_states import NODE_ID_MAX
from drivers.errors import MISSING
from drivers.timebase import NS_PER_US, Duration
from virtual_bus.bus.judge import Direction as Direction
from virtual_bus.faults.node_fault_plan import (
    ClockDrift,
    HostStall,
    NodeFault,
    Occasion,
    SlowDrive,
)
from virtual_bus.faults.plan_checks import (
    DELAY_MAX,
    require,
    require_nodes,
    require_probability,
    require_window,
)

BROADCAST = 0
"""Stands for the node of a frame that belongs to no single one."""

STANDARD_ID_MAX = 0x7FF
EXTENDED_ID_MAX = 0x1FFF_FFFF
_AT_ONCE = Duration(0)
COUNT_MAX = 1 << 53
"""Of a bar of a histogram: as far as a float counts."""


Side = Literal["host", "drive"]
"""Whose connection to the bus: that of the host, or of a drive as through a gateway between bus and drive."""


class FrameClass(Enum):
    """What a frame is for, by its COB-ID in the pre-defined connection set (CiA 301 7.3.5)."""

    PDO = "pdo"
    SYNC = "sync"
    SDO = "sdo"
    EMCY = "emcy"
    HEARTBEAT = "heartbeat"
    NMT = "nmt"
    TIME = "time"
    LSS = "lss"
    ALL = "all"


COB_IDS: dict[FrameClass, range] = {
    FrameClass.NMT: range(0x001),
    FrameClass.SYNC: range(0x080, 0x081),
    FrameClass.EMCY: range(0x081, 0x100),
    FrameClass.TIME: range(0x100, 0x101),
    FrameClass.PDO: range(0x180, 0x580),
    FrameClass.SDO: range(0x580, 0x680),
    FrameClass.HEARTBEAT: range(0x700, 0x780),
    FrameClass.LSS: range(0x7E4, 0x7E6),
}
"""COB-IDs of each class; PDO 1..4 take the function codes 3..10."""

_OF_ONE_NODE = (FrameClass.EMCY, FrameClass.PDO, FrameClass.SDO, FrameClass.HEARTBEAT)


def node_of(can_id: int, extended: bool = False) -> int:
    """The node that a frame belongs to by its COB-ID; :data:`BROADCAST` if to none."""
    if extended or not any(can_id in COB_IDS[frames] for frames in _OF_ONE_NODE):
        return BROADCAST
    return can_id & NODE_ID_MAX


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """The frames that a fault may strike, and when."""

    directions: tuple[Direction, ...] = (Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST)
    frames: tuple[FrameClass | int, ...] = (FrameClass.PDO,)
    """Classes, or COB-IDs; a number above 7FFh means an extended frame."""
    nodes: tuple[int, ...] = ()
    """Only classes' frames of these nodes; empty: of all, and broadcasts too."""
    from_ns: Duration = _AT_ONCE
    """Since the plan's time zero."""
    until_ns: Duration | None = None
    """Exclusive; None: to the end."""
    side: Side | None = None
    """At whose connection; None: at that of the program that is given the plan. At a drive's, ``nodes`` are
    the drives, and frames that belong to no node are theirs too."""

    def __post_init__(self) -> None:
        require(bool(self.directions), "direction", self.directions, "at least one direction")
        require(bool(self.frames), "frames", list(self.frames), "at least one class of frames or COB-ID")
        for item in self.frames:
            known = isinstance(item, FrameClass) or 0 <= item <= EXTENDED_ID_MAX
            require(known, "frames", item, f"a COB-ID from 0 to {EXTENDED_ID_MAX:#x}")
        require_nodes(self.nodes)
        require_window(self.from_ns, self.until_ns)

    def selects(self, direction: Direction, can_id: int, extended: bool = False) -> bool:
        """Whether a frame is among those meant, at any time."""
        return direction in self.directions and any(
            self._names(item, can_id, extended) for item in self.frames
        )

    def _names(self, item: FrameClass | int, can_id: int, extended: bool) -> bool:
        if isinstance(item, int):
            return item == can_id and extended == (item > STANDARD_ID_MAX)
        if self.nodes:
            node = node_of(can_id, extended)
            if node not in self.nodes and not (node == BROADCAST and self.side == "drive"):
                return False
        return item is FrameClass.ALL or (not extended and can_id in COB_IDS[item])


@dataclass(frozen=True, slots=True, kw_only=True)
class IndependentLoss:
    """Each frame is lost with the same probability, whatever happened to the others."""

    kind: ClassVar[str] = "loss"
    selection: Selection = field(default_factory=Selection)
    probability: float

    def __post_init__(self) -> None:
        require_probability("probability", self.probability)


@dataclass(frozen=True, slots=True, kw_only=True)
class BurstLoss:
    """Losses in bursts: the chain of Gilbert (1960) and Elliott (1963) with two states.

    Each frame of a link first moves the chain (which begins good), then is lost with the
    probability of the state reached. With ``loss_bad`` 1 and ``loss_good`` 0 a burst has a
    geometric length of mean 1 / p_bad_to_good frames, and in the long run
    p_good_to_bad / (p_good_to_bad + p_bad_to_good) of the frames are lost.
    """

    kind: ClassVar[str] = "burst"
    selection: Selection = field(default_factory=Selection)
    p_good_to_bad: float
    p_bad_to_good: float
    loss_bad: float = 1.0
    loss_good: float = 0.0

    def __post_init__(self) -> None:
        for key in ("p_good_to_bad", "p_bad_to_good", "loss_bad", "loss_good"):
            require_probability(key, getattr(self, key))


@dataclass(frozen=True, slots=True, kw_only=True)
class PeriodicLoss:
    """Of every ``lost`` + 1 frames of a COB-ID the first passes and the others are lost."""

    kind: ClassVar[str] = "periodic_loss"
    selection: Selection = field(default_factory=Selection)
    lost: int

    def __post_init__(self) -> None:
        require(self.lost >= 1, "lost", self.lost, "a whole number >= 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Blackout:
    """Every frame is lost: throughout the selection's window, or the first ``count`` of each COB-ID in it.

    It needs one end of the two.
    """

    kind: ClassVar[str] = "blackout"
    selection: Selection
    count: int | None = None

    def __post_init__(self) -> None:
        ends = self.count is not None or self.selection.until_ns is not None
        require(ends, "duration_s", MISSING, "a duration, or until_s, or count: a blackout has an end")
        require(self.count is None or self.count >= 1, "count", self.count, "a whole number >= 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class UniformDelay:
    """A frame is held for a time drawn evenly from ``min_ns``..``max_ns``, both included.

    Frames of one link (one direction, one node) keep their order, which may hold one
    longer, unless ``reorder``. Several delays of a frame add up.
    """

    kind: ClassVar[str] = "delay"
    selection: Selection = field(default_factory=Selection)
    min_ns: Duration
    max_ns: Duration
    reorder: bool = False

    def __post_init__(self) -> None:
        longest = f"a delay from 0 to {DELAY_MAX // NS_PER_US} us"
        key = "delay_us" if self.min_ns == self.max_ns else "delay_min_us"
        require(0 <= self.min_ns <= DELAY_MAX, key, self.min_ns / NS_PER_US, longest)
        least = f"a delay from delay_min_us = {self.min_ns / NS_PER_US:g} to {DELAY_MAX // NS_PER_US} us"
        require(self.min_ns <= self.max_ns <= DELAY_MAX, "delay_max_us", self.max_ns / NS_PER_US, least)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredDelay:
    """A frame is held for a time drawn from a histogram: a bar by its count, evenly within the bar.

    ``edges_ns``: n + 1 rising times; ``counts``: n. Otherwise as :class:`UniformDelay`.
    """

    kind: ClassVar[str] = "measured_delay"
    selection: Selection = field(default_factory=Selection)
    edges_ns: tuple[Duration, ...]
    counts: tuple[int, ...]
    reorder: bool = False

    def __post_init__(self) -> None:
        edges, counts = self.edges_ns, self.counts
        rising = all(low < high for low, high in pairwise(edges))
        in_us = [edge / NS_PER_US for edge in edges]
        require(len(edges) >= 2 and rising, "edges_us", in_us, "at least two times, each above the last")
        longest = f"times from 0 to {DELAY_MAX // NS_PER_US} us"
        require(edges[0] >= 0 and edges[-1] <= DELAY_MAX, "edges_us", in_us, longest)
        expected = f"{len(edges) - 1} counts, one less than edges_us"
        require(len(counts) == len(edges) - 1, "counts", list(counts), expected)
        usable = all(0 <= count <= COUNT_MAX for count in counts) and sum(counts) > 0
        require(usable, "counts", list(counts), "whole numbers >= 0, not all of them 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reordering:
    """A frame is held back outside of its link's order, so that those behind it overtake it."""

    kind: ClassVar[str] = "reorder"
    selection: Selection = field(default_factory=Selection)
    probability: float
    min_ns: Duration
    max_ns: Duration

    def __post_init__(self) -> None:
        require_probability("probability", self.probability)
        key = "held_us" if self.min_ns == self.max_ns else "held_min_us"
        most = DELAY_MAX // NS_PER_US
        require(0 < self.min_ns <= DELAY_MAX, key, self.min_ns / NS_PER_US, f"a time > 0, at most {most} us")
        least = f"a time from held_min_us = {self.min_ns / NS_PER_US:g} to {most} us"
        require(self.min_ns <= self.max_ns <= DELAY_MAX, "held_max_us", self.max_ns / NS_PER_US, least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Duplication:
    """A frame comes twice: the second one ``later_ns`` after the first, outside of the link's order."""

    kind: ClassVar[str] = "duplicate"
    selection: Selection = field(default_factory=Selection)
    probability: float
    later_ns: Duration = _AT_ONCE

    def __post_init__(self) -> None:
        require_probability("probability", self.probability)
        longest = f"a time from 0 to {DELAY_MAX // NS_PER_US} us"
        require(0 <= self.later_ns <= DELAY_MAX, "later_us", self.later_ns / NS_PER_US, longest)


class Effect(Enum):
    """What a corruption comes to."""

    ERROR_FRAME = "error_frame"
    """A bit is disturbed on the wire: every node sees it, the sender repeats the frame (ISO 11898-1).
    Only a simulated segment can do this; through any other bus the frame is lost."""
    LOST = "lost"
    """The receiver throws the frame away: its check sequence does not fit, and nobody repeats it."""
    DATA = "data"
    """One bit of the data is inverted and nobody notices; a frame without data passes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Corruption:
    """A frame is damaged under way. By ``ERROR_FRAME`` each attempt to send it is struck anew."""

    kind: ClassVar[str] = "corruption"
    selection: Selection = field(default_factory=Selection)
    probability: float
    effect: Effect = Effect.ERROR_FRAME

    def __post_init__(self) -> None:
        require_probability("probability", self.probability)
        on_the_wire = self.effect is Effect.ERROR_FRAME and self.selection.side == "drive"
        seen_by_all = '"lost" or "data": an error frame is seen by every node, whatever the side'
        require(not on_the_wire, "effect", self.effect.value, seen_by_all)


Loss = IndependentLoss | BurstLoss | PeriodicLoss | Blackout
Strike = Loss | Corruption | Duplication | Reordering
"""What strikes a frame or does not."""
Delay = UniformDelay | MeasuredDelay
Fault = Strike | Delay


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """All faults of one bus, and of the nodes on it.

    A frame is lost if any fault loses it. Of corruption, duplication and reordering only the first of them,
    in this order, strikes a frame; delays act on whatever passes.
    """

    faults: tuple[Fault, ...] = ()
    node_faults: tuple[NodeFault, ...] = ()
    host_stalls: tuple[HostStall, ...] = ()

    @property
    def sides(self) -> list[tuple[str, Side]]:
        """The kinds of the faults of frames that name a side, and that side."""
        return [(fault.kind, side) for fault in self.faults if (side := fault.selection.side) is not None]

    def at(self, side: Side) -> "FaultPlan":
        """What befalls frames at the connection of the program that is given the plan: ``side``'s."""
        return FaultPlan(tuple(fault for fault in self.faults if fault.selection.side in (None, side)))

    def at_drive(self, node: int) -> "FaultPlan":
        """What befalls frames at the connection of that one drive."""
        here = [
            replace(fault, selection=replace(fault.selection, nodes=(node,)))
            for fault in self.faults
            if fault.selection.side == "drive" and node in (fault.selection.nodes or (node,))
        ]
        return FaultPlan(tuple(here))

    @property
    def span(self) -> Duration:
        """When the last window opens or closes, ns after time zero: a run should be longer."""
        edges = [fault.selection.from_ns for fault in self.faults]
        edges += [end for fault in self.faults if (end := fault.selection.until_ns) is not None]
        edges += [edge for fault in (*self.node_faults, *self.host_stalls) for edge in _edges(fault)]
        return max(edges, default=_AT_ONCE)


def _edges(fault: NodeFault | HostStall) -> list[Duration]:
    if isinstance(fault, SlowDrive):
        return []
    when = fault if isinstance(fault, ClockDrift) else fault.occasion
    edges = [when.from_ns, when.until_ns]
    if isinstance(when, Occasion):
        edges.append(when.at_ns)
    return [edge for edge in edges if edge is not None]
