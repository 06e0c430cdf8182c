"""The axis as a mode of operation sees it: where it is, what it is asked to do, and its limits.

A mode runs once per motion period, 1 ms, on the grid of the inner ticks. It hands over a position with its
speed, a speed or a torque; the inner loops go there until the next period:

    position --> P controller --+--> speed, ramped over one period --> inner speed loop --> current loops
    speed of the profile -------'
"""

import math
from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import HaltOption
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.virtual_bus.drive.failures import FOLLOWING_ERROR
from servobench.virtual_bus.drive.firmware import Firmware, InnerControl
from servobench.virtual_bus.drive.machine import SimulatedMachine
from servobench.virtual_bus.drive.motion_objects import (
    HIGHEST,
    LOWEST,
    NO_WINDOW,
    UNLIMITED,
    MotionObjects,
    ProfileType,
    VelocityRamp,
)
from servobench.virtual_bus.drive.servo_objects import ServoObjects
from servobench.virtual_bus.drive.set_point_path import SetPointFilter
from servobench.virtual_bus.drive.trajectory import LINEAR, SINE, MoveLimits, RampForm
from servobench.virtual_bus.drive.user_units import UserUnits

POSITION_BANDWIDTH: Final = 0.25
"""Gain of the position loop, 1/s, beside the bandwidth w of the speed loop, rad/s. With it both poles of
s^2 + w s + w^2 / 4, the position loop around a speed loop of first order, lie at w / 2: no overshoot."""
_FOLLOWS_SPEED: Final = int(InnerControl.SPEED.value)
REST_S: Final = 0.005
"""The shaft has come to rest when it has rested for that long at the end of a ramp. After a ramp that the
torque limit cuts it swings through rest, slow for up to 3.5 ms until it is fast again (measured)."""
_HOLDS_RAD: Final = 0.01
"""A shaft this close to a target at rest is held there, not moved on, so that the position loop works at
the end of the axis too."""
STIFFEST_RAD_S2: Final = 1e9
"""In the place of an acceleration without limit where a profile is planned with it."""


class WindowTimer:
    """Timer of a condition: 6068h, 606Eh, 6070h, 6066h."""

    def __init__(self) -> None:
        self._inside_s = 0.0

    def restart(self) -> None:
        """It is not so now."""
        self._inside_s = 0.0

    def held(self, inside: bool, period_s: float, time_ms: int) -> bool:
        """One period more; whether it has been so for ``time_ms``."""
        if not inside:
            self._inside_s = 0.0
            return False
        self._inside_s += period_s
        return self._inside_s * 1000.0 >= time_ms


class SimulatedAxis:
    """State and services shared by all modes."""

    def __init__(
        self,
        firmware: Firmware,
        objects: ServoObjects,
        motion: MotionObjects,
        units: UserUnits,
        machine: SimulatedMachine,
        fail: Callable[[int, ErrorRegister], None],
    ) -> None:
        """``fail``: a fault of the drive, by its error code."""
        self.firmware = firmware
        self.objects = objects
        self.motion = motion
        self.units = units
        self.machine = machine
        self.period_s = firmware.motion_ticks / firmware.parameters.inner_rate_hz
        self.torque_unit_nm = objects.torque_unit_nm
        self.path = firmware.parameters.path
        self.limited = False
        """A set-point was cut at a limit in the last period (statusword bit 11)."""
        self.guarded = False
        """Something can bar the way: a limit switch, or 607Dh for a mode without a target position."""
        self.barred = False
        """A limit switch or the end of the range has stopped the drive; its set-point is not followed."""
        self._barred_way = 0.0
        self.feeds_torque = False
        """60B2h is added to what the speed loop asks for: in CSP and CSV."""
        self.demand: float | None = None
        """Position asked of the position loop, encoder counts; None where there is none."""
        self._inner = firmware.inner
        self._fail = fail
        self._following = WindowTimer()
        self._counts_per_rad = firmware.counts_per_rad
        self.position_gain = POSITION_BANDWIDTH * firmware.speed_bandwidth_rad_s
        """Of the position loop, 1/s."""

    # ---- where it is ----------------------------------------------------------------------------------

    @property
    def count(self) -> float:
        """Encoder count."""
        return self._inner.count

    @property
    def counts_per_s(self) -> float:
        """Speed from which a profile can begin: what the speed loop follows, or the measured one."""
        return self.speed_rad_s * self._counts_per_rad

    @property
    def speed_rad_s(self) -> float:
        inner = self._inner
        return inner.speed_demand_rad_s if inner.control == _FOLLOWS_SPEED else inner.speed_measured_rad_s

    @property
    def velocity(self) -> float:
        """606Ch, before it is rounded."""
        return self._inner.speed_measured_rad_s * self.units.velocity_per_rad_s

    @property
    def torque_demand_nm(self) -> float:
        return self._inner.torque_demand_nm

    @property
    def torque_nm(self) -> float:
        return self._inner.torque_measured_nm

    # ---- what it is asked -----------------------------------------------------------------------------

    def begin(self, *, feeds_torque: bool = False) -> None:
        """A mode begins: nothing is asked yet."""
        self.feeds_torque = feeds_torque
        self.limited = self.barred = False
        self._barred_way = 0.0
        self.demand = None
        self._inner.torque_step_nm = 0.0
        self._inner.angle_forced = 0
        self._following.restart()

    def follow(self, count: float, counts_per_s: float) -> None:
        """Be at ``count`` now, and at ``counts_per_s`` when the period ends."""
        self.demand = count
        error_rad = (count - self._inner.count) / self._counts_per_rad
        speed = self.cut_speed(counts_per_s / self._counts_per_rad + self.position_gain * error_rad)
        holds = counts_per_s == 0.0 and abs(error_rad) < _HOLDS_RAD
        self._run(speed, self.guarded and self._bars(0.0 if holds else speed, free=False))

    def run_at(self, speed_rad_s: float) -> None:
        """Be at a speed when the period ends, by a ramp."""
        speed = self.cut_speed(speed_rad_s)
        self._run(speed, self.guarded and self._bars(speed, free=True))

    def _run(self, speed_rad_s: float, barred: bool) -> None:
        self.barred = barred
        if barred:
            self._stop_at_bar()
            return
        feed_nm = self.objects.torque_offset.value * self.torque_unit_nm if self.feeds_torque else 0.0
        change = abs(speed_rad_s - self.speed_rad_s)
        self.firmware.ramp_to_speed(speed_rad_s, change / self.period_s, feed_nm)

    def stop(self, deceleration_rad_s2: float) -> None:
        """To rest by a ramp, without the position loop."""
        self.demand = None
        self.firmware.ramp_to_speed(0.0, deceleration_rad_s2)

    def make_torque(self, torque_nm: float) -> None:
        """A torque."""
        self.barred = self.bars_torque(torque_nm)
        if self.barred:
            self._stop_at_bar()
            return
        self.firmware.demand_torque(torque_nm)
        self.firmware.control(InnerControl.TORQUE)

    def bars_torque(self, torque_nm: float) -> bool:
        """Return True if the axis is blocked in the direction of a torque."""
        return self.guarded and self._bars(torque_nm, free=True)

    def rests(self) -> bool:
        """Return True if the shaft has come to rest at the end of a ramp."""
        return self.firmware.rested_for_s() >= REST_S

    def set_point_filter(self) -> SetPointFilter:
        """For the set-points of one mode."""
        return SetPointFilter(self.path, self.period_s)

    # ---- ends of the axis -----------------------------------------------------------------------------

    def take_rating(self) -> None:
        """6076h has changed."""
        self.torque_unit_nm = self.objects.torque_unit_nm

    def take_guards(self) -> None:
        """A limit switch or 607Dh has changed."""
        self.guarded = self.machine.has_limits or self._range() is not None

    def _bars(self, way: float, free: bool) -> bool:
        """Return True if the axis is blocked in the direction of a speed or torque of that sign: at a limit
        switch, or for a ``free`` motion if it could no longer stop inside 607Dh. It stays blocked until the
        other direction, or rest, is commanded."""
        if way * self._barred_way <= 0.0:
            self._barred_way = 0.0
            if way != 0.0 and (self.machine.blocked(way) or (free and self._leaves_range(way))):
                self._barred_way = math.copysign(1.0, way)
        return self._barred_way != 0.0

    def _stop_at_bar(self) -> None:
        self.limited = True
        self.stop(self.quick_stop_rad_s2)

    def _leaves_range(self, way: float) -> bool:
        ends = self._range()
        if ends is None:
            return False
        speed = self._inner.speed_measured_rad_s
        braking = speed * abs(speed) / (2.0 * self.quick_stop_rad_s2) * self._counts_per_rad
        place = self.units.length_of(self.count + braking - self.units.origin) - self.units.turned(self.count)
        upwards = (way > 0.0) == (self.units.counts_per_position > 0.0)
        return place >= ends[1] if upwards else place <= ends[0]

    def _range(self) -> tuple[int, int] | None:
        """607Dh, which counts from the machine's home and so is corrected by 607Ch; None without limits."""
        low, high = int(self.motion.position_min.value), int(self.motion.position_max.value)
        if low >= high or (low == LOWEST and high == HIGHEST):
            return None
        offset = int(self.motion.home_offset.value)
        return low - offset, high - offset

    # ---- limits ---------------------------------------------------------------------------------------

    def cut_speed(self, speed_rad_s: float) -> float:
        """A speed inside 6080h."""
        most = self._inner.speed_max_rad_s
        cut = min(max(speed_rad_s, -most), most)
        self.limited = self.limited or cut != speed_rad_s
        return cut

    def cut_target(self, position: int) -> int:
        """A target inside 607Dh, where 607Bh has wrapped it."""
        ends = self._range()
        if ends is None:
            return position
        if self.units.ranged:
            position = self.units.within(position)
        cut = min(max(position, ends[0]), ends[1])
        self.limited = self.limited or cut != position
        return cut

    def move_limits(self) -> MoveLimits:
        """6081h..6084h inside 607Fh, 6080h, 60C5h and 60C6h, by the ramps of 6086h; counts and seconds."""
        motion = self.motion
        speed = min(motion.speed.value, motion.max_speed.value)
        self.limited = self.limited or speed != motion.speed.value
        return MoveLimits(
            self._counts_per_rad * self.cut_speed(self.speed_of(speed)),
            self._counts_per_rad * self.acceleration_rad_s2,
            self._counts_per_rad * self.deceleration_rad_s2,
            self._counts_per_rad * self.speed_of(motion.end_speed.value),
            self.ramp(self._counts_per_rad),
        )

    def ramp(self, per_rad: float = 1.0) -> RampForm:
        """The form of ramps by 6086h and 60A4h, lengths in so many units per rad."""
        motion = self.motion
        form = int(motion.profile_type.value)
        if form == ProfileType.SINE:
            return SINE
        jerk = int(motion.jerk.value)
        if form != ProfileType.JERK_LIMITED or not jerk:
            return LINEAR
        return RampForm(per_rad * jerk * self.units.rad_s3_per_jerk)

    def cut_change(self, speed_rad_s: float, change_rad_s: float) -> float:
        """A change of speed within one period, inside 60C5h if it goes faster and 60C6h if slower."""
        faster = (speed_rad_s + 0.5 * change_rad_s) * change_rad_s > 0.0
        raw = (self.motion.max_acceleration if faster else self.motion.max_deceleration).value
        if raw == UNLIMITED:
            return change_rad_s
        most = raw * self.units.rad_s2_per_acceleration * self.period_s
        cut = min(max(change_rad_s, -most), most)
        self.limited = self.limited or cut != change_rad_s
        return float(cut)

    @property
    def rad_s_per_vl(self) -> float:
        """rad/s of a unit of the velocity mode, by 604Ch; bit 6 of 607Eh turns its sign too."""
        motion = self.motion
        numerator, denominator = int(motion.vl_numerator.value), int(motion.vl_denominator.value)
        rpm = numerator / denominator if numerator and denominator else 1.0
        return math.copysign(rpm * RAD_S_PER_RPM, self.units.rad_s_per_velocity)

    def ramp_rad_s2(self, ramp: VelocityRamp) -> float:
        """Return a ramp of the velocity mode."""
        return min(ramp.units_s * abs(self.rad_s_per_vl), STIFFEST_RAD_S2)

    def interpolation_ticks(self) -> int:
        """60C2h in inner ticks, one motion period at least."""
        seconds = self.motion.period_value.value * 10.0**self.motion.period_index.value
        return max(round(float(seconds) / self.firmware.tick_s), self.firmware.motion_ticks)

    def speed_of(self, velocity: int) -> float:
        """rad/s of a user velocity without a sign."""
        return velocity * abs(self.units.rad_s_per_velocity)

    @property
    def acceleration_rad_s2(self) -> float:
        """6083h inside 60C5h."""
        return self._limited_rate(self.motion.acceleration.value, self.motion.max_acceleration.value)

    @property
    def deceleration_rad_s2(self) -> float:
        """6084h inside 60C6h."""
        return self._limited_rate(self.motion.slowing.value, self.motion.max_deceleration.value)

    @property
    def quick_stop_rad_s2(self) -> float:
        """6085h, which no other limit weakens."""
        return float(self.motion.quick_stop.value * self.units.rad_s2_per_acceleration)

    @property
    def homing_rad_s2(self) -> float:
        """609Ah inside 60C5h and 60C6h."""
        most = min(self.motion.max_acceleration.value, self.motion.max_deceleration.value)
        return self._limited_rate(self.motion.homing_acceleration.value, most)

    def _limited_rate(self, rate: int, most: int) -> float:
        value = rate if most == UNLIMITED else min(rate, most)
        return float(value * self.units.rad_s2_per_acceleration)

    def halt_rad_s2(self, slow_down_rad_s2: float, quick_stop_rad_s2: float) -> float:
        """By 605Dh, of the ramps of the mode."""
        option = self.objects.option(Object.HALT_OPTION)
        if option == HaltOption.SLOW_DOWN_RAMP:
            return slow_down_rad_s2
        return quick_stop_rad_s2 if option == HaltOption.QUICK_STOP_RAMP else STIFFEST_RAD_S2

    def scale_supply(self, share: float) -> None:
        """The source gives that share of its voltage, from the next inner tick on."""
        volts = self.firmware.scale_supply(share)
        if self.firmware.parameters.supply is None:
            self.objects.dc_link.value = round(1000.0 * volts)

    # ---- what watches over it -------------------------------------------------------------------------

    @property
    def following_error(self) -> int:
        """60F4h, user units."""
        demand = self.demand
        return 0 if demand is None else self.units.length_of(demand - self.count)

    def watch_following(self) -> bool:
        """Return True if 60F4h has exceeded 6065h for 6066h: the mode's bit 13; the drive is then made to
        fail."""
        window = self.motion.following_window.value
        outside = window != NO_WINDOW and abs(self.following_error) > window
        failed = self._following.held(outside, self.period_s, self.motion.following_ms.value)
        if failed:
            self._fail(FOLLOWING_ERROR, ErrorRegister.DEVICE_PROFILE)
        return failed
