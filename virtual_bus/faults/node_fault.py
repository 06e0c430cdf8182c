"""Base of all faults of a node itself, or of the host: their time, and their action.

They act where the drive is simulated, those of the host in simulated time. Times count from the plan's time
zero, except for faults from the drive's power-on (a slow drive, a refused mapping).

Base of outages of the host's own CAN adapter, and of its kernel.
"""

import math
from collections.abc import Callable, Iterator
from typing import ClassVar, NamedTuple, Protocol

from pydantic import model_validator

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.errors import MISSING
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.virtual_bus.faults.fault_table import (
    FaultTable,
    Lasting,
    NodeIds,
    Number,
    Seconds,
    TimeWindow,
    ns,
    require,
)

EVERY_MIN = Duration(100 * NS_PER_US)
"""No cycle is shorter; after a pause each strike that was missed is looked at."""

Draw = Callable[[], float]
Streams = Callable[[str], Draw]
"""Opens the random stream of a fault at a node that has this name behind its own."""


class NodeEvent(NamedTuple):
    """Something strikes; its numbers are those of an entry of the fault log."""

    at_ns: int
    """Since the plan's time zero."""
    kind: str
    a: int
    b: int = 0
    c: int = 0


class DamagedDrive(Protocol):
    """What can break or wear, see :class:`servobench.virtual_bus.drive.damage.Damage`."""

    def open_chopper(self, opened: bool) -> None: ...

    def drag_brake(self, torque_nm: float) -> None: ...

    def loosen_coupling(self, share: float, backlash_rad: float) -> None: ...

    def soil_encoder(self, from_turn: float, to_turn: float) -> None: ...

    def heat_motor(self, resistance_factor: float, flux_factor: float, winding_c: float = ...) -> None: ...


class StruckNode(Protocol):
    """Possible actions of a fault on a node."""

    def silence(self, until: int) -> None:
        """Neither hear nor send."""

    def step_clock(self, step_ns: int) -> None: ...

    def drift_clock(self, drift_ppb: int, now: Instant) -> None: ...

    def answer_scan_in_configuration(self) -> None:
        """Say yes to every LSS fast scan in the configuration state."""

    def go_bus_off(self, now: Instant, recover_after_ns: int | None) -> None: ...

    def fail(self, code: int, register: ErrorRegister, now: Instant) -> None:
        """The drive finds an error of its own."""

    def hold_encoder(self, held: bool, now: Instant) -> None: ...

    def damage(self, act: Callable[[DamagedDrive], None], now: Instant) -> None:
        """Something of the drive, or of its machine, breaks or wears, or is whole again."""

    def open_sto(self, opened: bool, now: Instant) -> None:
        """Its input for safe torque off."""

    def scale_supply(self, share: float, now: Instant) -> None:
        """The drive's source gives that share of its voltage."""

    def take_mode(self, mode: int, now: Instant) -> None:
        """The drive takes that mode of operation by itself."""

    def leave_mode(self, mode: int, now: Instant) -> None:
        """The drive goes back to the mode of 6060h, if it still is in ``mode``."""

    def turn_deaf(self, zero: bool, hides_bit_12: bool, now: Instant) -> None:
        """The drive ignores set-points, see :class:`servobench.virtual_bus.drive.deaf_mode.DeafMode`."""

    def hear_again(self, now: Instant) -> None:
        """The drive follows set-points again."""

    def report_again(self, code: int, register: ErrorRegister, now: Instant) -> None:
        """The drive sends an EMCY, once more if it did already, while it is enabled."""

    def refuse_mapping(self, index: int, subindex: int, abort: int, mapped: int) -> None:
        """Refuse writes of a mapping parameter, 0: of every entry of every PDO; ``mapped``: index and
        sub-index, as in the word, of the only object that is refused, 0: whatever is written."""

    def later(self, due: int, action: Callable[[Instant], None]) -> None:
        """Do something at ``due``."""


class Slowness(Protocol):
    """How slow a drive is."""

    def lateness(self, can_id: int) -> int:
        """For how many ns it keeps its next frame with ``can_id`` back."""

    def boot_time(self) -> int:
        """How long its next boot takes, ns."""


class NodeFault(FaultTable):
    """A fault of a node. A kind is one subclass, in a file of its own."""

    nodes: NodeIds = ()
    """Empty: each simulated drive, each by its own chance."""
    needs_drive: ClassVar[bool] = False
    """Only a device with a motor inside can have it."""
    strikes_plant: ClassVar[bool] = False
    """While it lasts the drive is not the one that a controller was designed for."""
    needs_part: ClassVar[str] = ""
    """Table of the drive's or the motor's file whose part it strikes; empty: every drive has it."""

    @property
    def stream_name(self) -> str:
        """Faults of one name are numbered: to add one shifts no draw of another name."""
        return self.kind

    def events(self, streams: Streams) -> Iterator[NodeEvent]:  # noqa: ARG002
        """Return the events of one node, in order of time."""
        return iter(())

    def from_power_on(self) -> "NodeEvent | None":
        """Return the fault from power-on; its time counts from there."""
        return None

    def slowness(self, streams: Streams) -> Slowness | None:  # noqa: ARG002
        """How slow it makes one node; None: not at all."""
        return None

    @staticmethod
    def befall(node: StruckNode, now: Instant, event: NodeEvent) -> None:
        """Do it."""
        raise NotImplementedError

    @staticmethod
    def lasts_ns(event: NodeEvent) -> int:
        """How long it goes on, ns; NONE: until an event of its kind with the opposite number."""
        return event.a

    @staticmethod
    def in_words(kind: str, node: str, event: NodeEvent) -> str:
        """Describe the event for a reader; ``kind``: of the entry in the log."""
        return f"{kind.replace('_', ' ')} of {event.a / NS_PER_MS:g} ms, {node}"


class Occasion(TimeWindow):
    """Strikes once at ``at_s``, or again and again within a window, regularly or by chance.

    By chance: no memory, so the gaps are exponential; ``probability_per_s`` is the chance that it strikes
    at least once within a second.
    """

    at_s: Seconds | None = None
    every_s: Seconds | None = None
    """The first time so long after ``from_s``."""
    probability_per_s: Number = 0.0

    @model_validator(mode="after")
    def _check_occasion(self) -> "Occasion":
        chance = self.probability_per_s
        other = "at_s" if self.at_s is not None else "every_s" if self.every_s is not None else ""
        if other:
            require(chance == 0.0, "probability_per_s", chance, f"no {other} beside")
        if self.at_s is not None:
            require(self.every_s is None, "every_s", self.every_s, "no at_s beside")
            plain = self.from_s == 0.0 and self.until_s is None
            require(plain, "from_s", self.from_s, "no window beside at_s")
        elif self.every_s is not None:
            least = f"a time from {EVERY_MIN / NS_PER_S:g} s"
            require(ns(self.every_s) >= EVERY_MIN, "every_s", self.every_s, least)
        else:
            expected = "a probability from 0 to below 1, or at_s or every_s instead"
            require(0.0 < chance < 1.0, "probability_per_s", chance or MISSING, expected)
        return self

    @property
    def at_ns(self) -> Duration | None:
        """``at_s``."""
        return None if self.at_s is None else ns(self.at_s)

    @property
    def edges_ns(self) -> list[Duration]:
        """When it opens and closes, or strikes."""
        return super().edges_ns if self.at_ns is None else [self.at_ns]

    def numbers(self, draw: Draw) -> tuple[int, ...]:
        """Those of the next strike."""
        raise NotImplementedError

    def events(self, streams: Streams) -> Iterator[NodeEvent]:
        """All strikes, in order of time."""
        draw = streams("")
        at_ns = self._next_strike(self.from_ns, draw)
        while at_ns is not None:
            yield NodeEvent(at_ns, self.kind, *self.numbers(draw))
            at_ns = None if self.at_s is not None else self._next_strike(at_ns, draw)

    def _next_strike(self, since_ns: int, draw: Draw) -> int | None:
        """The next instant after ``since_ns`` (ns); None if there is none in the window."""
        if self.at_ns is not None:
            return self.at_ns
        if self.every_s is not None:
            at_ns = since_ns + ns(self.every_s)
        else:
            rate_per_s = -math.log1p(-self.probability_per_s)
            gap_s = -math.log1p(-draw()) / rate_per_s
            at_ns = since_ns + max(1, round(gap_s * 1e6) * NS_PER_US)
        return None if self.until_ns is not None and at_ns >= self.until_ns else at_ns


class NodeOccasion(Occasion, NodeFault):
    """A fault of a node that strikes at certain times."""


class AdapterOutage(Occasion):
    """For a while the host's adapter takes no frames, or gives none."""

    code: ClassVar[int | None] = None
    """Error code for a sender, from errno; None: it takes frames."""
    hears: ClassVar[bool] = True
    """True if it continues to receive."""
    begins: ClassVar[str] = ""
    """Message at the begin; empty: none."""
    ends: ClassVar[str] = ""
    """The same when it ends; ``{unheard}``: how many frames came meanwhile."""
    duration_s: Lasting

    def numbers(self, draw: Draw) -> tuple[int, ...]:  # noqa: ARG002
        return (ns(self.duration_s),)
