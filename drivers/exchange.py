"""What passes between a drive and a loop in one cycle, in SI units, and who they are to each other."""

import math
from collections.abc import Callable
from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.record import Record
from servobench.drivers.timebase import Instant


class Reading(Record):
    """What a drive told with one SYNC: its speed and, if it has a clock, the stamp of that very sample.

    Position, torque and statusword travel in other frames, some of them more seldom. They are the last
    known; ``..._told_at`` is the bus stamp of the frame that told them, so ``received_at - ..._told_at`` is
    their age.
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
        """Carried on by the speed since it was told."""
        self.position_told_at: Final = position_told_at
        self.torque_nm: Final = torque_nm
        """NaN until it was told."""
        self.torque_told_at: Final = torque_told_at
        self.statusword: Final = statusword
        """0x6041, raw."""
        self.status_told_at: Final = status_told_at


class Readback(Record):
    """The torque demand 0x6074 as a drive told it: which command it was following at a SYNC."""

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
        """Whether it came in the frame of that reading, so that it is of its SYNC in any case."""


class DemandChange(Record):
    """A torque demand 6074h that a drive told when it changed: when a command began to act."""

    __match_args__ = ("demand_raw", "device_time_ns", "received_at")
    __slots__ = __match_args__

    def __init__(self, demand_raw: int, device_time_ns: int, received_at: Instant) -> None:
        self.demand_raw: Final = demand_raw
        """In the unit of 0x6071."""
        self.device_time_ns: Final = device_time_ns
        """On the drive's clock, as in a reading."""
        self.received_at: Final = received_at


class SentCommand:
    """A set-point that was handed to the bus, and what the bus told of it since."""

    __slots__ = ("handed_at", "maybe_at", "on_bus_at", "raw", "sequence", "unsent")

    def __init__(self, sequence: int, raw: int, handed_at: Instant) -> None:
        self.sequence = sequence
        """The cycle that produced it."""
        self.raw = raw
        """As it was sent, in the unit of 0x6071 (0x60FF, 0x607A)."""
        self.handed_at = handed_at
        """Just before the bus was offered it."""
        self.unsent = False
        """Whether the bus had no room for it until a newer one was to be sent: it never went out."""
        self.on_bus_at: Instant | None = None
        """End of its frame on the bus, by its echo; None until that comes, and for ever on a bus without
        echoes or for a frame that never reached the wire."""
        self.maybe_at: Instant | None = None
        """The first echo that is taken for that of another command with equal data, and may be its own."""


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
    """What an axis of the loop needs of a drive, simulated or real. Override all."""

    def take_readings(self) -> list[Reading]:
        """The complete readings since the last call, oldest first."""
        raise NotImplementedError

    def take_readbacks(self) -> list[Readback]:
        """The read-backs since the last call, oldest first; always empty for a drive that tells none."""
        raise NotImplementedError

    def take_demand_changes(self) -> list[DemandChange]:
        """The changes of the torque demand since the last call, oldest first; empty where none are told."""
        return []

    def write(self, command: Command) -> SentCommand | None:
        """Send a set-point; None if it had expired and was not sent."""
        raise NotImplementedError

    def held_position_rad(self) -> float:
        """Where the shaft was when the drive was enabled, counted as in a reading; asked for on an axis whose
        reference or command is a position, before its first cycle."""
        raise NotImplementedError

    def follows(self) -> bool:
        """Whether the drive follows what is sent to it; True for one that does not tell."""
        return True

    def check(self) -> None:
        """Raises PeerFault if the drive is not enabled any more, reports a fault or was lost."""
        raise NotImplementedError


@mypyc_attr(allow_interpreted_subclasses=True)
class Master:
    """What the loop needs of the CANopen master. Override all methods."""

    def __init__(self) -> None:
        self.sync_count = 0
        """SYNCs sent."""
        self.sync_handed_at: list[Instant] = [Instant(0)]
        """When the last of them was handed to the bus of each segment."""
        self.on_sync_echo: Callable[[Instant, Instant], None] | None = None
        """Told of each of our SYNCs that was on the bus: its end of frame, and when it had been handed over,
        which is UNTOLD where the bus does not tell it."""
        self.on_sync_unsent: Callable[[Instant], None] | None = None
        """Told of each of our SYNCs that never went out, as the bus had no room for it: when it was handed
        over."""

        self.on_unheard: Callable[[Instant], None] | None = None
        """Told that frames which were on the bus before an instant may not have come, echoes among them."""

    def send_sync(self) -> Instant:
        """Send a SYNC; when it was handed to the bus, of several to the first."""
        raise NotImplementedError

    def withdraw(self) -> None:
        """Give up the SYNCs and set-points that still wait for room on the bus, so that none goes out later;
        whoever is told of unsent frames is told of each."""
        raise NotImplementedError

    def pump(self, until: Instant) -> None:
        """Handle frames until an instant."""
        raise NotImplementedError

    def pump_one(self, until: Instant) -> bool:
        """Handle one frame; False if none came until then."""
        raise NotImplementedError

    def rest(self, until: Instant) -> None:
        """As ``pump``, but frames may pile up until then: their stamps are the bus's."""
        self.pump(until)
