"""Base of all faults of frames: the affected frames, and the time.

Faults of frames at work on one link: whether one strikes a frame, and for how long one holds it
(core/strikes.c).

``elapsed``: time since the plan's time zero, ns. Each draws the same number of times for every frame, struck
or not, in its window or not, so that none of its draws depends on its own settings or on another fault.
"""

import difflib
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import Field, PlainValidator, model_validator

from servobench.drivers.canopen.nmt_states import NODE_ID_MAX
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NEVER
from servobench.drivers.wire.frame_port import EXTENDED_ID_MAX, STANDARD_ID_MAX
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.core import native
from servobench.virtual_bus.core.native import Hold as Hold
from servobench.virtual_bus.core.native import Strike as Strike
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import NodeIds, TimeWindow, require


class IndependentStrike(Strike):
    """Each frame by itself."""

    def __init__(self, kind: str, window: tuple[int, int], probability: float, stream: UniformStream) -> None:
        super().__init__(kind, window)
        self.by_chance(native.INDEPENDENT, stream, probability)


class NumberedStrike(Strike):
    """Each frame by itself, with a number from ``least`` on, ``width`` of them, drawn evenly."""

    def __init__(
        self,
        kind: str,
        window: tuple[int, int],
        probability: float,
        least: int,
        width: int,
        stream: UniformStream,
    ) -> None:
        """``width`` 0: always ``least``."""
        super().__init__(kind, window)
        self.by_chance(native.NUMBERED, stream, probability)
        self.numbered(least, width)


class BurstStrike(Strike):
    """Gilbert and Elliott's chain of two states."""

    def __init__(
        self,
        kind: str,
        window: tuple[int, int],
        moves: tuple[float, float],
        losses: tuple[float, float],
        stream: UniformStream,
    ) -> None:
        """``moves``: probabilities of leaving the good state and the bad; ``losses``: of losses in each."""
        super().__init__(kind, window)
        self.by_chance(native.BURST, stream, *moves, *losses)


class PeriodicStrike(Strike):
    """So many of each so many and one."""

    def __init__(self, kind: str, window: tuple[int, int], lost: int) -> None:
        super().__init__(kind, window)
        self.by_count(native.PERIODIC, lost + 1)


class FirstStrikes(Strike):
    """The first ``count`` of a time."""

    def __init__(self, kind: str, window: tuple[int, int], count: int) -> None:
        super().__init__(kind, window)
        self.by_count(native.FIRST, count)


class UniformHold(Hold):
    """Any time from ``least`` on, ``width`` of them, all alike."""

    def __init__(
        self, window: tuple[int, int], in_order: bool, least: int, width: int, stream: UniformStream
    ) -> None:
        super().__init__(window, in_order)
        self.uniform(stream, least, width)


class MeasuredHold(Hold):
    """Draws a bar of a histogram by its count, then a time within it."""

    def __init__(
        self,
        window: tuple[int, int],
        in_order: bool,
        edges_ns: Sequence[int],
        counts: Sequence[int],
        stream: UniformStream,
    ) -> None:
        super().__init__(window, in_order)
        self.measured(stream, edges_ns, counts)


BROADCAST: Final = 0
"""Stands for the node of a frame that belongs to no single one."""

Side = Literal["host", "drive"]
"""Whose connection to the bus: that of the host, or of a drive as through a gateway between bus and drive."""

COB_IDS: Final = {
    "pdo": range(0x180, 0x580),
    "sync": range(0x080, 0x081),
    "sdo": range(0x580, 0x680),
    "emcy": range(0x081, 0x100),
    "heartbeat": range(0x700, 0x780),
    "nmt": range(0x001),
    "time": range(0x100, 0x101),
    "lss": range(0x7E4, 0x7E6),
    "all": range(STANDARD_ID_MAX + 1),
}
"""COB-IDs of each class of frames (CiA 301 7.3.5, the pre-defined connection set); PDO 1..4 take the function
codes 3..10."""
_OF_ONE_NODE: Final = ("emcy", "pdo", "sdo", "heartbeat")


def node_of(can_id: int, extended: bool = False) -> int:
    """The node that a frame belongs to by its COB-ID; :data:`BROADCAST` if to none."""
    if extended or not any(can_id in COB_IDS[frames] for frames in _OF_ONE_NODE):
        return BROADCAST
    return can_id & NODE_ID_MAX


def _frames(item: Any) -> str | int:
    """A class of frames, or a COB-ID; a number above 7FFh means an extended frame."""
    if isinstance(item, str) and item not in COB_IDS:
        near = difflib.get_close_matches(item, COB_IDS, n=1)
        expected = f'"{near[0]}", the nearest' if near else "a class of frames"
        remedy = f"classes: {', '.join(COB_IDS)}; or a COB-ID as a number"
        raise BadInput("fault plan", "frames", item, expected, remedy)
    number = isinstance(item, int) and not isinstance(item, bool)
    require(isinstance(item, str) or number, "frames", item, "a class of frames or a COB-ID")
    known = isinstance(item, str) or 0 <= item <= EXTENDED_ID_MAX
    require(known, "frames", item, f"a COB-ID from 0 to {EXTENDED_ID_MAX:#x}")
    result: str | int = item
    return result


Frames = Annotated[
    tuple[Annotated[str | int, PlainValidator(_frames)], ...],
    Field(strict=False, description='a list, such as ["pdo", "sync"] or [0x181]'),
]


class LinkFault(TimeWindow):
    """A fault of what passes over a connection to the bus: of frames, or of signals in them."""

    direction: Literal["both", "host_to_drive", "drive_to_host"] = "both"
    nodes: NodeIds = ()
    """Only classes' frames of these nodes; empty: of all, and broadcasts too."""
    side: Side | None = None
    """At whose connection; None: at that of the program that is given the plan. At a drive's, ``nodes`` are
    the drives, and frames that belong to no node are theirs too."""

    @property
    def window(self) -> tuple[int, int]:
        """First ns in which it acts, and the first in which it does so no more."""
        return self.from_ns, NEVER if self.until_ns is None else self.until_ns


class FrameFault(LinkFault):
    """A fault of frames. A kind is one subclass, in a file of its own."""

    frames: Frames = ("pdo",)

    delays: ClassVar[bool] = False
    """It makes a :class:`Hold`."""
    rank: ClassVar[int] = 0
    """Among all strikes of a frame the lowest rank counts; losses have 0."""
    of_each_cob_id: ClassVar[bool] = False
    """It counts the frames of each COB-ID, so that all PDOs of a cycle fare alike; chance is the link's."""

    @model_validator(mode="after")
    def _check_frames(self) -> "FrameFault":
        require(bool(self.frames), "frames", [], "at least one class of frames or COB-ID")
        return self

    @property
    def on_the_wire(self) -> bool:
        """A bus that has error frames strikes it, see :mod:`.disturber`."""
        return False

    def at_work(self, stream: UniformStream) -> Strike | Hold:
        """Return its action on the frames of one link (or COB-ID), with the random stream of that link."""
        raise NotImplementedError

    def selects(self, direction: Direction, can_id: int, extended: bool = False) -> bool:
        """Return True if a frame is among the affected ones, at any time."""
        return self.direction in ("both", direction.label) and any(
            self._names(item, can_id, extended) for item in self.frames
        )

    def _names(self, item: str | int, can_id: int, extended: bool) -> bool:
        if isinstance(item, int):
            return item == can_id and extended == (item > STANDARD_ID_MAX)
        if self.nodes:
            node = node_of(can_id, extended)
            if node not in self.nodes and not (node == BROADCAST and self.side == "drive"):
                return False
        return item == "all" or (not extended and can_id in COB_IDS[item])
