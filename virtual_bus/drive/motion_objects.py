"""The CiA 402 objects of the modes of motion, of homing, and of what watches over a motion.

Defaults are in the units that the drive starts with: encoder counts, 0.001 rev/min, rev/min per second; in
the velocity mode rev/min.
"""

import math
from enum import IntEnum
from typing import Final

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.virtual_bus.device.object_dictionary import Access, Check, ObjectDictionary, Variable
from servobench.virtual_bus.drive.homing_methods import HOMING_METHODS
from servobench.virtual_bus.drive.servo_objects import I8, I16, I32, U8, U16, U32, add_profile_object, one_of
from servobench.virtual_bus.drive.servo_parameters import DriveParameters

LINEAR_RAMP: Final = 0
"""The only torque profile type (6088h) here."""
ONE_JERK: Final = 1
"""The only profile jerk use (60A3h) here: 60A4h:1 in all parts of a profile."""
UNLIMITED: Final = 0xFFFF_FFFF
NO_WINDOW: Final = 0xFFFF_FFFF
"""Value of 6065h and 6067h that switches the watch off (CiA 402-2)."""
LINEAR: Final = 0
"""The only interpolation sub-mode (60C0h) here, with a constant time."""
LOWEST, HIGHEST = -0x8000_0000, 0x7FFF_FFFF

_MRPM: Final = RAD_S_PER_RPM / 1000.0
_FOLLOWING_MS: Final = 100
"""6066h: an error that a load step makes and the loop takes back passes."""
_SETTLED_MS: Final = 10
"""6068h, 606Eh, 6070h: within the window for so long is arrived, not passing through."""
_JERK_PER_S: Final = 50
"""60A4h of a delivered drive: the acceleration of its ramps is there after 20 ms."""
_POSITION_WINDOW_TURNS: Final = 0.002
_VELOCITY_WINDOW_MRPM: Final = 20_000
_VELOCITY_THRESHOLD_MRPM: Final = 10_000
"""Defaults of a delivered drive: 0.7 degrees, and 20 and 10 rpm, above the steps of an encoder's counts."""


class ProfileType(IntEnum):
    """6086h; 2, the "jerk-free ramp", is not here: no public text says how it goes."""

    LINEAR = 0
    SINE = 1
    """The acceleration is a sine squared, at most that of 6083h and 6084h."""
    JERK_LIMITED = 3


class RelativeOption(IntEnum):
    """Bits 0 and 1 of 60F2h: what a relative move counts from."""

    LAST_TARGET = 0
    DEMAND = 1
    ACTUAL = 2


RELATIVE_BITS: Final = 0x3


class RotaryOption(IntEnum):
    """Bits 6 and 7 of 60F2h: how an absolute move goes to its target in 607Bh; all bits between are 0."""

    LINEAR = 0x00
    """Without passing the wrap."""
    NEGATIVE = 0x40
    POSITIVE = 0x80
    SHORTEST = 0xC0
    """Upwards where both ways are alike."""


class VelocityRamp:
    """One of 6048h, 6049h and 604Ah: a change of speed, and the time that it takes."""

    def __init__(self, dictionary: ObjectDictionary, index: Object, rpm_per_s: int) -> None:
        record = dictionary.add_record(index, index.title)
        self.speed = record.add(1, "Delta speed", U32, default=rpm_per_s, low=1, mappable=True)
        self.seconds = record.add(2, "Delta time", U16, default=1, mappable=True)

    @property
    def units_s(self) -> float:
        """Units of the velocity mode per second; without limit where no time is set."""
        seconds = int(self.seconds.value)
        return max(1, int(self.speed.value)) / seconds if seconds else math.inf


class MotionObjects:
    """The variables, by name; their values are in the master's units."""

    def __init__(self, dictionary: ObjectDictionary, motor: PmsmParameters, drive: DriveParameters) -> None:
        self._dictionary = dictionary
        self._add_set_points()
        self._add_profile(motor, drive)
        self._add_velocity_mode(motor, drive)
        self._add_homing(motor, drive)
        self._add_windows(drive)
        self._add_demands()

    def _add(
        self,
        index: Object,
        data_type: DataType,
        default: int = 0,
        low: int | None = None,
        check: Check | None = None,
    ) -> Variable:
        return add_profile_object(self._dictionary, index, data_type, default=default, low=low, check=check)

    def _add_set_points(self) -> None:
        self.target_position = self._set_point(Object.TARGET_POSITION)
        self.position_offset = self._set_point(Object.POSITION_OFFSET)
        self.target_velocity = self._set_point(Object.TARGET_VELOCITY)
        self.velocity_offset = self._set_point(Object.VELOCITY_OFFSET)
        sub_mode, record = Object.INTERPOLATION_SUB_MODE_SELECT, Object.INTERPOLATION_DATA_RECORD
        self._add(sub_mode, I16, LINEAR, check=one_of((LINEAR,)))
        data = self._dictionary.add_array(record, record.title)
        self.data_record = data.add(1, "Set-point", I32, mappable=True, stored=False)
        period = self._dictionary.add_record(Object.INTERPOLATION_TIME_PERIOD, "Interpolation time period")
        self.period_value = period.add(1, "Interpolation time period value", U8, default=1, low=1)
        self.period_index = period.add(2, "Interpolation time index", I8, default=-3, low=-6, high=0)

    @property
    def slowing(self) -> Variable:
        """6084h; 6083h in a drive that does not have it (CiA 402-2, profile deceleration)."""
        return self.deceleration if Object.PROFILE_DECELERATION in self._dictionary else self.acceleration

    def _add_profile(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        slow_down = max(1, round(drive.slow_down_rad_s2(motor) / RAD_S_PER_RPM))
        quick = max(1, round(drive.quick_stop_rad_s2(motor) / RAD_S_PER_RPM))
        fastest = round(drive.speed_limit_rad_s(motor) / _MRPM)
        usual = min(round(motor.rated_speed_rad_s / _MRPM), fastest)
        limits = self._dictionary.add_array(Object.SOFTWARE_POSITION_LIMIT, "Software position limit")
        self.position_min = limits.add(1, "Minimum", I32, default=LOWEST)
        self.position_max = limits.add(2, "Maximum", I32, default=HIGHEST)
        self.max_speed = self._add(Object.MAX_PROFILE_VELOCITY, U32, fastest, 1)
        self.speed = self._add(Object.PROFILE_VELOCITY, U32, usual, 1)
        self.end_speed = self._add(Object.END_VELOCITY, U32)
        self.acceleration = self._add(Object.PROFILE_ACCELERATION, U32, slow_down, 1)
        self.deceleration = self._add(Object.PROFILE_DECELERATION, U32, slow_down, 1)
        self.quick_stop = self._add(Object.QUICK_STOP_DECELERATION, U32, quick, 1)
        self.profile_type = self._add(Object.MOTION_PROFILE_TYPE, I16, check=one_of(ProfileType))
        self._add(Object.PROFILE_JERK_USE, U8, ONE_JERK, check=one_of((ONE_JERK,)))
        jerks = self._dictionary.add_array(Object.PROFILE_JERK, Object.PROFILE_JERK.title)
        jerk = min(_JERK_PER_S * slow_down, UNLIMITED)
        self.jerk = jerks.add(1, "Profile jerk 1", U32, default=jerk, low=1, mappable=True)
        positioning = one_of(way | origin for way in RotaryOption for origin in RelativeOption)
        self.positioning = self._add(Object.POSITIONING_OPTION_CODE, U16, check=positioning)
        self.torque_slope = self._add(Object.TORQUE_SLOPE, U32, 1000, 1)
        self._add(Object.TORQUE_PROFILE_TYPE, I16, check=one_of((LINEAR_RAMP,)))
        self.max_acceleration = self._add(Object.MAX_ACCELERATION, U32, UNLIMITED, 1)
        self.max_deceleration = self._add(Object.MAX_DECELERATION, U32, UNLIMITED, 1)

    def _add_velocity_mode(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        self.vl_target = add_profile_object(self._dictionary, Object.VL_TARGET_VELOCITY, I16, stored=False)
        self.vl_demand, self.vl_velocity = (
            add_profile_object(self._dictionary, index, I16, Access.READ_ONLY)
            for index in (Object.VL_VELOCITY_DEMAND, Object.VL_VELOCITY_ACTUAL_VALUE)
        )
        amount = self._dictionary.add_array(
            Object.VL_VELOCITY_MIN_MAX_AMOUNT, Object.VL_VELOCITY_MIN_MAX_AMOUNT.title
        )
        fastest = math.floor(drive.speed_limit_rad_s(motor) / RAD_S_PER_RPM + 1e-6)
        self.vl_least = amount.add(1, "Minimum amount", U32, mappable=True)
        self.vl_most = amount.add(2, "Maximum amount", U32, default=fastest, mappable=True)
        slow_down = max(1, round(drive.slow_down_rad_s2(motor) / RAD_S_PER_RPM))
        quick = max(1, round(drive.quick_stop_rad_s2(motor) / RAD_S_PER_RPM))
        self.vl_acceleration = VelocityRamp(self._dictionary, Object.VL_VELOCITY_ACCELERATION, slow_down)
        self.vl_deceleration = VelocityRamp(self._dictionary, Object.VL_VELOCITY_DECELERATION, slow_down)
        self.vl_quick_stop = VelocityRamp(self._dictionary, Object.VL_VELOCITY_QUICK_STOP, quick)
        factor = self._dictionary.add_array(Object.VL_DIMENSION_FACTOR, Object.VL_DIMENSION_FACTOR.title)
        self.vl_numerator, self.vl_denominator = (
            factor.add(sub, part, I32, default=1, low=1)
            for sub, part in ((1, "Numerator"), (2, "Denominator"))
        )

    def _add_homing(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        self.home_offset = self._add(Object.HOME_OFFSET, I32)
        self.homing_method = self._add(Object.HOMING_METHOD, I8, 35, check=one_of(HOMING_METHODS))
        speeds = self._dictionary.add_array(Object.HOMING_SPEEDS, "Homing speeds")

        def add_speed(sub: int, what: str, part: int) -> Variable:
            usual = max(1, round(motor.rated_speed_rad_s / _MRPM / part))
            name = f"Speed during search for {what}"
            return speeds.add(sub, name, U32, default=usual, low=1, mappable=True)

        self.switch_speed, self.zero_speed = add_speed(1, "switch", 10), add_speed(2, "zero", 50)
        slow_down = max(1, round(drive.slow_down_rad_s2(motor) / RAD_S_PER_RPM))
        self.homing_acceleration = self._add(Object.HOMING_ACCELERATION, U32, slow_down, 1)
        methods = self._dictionary.add_array(Object.SUPPORTED_HOMING_METHODS, "Supported homing methods")
        for sub, method in enumerate(HOMING_METHODS, start=1):
            methods.add(sub, f"Supported homing method {sub}", I8, Access.READ_ONLY, default=method)

    def _add_windows(self, drive: DriveParameters) -> None:
        turn = drive.encoder_counts_per_revolution
        self.following_window = self._add(Object.FOLLOWING_ERROR_WINDOW, U32, turn)
        self.following_ms = self._add(Object.FOLLOWING_ERROR_TIME_OUT, U16, _FOLLOWING_MS)
        window = max(2, round(_POSITION_WINDOW_TURNS * turn))
        self.position_window = self._add(Object.POSITION_WINDOW, U32, window)
        self.position_ms = self._add(Object.POSITION_WINDOW_TIME, U16, _SETTLED_MS)
        self.velocity_window = self._add(Object.VELOCITY_WINDOW, U16, _VELOCITY_WINDOW_MRPM)
        self.velocity_ms = self._add(Object.VELOCITY_WINDOW_TIME, U16, _SETTLED_MS)
        self.threshold = self._add(Object.VELOCITY_THRESHOLD, U16, _VELOCITY_THRESHOLD_MRPM)
        self.threshold_ms = self._add(Object.VELOCITY_THRESHOLD_TIME, U16, _SETTLED_MS)

    def _add_demands(self) -> None:
        self.position_demand = self._demand(Object.POSITION_DEMAND_VALUE)
        self.position_demand_internal = self._demand(Object.POSITION_DEMAND_INTERNAL_VALUE)
        self.velocity_demand = self._demand(Object.VELOCITY_DEMAND_VALUE)
        self.following_error = self._demand(Object.FOLLOWING_ERROR_ACTUAL_VALUE)

    def _set_point(self, index: Object) -> Variable:
        return add_profile_object(self._dictionary, index, I32, stored=False)

    def _demand(self, index: Object) -> Variable:
        return add_profile_object(self._dictionary, index, I32, Access.READ_ONLY)
