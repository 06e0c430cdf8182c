"""What passes between a drive and a loop in one cycle, in SI units, and who they are to each other."""

from collections.abc import Callable
from typing import Final, NamedTuple

from mypy_extensions import mypyc_attr

from drivers.timebase import Instant

_new: Final = tuple.__new__
"""A named tuple's own constructor is interpreted. The functions that use this stand beside their types, with
all fields named, so that a field is added in one place."""


class Reading(NamedTuple):
    """What a drive told with one SYNC: its speed and, if it has a clock, the stamp of that very sample.

    Position, torque and statusword travel in other frames, some of them more seldom. They are the last
    known; ``..._told_at`` is the bus stamp of the frame that told them, so ``received_at - ..._told_at`` is
    their age.
    """

    velocity_rad_s: float
    device_time_ns: int | None
    """The drive's own stamp of the sampling instant, unwrapped, on the drive's clock; None if the frame that
    carries the speed carries none."""
    received_at: Instant
    """Bus stamp of the frame that carries the speed."""
    position_rad: float
    """Carried on by the speed since it was told."""
    position_told_at: Instant
    torque_nm: float
    """NaN until it was told."""
    torque_told_at: Instant
    statusword: int
    """0x6041, raw."""
    status_told_at: Instant


def new_reading(
    velocity_rad_s: float,
    device_time_ns: int | None,
    received_at: Instant,
    position_rad: float,
    position_told_at: Instant,
    torque_nm: float,
    torque_told_at: Instant,
    statusword: int,
    status_told_at: Instant,
) -> Reading:
    """A :class:`Reading`, in a third of the time that its own constructor takes where this is compiled."""
    return _new(
        Reading,
        (
            velocity_rad_s,
            device_time_ns,
            received_at,
            position_rad,
            position_told_at,
            torque_nm,
            torque_told_at,
            statusword,
            status_told_at,
        ),
    )


class Readback(NamedTuple):
    """The torque demand 0x6074 as a drive told it: which command it was following at a SYNC."""

    demand_raw: int
    """In the unit of 0x6071."""
    received_at: Instant
    readings: int
    """How many readings of this drive were complete when it came: it goes with the SYNC of the last of them,
    if no frame was lost or overtaken on the way."""


def new_readback(demand_raw: int, received_at: Instant, readings: int) -> Readback:
    """As :func:`new_reading`."""
    return _new(Readback, (demand_raw, received_at, readings))


class DemandChange(NamedTuple):
    """A torque demand 6074h that a drive told when it changed: when a command began to act."""

    demand_raw: int
    """In the unit of 0x6071."""
    device_time_ns: int
    """On the drive's clock, as in a reading."""
    received_at: Instant


class SentCommand:
    """A set-point that was handed to the bus, and what the bus told of it since."""

    __slots__ = ("handed_at", "on_bus_at", "raw", "sequence")

    def __init__(self, sequence: int, raw: int, handed_at: Instant) -> None:
        self.sequence = sequence
        """The cycle that produced it."""
        self.raw = raw
        """As it was sent, in the unit of 0x6071 (0x60FF, 0x607A)."""
        self.handed_at = handed_at
        """Just before the bus was given it."""
        self.on_bus_at: Instant | None = None
        """End of its frame on the bus, by its echo; None until that comes, and for ever on a bus without
        echoes or for a frame that never reached the wire."""


class Command(NamedTuple):
    """A torque set-point and the time for which it is meant."""

    sequence: int
    """The cycle that produced it."""
    torque_nm: float
    effective_at: Instant
    """When it is meant to act on the drive."""
    expires_at: Instant
    """After this it must not be sent."""


def new_command(sequence: int, torque_nm: float, effective_at: Instant, expires_at: Instant) -> Command:
    """As :func:`new_reading`."""
    return _new(Command, (sequence, torque_nm, effective_at, expires_at))


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

    def check(self) -> None:
        """Raises PeerFault if the drive is not enabled any more, reports a fault or was lost."""
        raise NotImplementedError


@mypyc_attr(allow_interpreted_subclasses=True)
class Master:
    """What the loop needs of the CANopen master. Override all methods."""

    def __init__(self) -> None:
        self.sync_count = 0
        """SYNCs sent."""
        self.on_sync_echo: Callable[[Instant], None] | None = None
        """Told of each of our SYNCs that was on the bus: its end of frame."""

    def send_sync(self) -> Instant:
        """Send a SYNC; when it was handed to the bus."""
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
