"""What passes between a drive and a loop in one cycle, in SI units."""

from typing import NamedTuple

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
