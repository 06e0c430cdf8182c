"""What passes between a drive and a loop in one cycle, in SI units, and who they are to each other."""

from typing import NamedTuple

from mypy_extensions import mypyc_attr

from drivers.timebase import Instant


class Reading(NamedTuple):
    """One coherent set of actual values from a drive, as it came off the bus."""

    sequence: int
    """Number of SYNCs that the master had sent when the reading was complete (first SYNC: 1)."""
    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    statusword: int
    """0x6041, raw."""
    device_time_ns: int | None
    """The drive's own stamp of the sampling instant, unwrapped, on the drive's clock; None if it has none."""
    received_at: Instant
    """Bus stamp of the frame that completed the reading."""


class Command(NamedTuple):
    """A torque set-point and the time for which it is meant."""

    sequence: int
    """The cycle that produced it, counted as in :class:`Reading`."""
    torque_nm: float
    effective_at: Instant
    """When it is meant to act on the drive."""
    expires_at: Instant
    """After this it must not be sent."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Drive:
    """What an axis of the loop needs of a drive, simulated or real. Override all."""

    def take_readings(self) -> list[Reading]:
        """The complete readings since the last call, oldest first."""
        raise NotImplementedError

    def write(self, command: Command) -> Instant:
        """Send a set-point; when it was handed to the bus."""
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

    def send_sync(self) -> Instant:
        """Send a SYNC; when it was handed to the bus."""
        raise NotImplementedError

    def pump(self, until: Instant) -> None:
        """Handle frames until an instant."""
        raise NotImplementedError

    def pump_one(self, until: Instant) -> bool:
        """Handle one frame; False if none came until then."""
        raise NotImplementedError
