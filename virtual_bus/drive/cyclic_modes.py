"""CSP, CSV and CST, the cyclic synchronous modes (CiA 402-2): the master plans, the drive follows.

CSP   607Ah + 60B0h, interpolated over 60C2h; 60B2h is fed forward, and 60B1h, or while that is 0 the
      slope of the interpolation
CSV   60FFh + 60B1h, reached within 60C2h, no faster than 60C5h and 60C6h; 60B2h is fed forward
CST   6071h + 60B2h, at once

Statusword bit 12 in all of them: the drive follows the command; 0 while the end of the axis bars the way.
"""

from typing import Final

from drivers.cia402.profile import Status
from virtual_bus.drive.axis import SimulatedAxis
from virtual_bus.drive.firmware import InnerControl
from virtual_bus.drive.operation_mode import OperationMode

_LATE: Final = 1.5
"""Interpolation periods after which a set-point without a follower is the end of the motion."""


class _CyclicMode(OperationMode):
    def status_bits(self) -> int:
        return 0 if self.axis.barred else Status.FOLLOWS_COMMAND


class CyclicSynchronousTorque(_CyclicMode):
    """CST. It runs by periods only where the axis has an end."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self.periodic = False
        self._target = axis.objects.target_torque
        self._offset = axis.objects.torque_offset
        self._firmware = axis.firmware

    def begin(self, _controlword: int) -> None:
        self.axis.begin()
        self.take_torque()
        self._firmware.control(InnerControl.TORQUE)

    def take_torque(self) -> None:
        self._firmware.demand_torque((self._target.value + self._offset.value) * self.axis.torque_unit_nm)

    def run(self) -> None:
        self.axis.make_torque((self._target.value + self._offset.value) * self.axis.torque_unit_nm)


class CyclicSynchronousVelocity(_CyclicMode):
    """CSV."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._speed_rad_s = 0.0
        self._end_tick = 0

    def begin(self, _controlword: int) -> None:
        self.axis.begin(feeds_torque=True)
        self.take_velocity()

    def take_velocity(self) -> None:
        axis, motion = self.axis, self.axis.motion
        raw = motion.target_velocity.value + motion.velocity_offset.value
        self._speed_rad_s = raw * axis.units.rad_s_per_velocity
        self._end_tick = axis.firmware.ticks + axis.interpolation_ticks()

    def run(self) -> None:
        axis = self.axis
        now = axis.speed_rad_s
        target = axis.cut_speed(self._speed_rad_s)
        left_s = (self._end_tick - axis.firmware.ticks) * axis.firmware.tick_s
        share = min(axis.period_s / max(left_s, axis.period_s), 1.0)
        change = axis.cut_change(now, share * (target - now))
        axis.run_at(now + change)


class CyclicSynchronousPosition(_CyclicMode):
    """CSP. Statusword bit 13: following error.

    A set-point is reached one interpolation period after its arrival; without another one the drive stays.
    """

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self.has_following_error = True
        self._start = 0.0
        self._target = 0.0
        self._start_tick = 0
        self._ticks = 1
        self._lags = False
        self._cut = False

    def begin(self, _controlword: int) -> None:
        axis = self.axis
        axis.begin(feeds_torque=True)
        self._start = self._target = axis.count
        self._lags = False
        self.take_position()

    def take_position(self) -> None:
        axis, motion = self.axis, self.axis.motion
        axis.limited = False
        position = axis.cut_target(motion.target_position.value + motion.position_offset.value)
        self._cut = axis.limited
        ticks = axis.firmware.ticks
        self._start = self._demand(ticks)
        self._target = axis.units.nearest_count_of(position, self._target)
        self._start_tick, self._ticks = ticks, axis.interpolation_ticks()

    def run(self) -> None:
        axis = self.axis
        axis.limited = self._cut
        ticks = axis.firmware.ticks
        axis.follow(self._demand(ticks), self._feed(ticks))
        self._lags = axis.watch_following()

    def status_bits(self) -> int:
        return super().status_bits() | (Status.MODE_13 if self._lags else 0)

    def _feed(self, ticks: int) -> float:
        """Speed that is fed forward, counts/s."""
        axis = self.axis
        offset = axis.motion.velocity_offset.value
        if offset:
            return float(offset * axis.units.rad_s_per_velocity * axis.firmware.counts_per_rad)
        if ticks - self._start_tick >= _LATE * self._ticks:
            return 0.0
        return (self._target - self._start) / (self._ticks * axis.firmware.tick_s)

    def _demand(self, ticks: int) -> float:
        """The interpolated position at a tick, encoder counts."""
        share = (ticks - self._start_tick) / self._ticks
        return self._target if share >= 1.0 else self._start + share * (self._target - self._start)
