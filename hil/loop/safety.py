"""Host limits in front of every command.

They are the bench's own, beside whatever the drive is configured to refuse. A
command is cut to its limits; a drive that leaves its limits stops the run.
"""

import math
from dataclasses import dataclass

from drivers.exchange import Command, SpeedCommand
from drivers.timebase import Instant
from hil.loop.context import SetPoint, SpeedSetPoint, TorqueSetPoint, WrongSetPoint
from hil.loop.samples import StateEstimate


@dataclass(frozen=True, slots=True)
class TorqueLimits:
    """What one axis may do that is given torques."""

    torque_max_nm: float
    speed_max_rad_s: float
    """A reading beyond it stops the run."""
    torque_slew_max_nm_s: float | None = None
    dropouts_consecutive_max: int = 100


@dataclass(frozen=True, slots=True)
class SpeedLimits:
    """What one axis may do that is given speeds."""

    set_point_max_rad_s: float
    speed_max_rad_s: float
    """A reading beyond it stops the run."""
    acceleration_max_rad_s2: float | None = None
    """Of the set-points."""
    dropouts_consecutive_max: int = 100


class SafetyGuard:
    """Applies the limits of one axis; what it lets through is a command of the quantity that they limit."""

    def __init__(self, limits: TorqueLimits | SpeedLimits, period_s: float) -> None:
        self._speeds = isinstance(limits, SpeedLimits)
        """Else torques."""
        if isinstance(limits, SpeedLimits):
            self._set_point_max, slew = limits.set_point_max_rad_s, limits.acceleration_max_rad_s2
        else:
            self._set_point_max, slew = limits.torque_max_nm, limits.torque_slew_max_nm_s
        self._step_max = math.inf if slew is None else slew * period_s
        self._speed_max_rad_s = limits.speed_max_rad_s
        self._dropouts_max = limits.dropouts_consecutive_max
        self._set_point = 0.0
        """The last one, like its limits in N m or rad/s."""
        self._dropouts = 0

    def demand(self, asked: SetPoint) -> float:
        """A controller's set-point in the unit of the limits. Raises WrongSetPoint for another quantity."""
        if isinstance(asked, TorqueSetPoint) and not self._speeds:
            return asked.torque_nm
        if isinstance(asked, SpeedSetPoint) and self._speeds:
            return asked.speed_rad_s
        takes = "a SpeedSetPoint" if self._speeds else "a TorqueSetPoint"
        raise WrongSetPoint(f"the controller's output is {asked!r}, this axis takes {takes}")

    def command(self, sequence: int, demand: float, effective_at: Instant, expires_at: Instant) -> Command:
        """What may be sent for a controller's demand, N m or, under :class:`SpeedLimits`, rad/s."""
        set_point = self.limit(demand)
        if self._speeds:
            return SpeedCommand(sequence, set_point, effective_at, expires_at)
        return Command(sequence, set_point, effective_at, expires_at)

    def limit(self, demand: float) -> float:
        """The set-point that may be sent, in the unit of the demand; zero for what is not a number."""
        if math.isnan(demand):
            return 0.0
        low = max(-self._set_point_max, self._set_point - self._step_max)
        high = min(self._set_point_max, self._set_point + self._step_max)
        self._set_point = min(max(demand, low), high)
        return self._set_point

    def check_speed(self, velocity_rad_s: float) -> str | None:
        """Why the run must stop after a reading of this speed, or None."""
        if abs(velocity_rad_s) <= self._speed_max_rad_s:
            return None
        return f"speed {velocity_rad_s:.1f} rad/s is beyond the limit of {self._speed_max_rad_s:.1f} rad/s"

    def check_cycle(self, fresh: bool, demand: float, estimate: StateEstimate) -> str | None:
        """Why the run must stop after this cycle, or None.

        ``fresh``: a new sample came since the last cycle.
        """
        reason = self._count(fresh)
        if reason is not None:
            return reason
        if math.isnan(demand):
            what = "speed" if self._speeds else "torque"
            speed = estimate.velocity_rad_s
            return f"the controller's {what} is not a number (speed estimate {speed} rad/s)"
        return None

    def miss_cycle(self) -> str | None:
        """Why the run must stop after a cycle without SYNC, or None."""
        return self._count(False)

    def _count(self, fresh: bool) -> str | None:
        self._dropouts = 0 if fresh else self._dropouts + 1
        if self._dropouts > self._dropouts_max:
            return f"no usable reading for {self._dropouts} cycles (limit {self._dropouts_max})"
        return None
