"""Host limits in front of every command.

They are the bench's own, beside whatever the drive is configured to refuse. A
command is cut to its limits; a drive that leaves its limits stops the run.

Positions are led along a path that the drive can follow, of limited speed and acceleration.
"""

import math
from dataclasses import dataclass
from typing import Final

from servobench.drivers.exchange import Command, PositionCommand, SpeedCommand
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.loop.protocol import (
    PositionSetPoint,
    SetPoint,
    SpeedSetPoint,
    TorqueSetPoint,
    WrongSetPoint,
)
from servobench.hil.loop.samples import Sample, StateEstimate


class PositionPath:
    """From one set-point to the next, after demands that may jump.

    A demand that keeps the limits itself passes through as it is. After one that does not, the path catches
    up: at the demand's own rate and beside it no faster than it can brake from on the way that is left,

        v + (v - a) + (v - 2 a) + ...  =  n v - a n (n - 1) / 2   (v: rad a period, a: rad a period squared)
    """

    def __init__(self, rate_max_rad_s: float, acceleration_max_rad_s2: float | None, period_s: float) -> None:
        self._period_s = period_s
        self.limit(rate_max_rad_s, acceleration_max_rad_s2)
        self.start_from(0.0)

    def limit(self, rate_max_rad_s: float, acceleration_max_rad_s2: float | None) -> None:
        """Keep these limits from the next set-point on; None: any acceleration."""
        self._step_max = rate_max_rad_s * self._period_s
        acceleration = math.inf if acceleration_max_rad_s2 is None else acceleration_max_rad_s2
        self._change = acceleration * self._period_s**2
        """Largest change of a step."""

    def start_from(self, position_rad: float, rate_rad_s: float = 0.0) -> None:
        """The path begins there, at that speed."""
        self._position = self._demand = position_rad
        self._step = self._moved = self._rate = rate_rad_s * self._period_s

    def towards(self, demand_rad: float) -> float:
        """The next set-point, rad; the last one again for what is not a number."""
        if math.isnan(demand_rad):
            self._step = 0.0
            return self._position
        rate, step = self._rate_of(demand_rad), demand_rad - self._position
        in_reach = abs(step) <= self._step_max and abs(step - self._step) <= self._change
        if in_reach and abs(step - rate) <= self._change:
            self._step = step
            self._position = demand_rad
            return demand_rad
        step = min(max(self._braking(step, rate), -self._step_max), self._step_max)
        self._step = min(max(step, self._step - self._change), self._step + self._change)
        self._position += self._step
        return self._position

    def _rate_of(self, demand_rad: float) -> float:
        """By how much the demand moves in a period; a jump is no movement."""
        moved, self._demand = demand_rad - self._demand, demand_rad
        if abs(moved - self._moved) <= self._change:
            self._rate = moved
        self._moved = moved
        return self._rate

    def _braking(self, step: float, rate: float) -> float:
        """The step from which the path can still come to go with the demand."""
        if math.isinf(self._change):
            return step
        behind, change = step - rate, self._change
        left = max(1, math.ceil(math.sqrt(0.25 + 2.0 * abs(behind) / change) - 0.5))
        return rate + math.copysign(abs(behind) / left + 0.5 * change * (left - 1), behind)


@dataclass(frozen=True, slots=True)
class TorqueLimits:
    """Limits of one axis that is given torques."""

    torque_max_nm: float
    speed_max_rad_s: float
    """A reading beyond it stops the run."""
    torque_slew_max_nm_s: float | None = None
    dropouts_consecutive_max: int = 100


@dataclass(frozen=True, slots=True)
class SpeedLimits:
    """Limits of one axis that is given speeds."""

    set_point_max_rad_s: float
    speed_max_rad_s: float
    """A reading beyond it stops the run."""
    acceleration_max_rad_s2: float | None = None
    """Of the set-points."""
    dropouts_consecutive_max: int = 100


@dataclass(frozen=True, slots=True)
class PositionLimits:
    """Limits of one axis that is given positions."""

    rate_max_rad_s: float
    """Of the set-points."""
    speed_max_rad_s: float
    """A reading beyond it stops the run."""
    acceleration_max_rad_s2: float | None = None
    """Of the set-points."""
    dropouts_consecutive_max: int = 100


Limits = TorqueLimits | SpeedLimits | PositionLimits


class SafetyGuard:
    """Applies the limits of one axis; what it lets through is a command of the quantity that they limit."""

    def __init__(self, limits: Limits, period_s: float) -> None:
        self._torques = isinstance(limits, TorqueLimits)
        self._speeds = isinstance(limits, SpeedLimits)
        self.takes_positions: Final = isinstance(limits, PositionLimits)
        self._path: PositionPath | None = None
        self._set_point_max = math.inf
        slew: float | None = None
        self.path_limits: tuple[float, float | None] = (limits.speed_max_rad_s, None)
        """Limits of positions that are asked for: highest speed, rad/s, and acceleration, rad/s^2; None:
        any."""
        if isinstance(limits, SpeedLimits):
            self._set_point_max, slew = limits.set_point_max_rad_s, limits.acceleration_max_rad_s2
            self.path_limits = self._set_point_max, slew
        elif isinstance(limits, TorqueLimits):
            self._set_point_max, slew = limits.torque_max_nm, limits.torque_slew_max_nm_s
        else:
            self.path_limits = limits.rate_max_rad_s, limits.acceleration_max_rad_s2
            self._path = PositionPath(*self.path_limits, period_s)
        self._step_max = math.inf if slew is None else slew * period_s
        self._speed_max_rad_s = limits.speed_max_rad_s
        self._dropouts_max = limits.dropouts_consecutive_max
        self._set_point = 0.0
        """The last one, like its limits in N m or rad/s."""
        self._dropouts = 0

    def start_from(self, position_rad: float, rate_rad_s: float = 0.0) -> None:
        """Where the shaft is before the first set-point; for an axis that is given positions."""
        if self._path is not None:
            self._path.start_from(position_rad, rate_rad_s)

    def demand(self, asked: SetPoint) -> float:
        """A controller's set-point in the unit of the limits. Raises WrongSetPoint for another quantity."""
        if isinstance(asked, TorqueSetPoint) and self._torques:
            return asked.torque_nm
        if isinstance(asked, SpeedSetPoint) and self._speeds:
            return asked.speed_rad_s
        if isinstance(asked, PositionSetPoint) and self.takes_positions:
            return asked.position_rad
        takes = "TorqueSetPoint" if self._torques else "SpeedSetPoint" if self._speeds else "PositionSetPoint"
        raise WrongSetPoint(f"the controller's output is {asked!r}, this axis takes a {takes}")

    def command(self, sequence: int, demand: float, effective_at: Instant, expires_at: Instant) -> Command:
        """Return what may be sent for a controller's demand, N m or, by the limits, rad/s or rad."""
        set_point = self.limit(demand)
        if self._torques:
            return Command(sequence, set_point, effective_at, expires_at)
        if self._speeds:
            return SpeedCommand(sequence, set_point, effective_at, expires_at)
        return PositionCommand(sequence, set_point, effective_at, expires_at)

    def limit(self, demand: float) -> float:
        """The set-point that may be sent, in the unit of the demand; for what is not a number zero, and of
        positions the last one."""
        if self._path is not None:
            return self._path.towards(demand)
        if math.isnan(demand):
            return 0.0
        low = max(-self._set_point_max, self._set_point - self._step_max)
        high = min(self._set_point_max, self._set_point + self._step_max)
        self._set_point = min(max(demand, low), high)
        return self._set_point

    def in_place_of(self, command: Command, newest: Sample | None) -> Command:
        """Return what acts while the drive does not follow: torque, speed or position as the drive told it
        last.

        Set-points are limited in their change from there on, so that the first that is followed again makes
        no jump. Without a reading, or a torque in it, 0 N m is taken.
        """
        reading = None if newest is None else newest.reading
        sequence, effective_at, expires_at = command.sequence, command.effective_at, command.expires_at
        if isinstance(command, PositionCommand):
            if reading is None or newest is None:
                return command
            speed = reading.velocity_rad_s
            ahead_s = (expires_at - newest.sampled_at) / NS_PER_S  # a set-point is reached when it expires
            self.start_from(reading.position_rad + speed * ahead_s, speed)
            return PositionCommand(sequence, reading.position_rad, effective_at, expires_at)
        if isinstance(command, SpeedCommand):
            self._set_point = 0.0 if reading is None else reading.velocity_rad_s
            return SpeedCommand(sequence, self._set_point, effective_at, expires_at)
        torque_nm = 0.0 if reading is None or math.isnan(reading.torque_nm) else reading.torque_nm
        self._set_point = min(max(torque_nm, -self._set_point_max), self._set_point_max)
        return Command(sequence, torque_nm, effective_at, expires_at)

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
            what = "torque" if self._torques else "speed" if self._speeds else "position"
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
