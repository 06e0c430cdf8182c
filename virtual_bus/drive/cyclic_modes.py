"""CSP, CSV and CST, the cyclic synchronous modes, and IP, interpolated position (CiA 402-2).

In all of them the master plans, and the drive follows.

CSP   607Ah + 60B0h, interpolated over 60C2h; 60B2h is fed forward, and 60B1h, or while that is 0 the
      slope of the interpolation
CSV   60FFh + 60B1h, reached within 60C2h, no faster than 60C5h and 60C6h; 60B2h is fed forward
CSTCA the same, at the electrical angle of 60EAh
CST   6071h + 60B2h, at once, or by 6087h in a drive whose maker has it so
IP    60C1h:1, interpolated over 60C2h (60C0h = 0), while bit 4 of the controlword is 1

Statusword bit 12 in the first three: the drive follows the command; 0 while the end of the axis bars the way.
In IP: interpolation is active; 0 too while the way is barred, or a halt is commanded.
"""

from typing import Final

from servobench.drivers.cia402.profile import Control, Status
from servobench.virtual_bus.drive.axis import SimulatedAxis, WindowTimer
from servobench.virtual_bus.drive.firmware import InnerControl
from servobench.virtual_bus.drive.motion_objects import NO_WINDOW
from servobench.virtual_bus.drive.operation_mode import HaltedMode, OperationMode
from servobench.virtual_bus.drive.set_point_path import Interpolation

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
        self._sloped = axis.path.torque_slope

    def begin(self, _controlword: int) -> None:
        self.axis.begin()
        self.take_torque()
        if self._sloped:
            self._take_slope()
        self._firmware.control(InnerControl.TORQUE)

    def take_torque(self) -> None:
        target: int = self._target.value
        offset: int = self._offset.value
        self._firmware.demand_torque((target + offset) * self.axis.torque_unit_nm)

    def _take_slope(self) -> None:
        axis = self.axis
        slope_nm_s = axis.motion.torque_slope.value * axis.torque_unit_nm
        self._firmware.inner.torque_step_nm = slope_nm_s * self._firmware.tick_s

    def run(self) -> None:
        self.axis.make_torque((self._target.value + self._offset.value) * self.axis.torque_unit_nm)


class CyclicSynchronousTorqueWithAngle(CyclicSynchronousTorque):
    """CST at the electrical angle that the master says. At an end of the axis there is no torque: the drive
    may not know how to stop this motor by its own angle."""

    def begin(self, controlword: int) -> None:
        super().begin(controlword)
        self._firmware.inner.angle_forced = 1

    def run(self) -> None:
        axis = self.axis
        torque_nm = (self._target.value + self._offset.value) * axis.torque_unit_nm
        axis.barred = axis.bars_torque(torque_nm)
        self._firmware.demand_torque(0.0 if axis.barred else torque_nm)


class CyclicSynchronousVelocity(_CyclicMode):
    """CSV."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._speed_rad_s = 0.0
        self._end_tick = 0
        self._filter = axis.set_point_filter()

    def begin(self, _controlword: int) -> None:
        self.axis.begin(feeds_torque=True)
        self._filter.stand(self.axis.speed_rad_s)
        self.take_velocity()

    def take_velocity(self) -> None:
        axis, motion = self.axis, self.axis.motion
        raw = motion.target_velocity.value + motion.velocity_offset.value
        self._speed_rad_s = raw * axis.units.rad_s_per_velocity
        self._end_tick = axis.firmware.ticks + axis.interpolation_ticks()

    def run(self) -> None:
        axis = self.axis
        now = axis.speed_rad_s
        target = axis.cut_speed(self._filter.follow(self._speed_rad_s, 0.0)[0])
        left_s = (self._end_tick - axis.firmware.ticks) * axis.firmware.tick_s
        share = min(axis.period_s / max(left_s, axis.period_s), 1.0)
        change = axis.cut_change(now, share * (target - now))
        axis.run_at(now + change)


class _Interpolation:
    """Lines between set-points, each reached one interpolation period after its arrival; without another one
    the drive stays. Encoder counts, inner ticks."""

    def __init__(self, axis: SimulatedAxis) -> None:
        self._axis = axis
        self._kind = axis.path.interpolation
        self._filter = axis.set_point_filter()
        self.target = 0.0
        self._start = self._start_slope = 0.0
        self._start_tick = 0
        self._ticks = 1

    def stand(self, count: float) -> None:
        """Stay at ``count``."""
        self._start = self.target = count
        self._start_slope = 0.0
        self._filter.stand(count)

    def lead_to(self, position: int) -> None:
        """To a set-point, user position units, from where the line before has come to."""
        axis = self._axis
        ticks = axis.firmware.ticks
        self._start, self._start_slope = self._place(ticks), self._rate(ticks)
        self.target = axis.units.nearest_count_of(position, self.target)
        self._start_tick, self._ticks = ticks, axis.interpolation_ticks()

    def demand(self, ticks: int) -> tuple[float, float]:
        """The position at the tick of this period, and counts/s, behind the filter."""
        return self._filter.follow(self._place(ticks), self._rate(ticks))

    def _place(self, ticks: int) -> float:
        share, way = (ticks - self._start_tick) / self._ticks, self.target - self._start
        if share >= 1.0 or self._kind is Interpolation.NONE:
            return self.target
        place = self._start + share * way
        if self._kind is Interpolation.CUBIC:
            place += share * (1.0 - share) ** 2 * (self._start_slope * self._time_s - way)
        return place

    def _rate(self, ticks: int) -> float:
        """Counts/s; it goes on while the next set-point is a little late."""
        passed, way = ticks - self._start_tick, self.target - self._start
        if passed >= _LATE * self._ticks or self._kind is Interpolation.NONE:
            return 0.0
        rate = way / self._time_s
        if self._kind is Interpolation.CUBIC and passed < self._ticks:
            share = passed / self._ticks
            rate += (1.0 - share) * (1.0 - 3.0 * share) * (self._start_slope - rate)
        return rate

    @property
    def _time_s(self) -> float:
        """From one set-point to the next."""
        return self._ticks * self._axis.firmware.tick_s

    def over(self, ticks: int) -> bool:
        """The last line has come to its end."""
        return ticks - self._start_tick >= self._ticks


class CyclicSynchronousPosition(_CyclicMode):
    """CSP. Statusword bit 13: following error."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self.has_following_error = True
        self._line = _Interpolation(axis)
        self._lags = False
        self._cut = False

    def begin(self, _controlword: int) -> None:
        axis = self.axis
        axis.begin(feeds_torque=True)
        self._line.stand(axis.count)
        self._lags = self._cut = False
        if not axis.path.holds_stale:
            self.take_position()

    def take_position(self) -> None:
        axis, motion = self.axis, self.axis.motion
        axis.limited = False
        position = axis.cut_target(motion.target_position.value + motion.position_offset.value)
        self._cut = axis.limited
        self._line.lead_to(position)

    def run(self) -> None:
        axis = self.axis
        axis.limited = self._cut
        ticks = axis.firmware.ticks
        count, counts_per_s = self._line.demand(ticks)
        axis.follow(count, self._feed(counts_per_s))
        self._lags = axis.watch_following()

    def status_bits(self) -> int:
        return super().status_bits() | (Status.MODE_13 if self._lags else 0)

    def _feed(self, counts_per_s: float) -> float:
        """Speed that is fed forward, counts/s: 60B1h, or that of the interpolation."""
        axis = self.axis
        offset = axis.motion.velocity_offset.value
        if offset:
            return float(offset * axis.units.rad_s_per_velocity * axis.firmware.counts_per_rad)
        return counts_per_s


class InterpolatedPosition(HaltedMode):
    """IP. While bit 4 is 0 the shaft is brought to rest by 6084h, and set-points only wait; from its rising
    edge on the one that waits is in force. Statusword bit 10: the last set-point is reached."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._line = _Interpolation(axis)
        self._window = WindowTimer()
        self._enabled = False
        self._cut = False
        self._reached = False

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._enabled = False
        self._rest()
        self.begin_halt(controlword)
        self._switch(controlword)

    def receive(self, controlword: int) -> None:
        if self.take_halt(controlword):
            self._enabled = False
            self._rest()
        self._switch(controlword)

    def take_data_record(self) -> None:
        axis = self.axis
        if not self._active:
            return
        axis.limited = False
        position = axis.cut_target(axis.motion.data_record.value)
        self._cut = axis.limited
        self._line.lead_to(position)
        self._reached = False
        self._window.restart()

    def run(self) -> None:
        axis = self.axis
        if not self._active:
            return
        axis.limited = self._cut
        ticks = axis.firmware.ticks
        axis.follow(*self._line.demand(ticks))
        near = self._line.over(ticks) and self._near()
        self._reached = self._window.held(near, axis.period_s, axis.motion.position_ms.value)
        axis.watch_following()

    def status_bits(self) -> int:
        active = Status.MODE_12 if self._active and not self.axis.barred else 0
        return self.target_bit(self._reached and self._enabled) | active

    # ---- inside ---------------------------------------------------------------------------------------

    @property
    def _active(self) -> bool:
        return self._enabled and not self.halted

    def _switch(self, controlword: int) -> None:
        enabled = controlword & Control.MODE_4 != 0
        if enabled == self._enabled or self.halted:
            return
        self._enabled = enabled
        if enabled:
            self._line.stand(self.axis.count)
            self.take_data_record()
        else:
            self._rest()

    def _rest(self) -> None:
        self._reached = False
        self._window.restart()
        self.axis.stop(self.slow_down_rad_s2())

    def _near(self) -> bool:
        window = int(self.axis.motion.position_window.value)
        away = self.axis.units.length_of(self._line.target - self.axis.count)
        return window == NO_WINDOW or abs(away) <= window
