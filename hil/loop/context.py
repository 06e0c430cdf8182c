"""What a controller and a compensator are told in a cycle, and what a controller answers with."""

from typing import Final

from drivers.errors import BenchError
from drivers.exchange import Command
from drivers.record import Record
from drivers.timebase import NS_PER_S, Duration, Instant
from hil.loop.samples import AT_REST, Sample, StateEstimate
from hil.loop.scenario import ReferenceProfile

CHANNELS_MAX: Final = 8
"""Values of its own that a controller may tell in a cycle: each costs 8 bytes of every row of every run."""


class WrongSetPoint(BenchError):
    """A controller's answer is not of the quantity that its axis takes, or is none at all."""


class SetPoint(Record):
    """What a controller asks of its drive; one of the three below."""


class TorqueSetPoint(SetPoint):
    """For an axis that is given torques."""

    __match_args__ = ("torque_nm",)
    __slots__ = __match_args__

    def __init__(self, torque_nm: float) -> None:
        self.torque_nm: Final = torque_nm


class SpeedSetPoint(SetPoint):
    """For an axis that is given speeds."""

    __match_args__ = ("speed_rad_s",)
    __slots__ = __match_args__

    def __init__(self, speed_rad_s: float) -> None:
        self.speed_rad_s: Final = speed_rad_s


class PositionSetPoint(SetPoint):
    """For an axis that is given positions."""

    __match_args__ = ("position_rad",)
    __slots__ = __match_args__

    def __init__(self, position_rad: float) -> None:
        self.position_rad: Final = position_rad


class Context:
    """The present cycle of one axis. One object for the whole run: what it holds is of this cycle alone."""

    __slots__ = (
        "_reference",
        "_time_s",
        "acts_at",
        "dropouts",
        "estimate",
        "newest",
        "now",
        "period",
        "reference_rad_s",
        "samples",
        "sent",
        "sequence",
    )

    def __init__(self, period: Duration, reference: ReferenceProfile) -> None:
        self._reference = reference
        self._time_s = 0.0
        self.period: Final = period
        """Of the loop, ns."""
        self.sequence = 0
        """Number of the cycle, from 1."""
        self.now = Instant(0)
        """The present instant on the bench's clock, ns; in simulated time that of the last frame."""
        self.acts_at = Instant(0)
        """When the command of this cycle is meant to act on the drive."""
        self.estimate: StateEstimate = AT_REST
        """The compensator's, for a controller; for a compensator the one before."""
        self.samples: list[Sample] = []
        """The usable readings that have come since the last cycle, in the order in which they came."""
        self.newest: Sample | None = None
        """The last of all of them; None before the first."""
        self.dropouts = 0
        """Cycles in a row, up to this one, in which no usable reading has come."""
        self.sent: Command | None = None
        """The last command that was handed to the bus, after all limits; None before the first."""
        self.reference_rad_s = 0.0
        """The speed that is asked for now."""

    def begin(
        self, sequence: int, time_s: float, reference_rad_s: float, now: Instant, acts_at: Instant
    ) -> None:
        """A decision begins, in the cycle ``time_s`` after the first one; for the axis alone to call."""
        self.sequence = sequence
        self._time_s = time_s
        self.reference_rad_s = reference_rad_s
        self.now = now
        self.acts_at = acts_at
        if self.samples:
            self.newest = self.samples[-1]
            self.dropouts = 0
        else:
            self.dropouts += 1

    def preview(self, periods: int) -> list[float]:
        """The speeds that are asked for, rad/s, in this cycle and the ``periods`` after it."""
        period_s = self.period / NS_PER_S
        return [self._reference.value(self._time_s + ahead * period_s) for ahead in range(periods + 1)]
