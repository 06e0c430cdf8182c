"""The data that a drive and a loop exchange in one cycle, in SI units, and their interfaces to each other."""

import math
from collections.abc import Callable
from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.record import Record
from servobench.drivers.timebase import Instant

NEVER_TOLD: Final = Instant(-1)
"""In the place of the stamp of a frame that has not come yet."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Reading(Record):
    """One drive's values at one SYNC: its speed and, if the drive has a clock, the stamp of that very sample.

    Position, torque and statusword travel in other frames, some of them more seldom. The last known values
    are used; ``..._told_at`` is the bus stamp of the frame that carried them, so ``received_at -
    ..._told_at`` is their age. A position that is 0 old came in the frame of the speed: :attr:`counted_rad`.
    """

    __match_args__ = (
        "velocity_rad_s",
        "device_time_ns",
        "received_at",
        "position_rad",
        "position_told_at",
        "torque_nm",
        "torque_told_at",
        "statusword",
        "status_told_at",
    )
    __slots__ = __match_args__

    def __init__(
        self,
        velocity_rad_s: float,
        device_time_ns: int | None,
        received_at: Instant,
        position_rad: float,
        position_told_at: Instant,
        torque_nm: float,
        torque_told_at: Instant,
        statusword: int,
        status_told_at: Instant,
    ) -> None:
        self.velocity_rad_s: Final = velocity_rad_s
        self.device_time_ns: Final = device_time_ns
        """The drive's own stamp of the sampling instant, unwrapped, on the drive's clock; None if the frame
        that carries the speed carries none."""
        self.received_at: Final = received_at
        """Bus stamp of the frame that carries the speed."""
        self.position_rad: Final = position_rad
        """Extrapolated by the speed since the last frame that carried it."""
        self.position_told_at: Final = position_told_at
        self.torque_nm: Final = torque_nm
        """NaN until a frame has carried it."""
        self.torque_told_at: Final = torque_told_at
        self.statusword: Final = statusword
        """0x6041, raw."""
        self.status_told_at: Final = status_told_at

    @property
    def counted_rad(self) -> float:
        """The position 6064h of the same SYNC as the speed, in whole counts of the drive and carried on by
        nothing; NaN if the frame of the speed has none."""
        return self.position_rad if self.position_told_at == self.received_at else math.nan


@mypyc_attr(acyclic=True, free_list_len=1)
class Readback(Record):
    """The torque demand 0x6074 reported by a drive: which command it was following at a SYNC."""

    __match_args__ = ("demand_raw", "received_at", "readings", "in_reading")
    __slots__ = __match_args__

    def __init__(
        self, demand_raw: int, received_at: Instant, readings: int, in_reading: bool = False
    ) -> None:
        self.demand_raw: Final = demand_raw
        """In the unit of 0x6071."""
        self.received_at: Final = received_at
        self.readings: Final = readings
        """How many readings of this drive were complete when it came: it goes with the SYNC of the last of
        them, if no frame was lost or overtaken on the way."""
        self.in_reading: Final = in_reading
        """True if it came in the frame of that reading, and so certainly belongs to its SYNC."""


@mypyc_attr(acyclic=True, free_list_len=1)
class DemandChange(Record):
    """A change of the torque demand 6074h reported by a drive: the moment a command began to act."""

    __match_args__ = ("demand_raw", "device_time_ns", "received_at")
    __slots__ = __match_args__

    def __init__(self, demand_raw: int, device_time_ns: int, received_at: Instant) -> None:
        self.demand_raw: Final = demand_raw
        """In the unit of 0x6071."""
        self.device_time_ns: Final = device_time_ns
        """On the drive's clock, as in a reading."""
        self.received_at: Final = received_at


@mypyc_attr(acyclic=True, free_list_len=1)
class SentCommand:
    """A set-point handed to the bus, and what the bus has reported about it since."""

    __slots__ = ("handed_at", "maybe_at", "on_bus_at", "raw", "sequence", "unsent")

    def __init__(self, sequence: int, raw: int, handed_at: Instant) -> None:
        self.sequence = sequence
        """The cycle that produced it."""
        self.raw = raw
        """The value sent, in the unit of 0x6071 (0x60FF, 0x607A)."""
        self.handed_at = handed_at
        """Just before the bus was offered it."""
        self.unsent = False
        """True if the bus had no room for it before a newer one replaced it: it was never sent."""
        self.on_bus_at: Instant | None = None
        """End of its frame on the bus, by its echo; None until the echo comes, and permanently None on a bus
        without echoes or for a frame that never reached the wire."""
        self.maybe_at: Instant | None = None
        """The first echo attributed to another command with equal data that may belong to this one."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Command(Record):
    """A torque set-point and the time for which it is meant."""

    __match_args__ = ("sequence", "torque_nm", "effective_at", "expires_at")
    __slots__ = __match_args__

    def __init__(self, sequence: int, torque_nm: float, effective_at: Instant, expires_at: Instant) -> None:
        self.sequence: Final = sequence
        """The cycle that produced it."""
        self.torque_nm: Final = torque_nm
        self.effective_at: Final = effective_at
        """When it is meant to act on the drive."""
        self.expires_at: Final = expires_at
        """After this it must not be sent."""


class SpeedCommand(Command):
    """A speed set-point, and no torque: its ``torque_nm`` is NaN, which nothing sends."""

    __match_args__ = ("sequence", "speed_rad_s", "effective_at", "expires_at")
    __slots__ = ("speed_rad_s",)

    def __init__(self, sequence: int, speed_rad_s: float, effective_at: Instant, expires_at: Instant) -> None:
        super().__init__(sequence, math.nan, effective_at, expires_at)
        self.speed_rad_s: Final = speed_rad_s


class PositionCommand(Command):
    """A position set-point, counted as in a reading; no torque, as :class:`SpeedCommand`."""

    __match_args__ = ("sequence", "position_rad", "effective_at", "expires_at")
    __slots__ = ("position_rad",)

    def __init__(
        self, sequence: int, position_rad: float, effective_at: Instant, expires_at: Instant
    ) -> None:
        super().__init__(sequence, math.nan, effective_at, expires_at)
        self.position_rad: Final = position_rad


@mypyc_attr(allow_interpreted_subclasses=True)
class Drive:
    """The interface of a drive, simulated or real, to an axis of the loop. Override all methods."""

    def has_readings(self) -> bool:
        """Return whether :meth:`take_readings` may return any; it is asked after each frame on the bus."""
        return True

    def take_readings(self) -> list[Reading]:
        """Return the complete readings since the last call, oldest first."""
        raise NotImplementedError

    def take_readbacks(self) -> list[Readback]:
        """Return the read-backs since the last call, oldest first; always empty for a drive that reports
        none."""
        raise NotImplementedError

    def take_demand_changes(self) -> list[DemandChange]:
        """Return the changes of the torque demand since the last call, oldest first; empty if none are
        reported."""
        return []

    def write(self, command: Command) -> SentCommand | None:
        """Send a set-point; None if it had expired and was not sent."""
        raise NotImplementedError

    def held_position_rad(self) -> float:
        """Return the shaft position at the moment the drive was enabled, on the scale of the readings; called
        before the first cycle of an axis whose reference or command is a position."""
        raise NotImplementedError

    def follows(self) -> bool:
        """Return True while the drive follows its commands, and for a drive that does not report it."""
        return True

    def check(self) -> None:
        """Raise PeerFault if the drive is no longer enabled, reports a fault or is lost."""
        raise NotImplementedError


@mypyc_attr(allow_interpreted_subclasses=True)
class Master:
    """The interface of the CANopen master to the loop. Override all methods."""

    def __init__(self) -> None:
        self.sync_count = 0
        """SYNCs sent."""
        self.sync_handed_at: list[Instant] = [Instant(0)]
        """When the latest SYNC was handed to the bus of each segment."""
        self.on_sync_echo: Callable[[Instant, Instant], None] | None = None
        """Called for each of our SYNCs that reached the bus: its end of frame, and the instant of its
        hand-over, which is UNTOLD if the bus does not report it."""
        self.on_sync_unsent: Callable[[Instant], None] | None = None
        """Called for each of our SYNCs that was never sent because the bus had no room: the instant of its
        hand-over."""

        self.on_unheard: Callable[[Instant], None] | None = None
        """Called when frames that were on the bus before an instant, echoes included, may have been
        missed."""

    def send_sync(self) -> Instant:
        """Send a SYNC; return the instant at which it was handed to the (first) bus."""
        raise NotImplementedError

    def withdraw(self) -> None:
        """Discard the SYNCs and set-points that still wait for room on the bus, so that none goes out later;
        the handler of unsent frames is called for each."""
        raise NotImplementedError

    def pump(self, until: Instant) -> None:
        """Handle frames until an instant."""
        raise NotImplementedError

    def pump_one(self, until: Instant) -> bool:
        """Handle one frame; False if none came until then."""
        raise NotImplementedError

    def rest(self, until: Instant) -> None:
        """Let time pass like ``pump``, but frames may queue up until then: the bus has stamped them."""
        self.pump(until)
