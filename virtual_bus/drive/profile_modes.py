"""PP, PV and PT, the profile modes (CiA 402-2): the drive plans, by its own ramps.

PP: set-points by hand-shake, one under way and one waiting.

    bit 5  bit 9   a new set-point (rising edge of bit 4) while a move is under way
    0      0       waits until the target of that one is reached
    1      -       takes its place at once
    0      1       follows without a stop: the move under way passes its target at its profile velocity

Bit 12 answers: 1 when a set-point was taken, 0 again when bit 4 is 0 and one more could be taken. While it
is 1 because one waits already, a further one is refused, or with bit 5 takes the place of both.

A limit switch on the way ends the move: the drive stops, drops its set-points and reaches no target.

PV: to the target velocity. Bit 10 target reached (606Dh, 606Eh), or at rest during a halt; bit 12 speed is
zero: no more once it was above 606Fh for 6070h, and again as soon as it is not. Bit 13, the slippage error of
asynchronous motors, stays 0.

PT: to the target torque (6071h) by the torque slope (6087h).
"""

from typing import Final

from servobench.drivers.cia402.profile import CHANGE_AT_ONCE, NEW_SET_POINT, RELATIVE, Status
from servobench.virtual_bus.drive.axis import SimulatedAxis, WindowTimer
from servobench.virtual_bus.drive.motion_objects import NO_WINDOW, RELATIVE_BITS, RelativeOption, RotaryOption
from servobench.virtual_bus.drive.operation_mode import HaltedMode
from servobench.virtual_bus.drive.trajectory import (
    MoveLimits,
    RampForm,
    TrajectoryPoint,
    plan_move,
    plan_speed,
    plan_stop,
)

CHANGE_ON_SET_POINT: Final = 1 << 9


class PositionTarget:
    """A target, encoder counts, and how to get there, as they were when bit 4 rose."""

    def __init__(self, target: float, limits: MoveLimits, cut: bool) -> None:
        self.target = target
        self.limits = limits
        self.cut = cut
        """Something of it was cut at a limit."""


class ProfilePosition(HaltedMode):
    """Trapezoids to one target after the other, under the position loop."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self.has_following_error = True
        self._window = WindowTimer()
        self._profile = plan_stop(0.0, 0.0, 1.0)
        self._elapsed_s = 0.0
        self._word = 0
        self._acknowledged = False
        self._reached = False
        self._lags = False
        self._passing = False
        self._given_up = False
        self._under_way: PositionTarget | None = None
        self._waiting: PositionTarget | None = None
        self._last_target = 0.0

    def begin(self, controlword: int) -> None:
        axis = self.axis
        axis.begin()
        self._word = controlword
        self._acknowledged = self._reached = self._lags = self._passing = self._given_up = False
        self._under_way = self._waiting = None
        self._come_to_rest()
        self.begin_halt(controlword)

    def receive(self, controlword: int) -> None:
        rising = controlword & ~self._word
        self._word = controlword
        if rising & NEW_SET_POINT and (not self._acknowledged or controlword & CHANGE_AT_ONCE):
            self._take(controlword)
        self._release()
        if self.take_halt(controlword):
            self._go_on()

    def run(self) -> None:
        axis = self.axis
        if self.halted:
            return
        self._elapsed_s += axis.period_s
        self._begin_waiting()
        now = self._profile.at(self._elapsed_s)
        soon = self._profile.at(self._elapsed_s + axis.period_s)
        axis.follow(now.position, soon.speed)
        if axis.barred:
            self._give_up()
        cut = self._given_up or (self._under_way is not None and self._under_way.cut)
        axis.limited = axis.limited or cut
        self._reached = self._window.held(self._arrived(), axis.period_s, axis.motion.position_ms.value)
        self._lags = axis.watch_following()

    def status_bits(self) -> int:
        bits = self.target_bit(self._reached and self._waiting is None)
        return bits | (Status.MODE_12 if self._acknowledged else 0) | (Status.MODE_13 if self._lags else 0)

    # ---- inside ---------------------------------------------------------------------------------------

    def _take(self, controlword: int) -> None:
        set_point = self._set_point(controlword)
        self._last_target = set_point.target
        self._acknowledged = True
        if controlword & CHANGE_AT_ONCE or not self._busy():
            self._waiting = None
            self._start(set_point)
            return
        self._waiting = set_point
        self._passing = controlword & CHANGE_ON_SET_POINT != 0
        if self._passing:
            self._plan_passing()

    def _set_point(self, controlword: int) -> PositionTarget:
        axis = self.axis
        units, position = axis.units, axis.motion.target_position.value
        axis.limited = False
        if controlword & RELATIVE:
            origin = self._origin()
            start = units.position_of(origin)
            target = units.moved(origin, axis.cut_target(start + position) - start)
        else:
            target = self._absolute(axis.cut_target(position))
        limits = axis.move_limits()
        return PositionTarget(target, limits, axis.limited)

    def _absolute(self, position: int) -> float:
        """Return the encoder count of a target; in 607Bh from the demand on by the way that 60F2h says, as a
        shaft that stands a count beyond its target would turn once round."""
        axis, units = self.axis, self.axis.units
        way = int(axis.motion.positioning.value) & RotaryOption.SHORTEST
        if not units.ranged or way == RotaryOption.LINEAR:
            return units.count_of(position, axis.count)
        demand = self._profile.at(self._elapsed_s).position
        if way == RotaryOption.SHORTEST:
            return units.nearest_count_of(position, demand)
        return units.next_count_of(position, demand, way == RotaryOption.POSITIVE)

    def _origin(self) -> float:
        """Return where a relative move counts from, by 60F2h; encoder counts."""
        option = int(self.axis.motion.positioning.value) & RELATIVE_BITS
        if option == RelativeOption.ACTUAL:
            return self.axis.count
        if option == RelativeOption.DEMAND:
            return self._profile.at(self._elapsed_s).position
        return self._last_target

    def _busy(self) -> bool:
        return self._under_way is not None and not self._reached

    def _release(self) -> None:
        if not self._word & NEW_SET_POINT and self._waiting is None:
            self._acknowledged = False

    def _start(self, set_point: PositionTarget) -> None:
        """From where the present profile is, or the shaft during a halt."""
        start = self._profile.at(self._elapsed_s)
        self._under_way = set_point
        self._profile = plan_move(start, set_point.target, set_point.limits)
        self._elapsed_s = 0.0
        self._reached = self._passing = self._given_up = False
        self._window.restart()

    def _plan_passing(self) -> None:
        """Let the move under way end at its profile velocity."""
        under_way = self._under_way
        if under_way is None:
            return
        limits = under_way.limits
        passing = MoveLimits(
            limits.speed, limits.acceleration, limits.deceleration, limits.speed, limits.ramp
        )
        self._start(PositionTarget(under_way.target, passing, under_way.cut))
        self._passing = True

    def _begin_waiting(self) -> None:
        waiting = self._waiting
        if waiting is None:
            return
        over = self._elapsed_s >= self._profile.duration_s
        if over if self._passing else self._reached:
            self._waiting = None
            self._start(waiting)
            self._release()

    def _arrived(self) -> bool:
        """The profile is over, and the shaft within 6067h of its end."""
        profile = self._profile
        if self._given_up or self._elapsed_s < profile.duration_s:
            return False
        window = int(self.axis.motion.position_window.value)
        if profile.end_speed != 0.0 or window == NO_WINDOW:
            return True
        return abs(self.axis.units.length_of(profile.end_position - self.axis.count)) <= window

    def _come_to_rest(self) -> None:
        axis = self.axis
        deceleration = axis.deceleration_rad_s2 * axis.firmware.counts_per_rad
        self._profile = plan_stop(axis.count, axis.counts_per_s, deceleration)
        self._elapsed_s = 0.0
        self._last_target = self._profile.end_position
        self._window.restart()

    def _give_up(self) -> None:
        self._under_way = self._waiting = None
        self._given_up = True
        self._come_to_rest()
        self._release()

    def _go_on(self) -> None:
        """After a halt: to the target of the move that it interrupted."""
        set_point, target = self._under_way, self._last_target
        self._come_to_rest()
        if set_point is not None:
            self._last_target = target
            self._start(set_point)


class ProfileVelocity(HaltedMode):
    """A ramp in speed, planned anew when the target or a rate changes."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._reached_window = WindowTimer()
        self._turning_window = WindowTimer()
        self._profile = plan_speed(TrajectoryPoint(0.0, 0.0), 0.0, 1.0, 1.0)
        self._elapsed_s = 0.0
        self._planned: tuple[float, float, float, RampForm] | None = None
        self._reached = False
        self._zero = False

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._start_anew()
        self._zero = False
        self._turning_window.restart()
        self._watch()
        self.begin_halt(controlword)

    def receive(self, controlword: int) -> None:
        if self.take_halt(controlword):
            self._start_anew()

    def run(self) -> None:
        axis = self.axis
        if not self.halted:
            self._plan()
            self._elapsed_s += axis.period_s
            axis.run_at(self._profile.at(self._elapsed_s).speed)
            if axis.barred:
                self._start_anew()
        self._watch()

    def status_bits(self) -> int:
        return self.target_bit(self._reached) | (Status.MODE_12 if self._zero else 0)

    # ---- inside ---------------------------------------------------------------------------------------

    def _start_anew(self) -> None:
        """The next plan begins at the speed that the shaft has."""
        self._planned = None
        self._reached = False
        self._reached_window.restart()

    def _plan(self) -> None:
        """Target, inside 607Fh and 6080h, and rates; rad/s, rad/s^2."""
        axis = self.axis
        most = axis.speed_of(axis.motion.max_speed.value)
        asked_for = axis.motion.target_velocity.value * axis.units.rad_s_per_velocity
        target = axis.cut_speed(min(max(asked_for, -most), most))
        axis.limited = axis.limited or target != asked_for
        planned = (target, axis.acceleration_rad_s2, axis.deceleration_rad_s2, axis.ramp())
        if planned == self._planned:
            return
        if self._planned is None:
            start = TrajectoryPoint(0.0, axis.speed_rad_s)
        else:
            start = self._profile.at(self._elapsed_s)
        self._profile = plan_speed(start, *planned)
        self._elapsed_s = 0.0
        self._planned = planned
        self._reached = False
        self._reached_window.restart()

    def _watch(self) -> None:
        axis, motion = self.axis, self.axis.motion
        velocity = axis.velocity
        near = abs(velocity - motion.target_velocity.value) <= motion.velocity_window.value
        self._reached = self._reached_window.held(near, axis.period_s, motion.velocity_ms.value)
        turning = abs(velocity) > motion.threshold.value
        held = self._turning_window.held(turning, axis.period_s, motion.threshold_ms.value)
        self._zero = not turning or (self._zero and not held)


_WINDOW: Final = 0.01
"""The torque is reached within this share of the rated one."""


class ProfileTorque(HaltedMode):
    """A ramp in torque. A halt brings the shaft to rest, and the ramp begins at no torque again."""

    def __init__(self, axis: SimulatedAxis) -> None:
        super().__init__(axis)
        self._torque_nm = 0.0
        self._reached = False

    def begin(self, controlword: int) -> None:
        self.axis.begin()
        self._torque_nm = self.axis.torque_demand_nm
        self._reached = False
        self.axis.make_torque(self._torque_nm)
        self.begin_halt(controlword)

    def receive(self, controlword: int) -> None:
        if self.take_halt(controlword):
            self._torque_nm = 0.0
            self.axis.make_torque(0.0)

    def run(self) -> None:
        axis = self.axis
        if self.halted:
            return
        target = axis.objects.target_torque.value * axis.torque_unit_nm
        step = axis.motion.torque_slope.value * axis.torque_unit_nm * axis.period_s
        self._torque_nm += min(max(target - self._torque_nm, -step), step)
        axis.make_torque(self._torque_nm)
        window = _WINDOW * 1000.0 * axis.torque_unit_nm
        self._reached = self._torque_nm == target and abs(axis.torque_nm - target) <= window

    def status_bits(self) -> int:
        return self.target_bit(self._reached)
