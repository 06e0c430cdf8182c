"""The CiA 402 objects of state, torque, motor and load, with their types, limits and defaults.

Units of the drive at power-on: position in encoder counts (608Fh), velocity in 0.001 rev/min (60A9h),
acceleration in rev/min per second (60AAh), torque in per thousand of 6076h, current in per thousand of 6075h.

The CiA 402 objects of the modes of motion, of homing, and of what watches over a motion.

Defaults are in the units that the drive starts with: encoder counts, 0.001 rev/min, rev/min per second; in
the velocity mode rev/min.
"""

import math
from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Any, Final

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    AbortConnectionOption,
    DisableOperationOption,
    FaultReactionOption,
    HaltOption,
    Mode,
    QuickStopOption,
    ShutdownOption,
    supported_mode_bit,
)
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.virtual_bus.device.object_dictionary import Access, Check, ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.homing_methods import HOMING_METHODS
from servobench.virtual_bus.drive.load_object import (
    LOAD_ACTUAL_SUB,
    LOAD_COURSE_SUB,
    LOAD_DELAY_SUB,
    LOAD_MACHINE,
    LOAD_NUMBER_SUB,
    LOAD_TORQUE_SUB,
    LoadCourse,
)
from servobench.virtual_bus.drive.power_stage import current_per_rms
from servobench.virtual_bus.drive.servo_parameters import DriveParameters

I8, I16, I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
RO, RW, CONST = Access.READ_ONLY, Access.READ_WRITE, Access.CONST

PERMANENT_MAGNET_SINUSOIDAL = 10
"""Motor type 6402h: sinusoidal, PM, brushless."""
ROTOR_FRAME = 0x2101
"""Manufacturer-specific: what the current loops see and do."""
PER_THOUSAND_MAX = 0xFFFF


class ServoObjects:
    """The variables that the drive reads and writes while it runs, by name."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        motor: PmsmParameters,
        drive: DriveParameters,
        modes: frozenset[Mode],
    ) -> None:
        self._dictionary, self._modes = dictionary, modes
        _add_option_codes(dictionary, drive.abort_connection)
        self._add_state()
        self._add_values()
        self._add_limits(motor, drive)
        self._add_motor(motor)
        self._add_rotor_frame()
        self._add_load_machine(drive)

    def option(self, index: Object) -> int:
        """The present value of an option code."""
        return int(self._dictionary.variable(index).value)

    @property
    def torque_limits(self) -> tuple[Variable, Variable, Variable]:
        """6072h, 60E0h and 60E1h."""
        return self.max_torque, self.torque_up, self.torque_down

    def torque_limits_nm(self, most_nm: float) -> tuple[float, float]:
        """Largest positive and negative torque by 6072h, 60E0h and 60E1h (CiA 402-2), both at least 0.
        ``most_nm``: that of the motor."""
        most, up, down = (int(each.value) for each in self.torque_limits)
        unit_nm = self.torque_unit_nm
        return min(min(most, up) * unit_nm, most_nm), min(min(most, down) * unit_nm, most_nm)

    @property
    def torque_unit_nm(self) -> float:
        """A thousandth of 6076h, which a vendor's dictionary may set."""
        return float(self.rated_torque.value) * 1e-6

    @property
    def current_unit_a(self) -> float:
        """A thousandth of 6075h, as amplitude in the motor's transform."""
        return float(self.rated_current.value / self._rated_current_ma) * self._current_unit_a

    @property
    def voltage_unit_v(self) -> float:
        """A thousandth of 6079h."""
        return float(self.dc_link.value) * 1e-6

    def _add(self, index: Object, data_type: DataType, access: Access, **options: Any) -> Variable:
        return add_profile_object(self._dictionary, index, data_type, access, **options)

    def _add_state(self) -> None:
        self.error_code = self._add(Object.ERROR_CODE, U16, RO)
        self.controlword = self._add(Object.CONTROLWORD, U16, RW, stored=False)
        self.statusword = self._add(Object.STATUSWORD, U16, RO)
        first = int(Mode.CYCLIC_SYNCHRONOUS_TORQUE)
        self.mode = self._add(
            Object.MODES_OF_OPERATION, I8, RW, default=first, check=self._refused_mode, stored=False
        )
        self.mode_display = self._add(Object.MODES_OF_OPERATION_DISPLAY, I8, RO, default=first)
        bits = sum(supported_mode_bit(mode) for mode in self._modes)
        self.supported_modes = self._add(Object.SUPPORTED_DRIVE_MODES, U32, RO, default=bits)

    def _refused_mode(self, mode: int) -> AbortCode | None:
        """6060h takes what 6502h tells, and 0, which is no change."""
        known = mode == Mode.NONE or (
            mode in self._modes and self.supported_modes.value & supported_mode_bit(Mode(mode))
        )
        return None if known else AbortCode.INVALID_VALUE

    def _add_values(self) -> None:
        self.target_torque = self._add(Object.TARGET_TORQUE, I16, RW, stored=False)
        self.torque_offset = self._add(Object.TORQUE_OFFSET, I16, RW, stored=False)
        self.position = self._add(Object.POSITION_ACTUAL_VALUE, I32, RO)
        self.position_internal = self._add(Object.POSITION_ACTUAL_INTERNAL_VALUE, I32, RO)
        self.velocity = self._add(Object.VELOCITY_ACTUAL_VALUE, I32, RO)
        self.torque = self._add(Object.TORQUE_ACTUAL_VALUE, I16, RO)
        self.torque_demand = self._add(Object.TORQUE_DEMAND, I16, RO)
        self.current = self._add(Object.CURRENT_ACTUAL_VALUE, I16, RO)

    def _add_limits(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        torque = _per_thousand(motor.torque_max_nm / motor.rated_torque_nm)
        self.max_torque = self._add(Object.MAX_TORQUE, U16, RW, default=torque, high=torque)
        self.torque_up = self._add(Object.POSITIVE_TORQUE_LIMIT, U16, RW, default=PER_THOUSAND_MAX)
        self.torque_down = self._add(Object.NEGATIVE_TORQUE_LIMIT, U16, RW, default=PER_THOUSAND_MAX)
        current = _per_thousand(motor.current_max_a / motor.rated_current_a)
        self.max_current = self._add(Object.MAX_CURRENT, U16, RW, default=current, high=current)
        speed = math.floor(drive.speed_limit_rad_s(motor) / RAD_S_PER_RPM + 1e-6)
        self.max_motor_speed = self._add(Object.MAX_MOTOR_SPEED, U32, RW, default=speed, low=1, high=speed)

    def _add_motor(self, motor: PmsmParameters) -> None:
        self._rated_current_ma = rated_ma = round(1000 * motor.rated_current_a / current_per_rms(motor))
        self._current_unit_a = motor.rated_current_a / 1000.0
        rated_mnm, bus_mv = round(1000 * motor.rated_torque_nm), round(1000 * motor.dc_bus_voltage_v)
        self._add(Object.MOTOR_TYPE, U16, RO, default=PERMANENT_MAGNET_SINUSOIDAL, mappable=False)
        self.rated_current = self._add(
            Object.MOTOR_RATED_CURRENT, U32, RO, default=rated_ma, low=1, mappable=False
        )
        self.rated_torque = self._add(
            Object.MOTOR_RATED_TORQUE, U32, RO, default=rated_mnm, low=1, mappable=False
        )
        self.dc_link = self._add(Object.DC_LINK_CIRCUIT_VOLTAGE, U32, RO, default=bus_mv)

    def _add_rotor_frame(self) -> None:
        """Currents in thousandths of 6075h, as 6078h, and voltages in thousandths of 6079h."""
        record = self._dictionary.add_record(ROTOR_FRAME, "Currents and voltages in the rotor's frame")
        self.current_d = record.add(1, "d current actual value", I16, RO, mappable=True)
        self.current_q = record.add(2, "q current actual value", I16, RO, mappable=True)
        self.current_q_demand = record.add(3, "q current demand", I16, RO, mappable=True)
        self.voltage_d = record.add(4, "d voltage", I16, RO, mappable=True)
        self.voltage_q = record.add(5, "q voltage", I16, RO, mappable=True)

    def _add_load_machine(self, drive: DriveParameters) -> None:
        load = self._dictionary.add_record(LOAD_MACHINE, "Load machine")
        self.load_torque = load.add(
            LOAD_TORQUE_SUB, "Load torque, mN m against positive speed", I32, RW, mappable=True, stored=False
        )
        self.load_actual = load.add(LOAD_ACTUAL_SUB, "Load torque actual value, mN m", I32, RO, mappable=True)
        self.load_course = load.add(
            LOAD_COURSE_SUB, "Load torque over time", U8, RW, high=int(max(LoadCourse)), stored=False
        )
        number = 0 if drive.load is None else drive.load.number
        load.add(LOAD_NUMBER_SUB, "Load torque over time, its number", U32, CONST, default=number)
        self.load_delay = load.add(
            LOAD_DELAY_SUB, "Load torque over time, delay in us", U32, RW, stored=False
        )


def add_profile_object(
    dictionary: ObjectDictionary, index: Object, data_type: DataType, access: Access = RW, **options: Any
) -> Variable:
    """A variable of the device profile, mappable unless ``options`` say otherwise, by the standard's name."""
    return dictionary.add(index, index.title, data_type, access, **{"mappable": True, **options})


def one_of(values: Iterable[int]) -> Callable[[int], AbortCode | None]:
    """A check that refuses what is not in ``values``."""
    known = frozenset(map(int, values))
    return lambda value: None if value in known else AbortCode.INVALID_VALUE


def _add_option_codes(dictionary: ObjectDictionary, abort_connection: AbortConnectionOption) -> None:
    """6007h and 605Ah..605Eh, how the drive stops and when; each takes only what the drive can do."""
    defaults: dict[Object, IntEnum] = {
        Object.ABORT_CONNECTION_OPTION: abort_connection,
        Object.QUICK_STOP_OPTION: QuickStopOption.QUICK_STOP_RAMP,
        Object.SHUTDOWN_OPTION: ShutdownOption.DISABLE,
        Object.DISABLE_OPERATION_OPTION: DisableOperationOption.SLOW_DOWN_RAMP,
        Object.HALT_OPTION: HaltOption.SLOW_DOWN_RAMP,
        Object.FAULT_REACTION_OPTION: FaultReactionOption.QUICK_STOP_RAMP,
    }
    for index, default in defaults.items():
        choices, value = one_of(type(default)), int(default)
        dictionary.add(index, f"{index.title} code", DataType.INTEGER16, default=value, check=choices)


def _per_thousand(ratio: float) -> int:
    return min(PER_THOUSAND_MAX, math.floor(1000.0 * ratio + 1e-6))


_I8, _I16, _I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
_U8, _U16, _U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32

LINEAR_RAMP: Final = 0
"""The only motion profile type and torque profile type here: trapezoids."""
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
_POSITION_WINDOW_TURNS: Final = 0.002
_VELOCITY_WINDOW_MRPM: Final = 20_000
_VELOCITY_THRESHOLD_MRPM: Final = 10_000
"""Defaults of a delivered drive: 0.7 degrees, and 20 and 10 rpm, above the steps of an encoder's counts."""


class RelativeOption(IntEnum):
    """Bits 0 and 1 of 60F2h: what a relative move counts from; the option's other bits are 0 here."""

    LAST_TARGET = 0
    DEMAND = 1
    ACTUAL = 2


class VelocityRamp:
    """One of 6048h, 6049h and 604Ah: a change of speed, and the time that it takes."""

    def __init__(self, dictionary: ObjectDictionary, index: Object, rpm_per_s: int) -> None:
        record = dictionary.add_record(index, index.title)
        self.speed = record.add(1, "Delta speed", _U32, default=rpm_per_s, low=1, mappable=True)
        self.seconds = record.add(2, "Delta time", _U16, default=1, mappable=True)

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
        self._add(sub_mode, _I16, LINEAR, check=one_of((LINEAR,)))
        data = self._dictionary.add_array(record, record.title)
        self.data_record = data.add(1, "Set-point", _I32, mappable=True, stored=False)
        period = self._dictionary.add_record(Object.INTERPOLATION_TIME_PERIOD, "Interpolation time period")
        self.period_value = period.add(1, "Interpolation time period value", _U8, default=1, low=1)
        self.period_index = period.add(2, "Interpolation time index", _I8, default=-3, low=-6, high=0)

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
        self.position_min = limits.add(1, "Minimum", _I32, default=LOWEST)
        self.position_max = limits.add(2, "Maximum", _I32, default=HIGHEST)
        self.max_speed = self._add(Object.MAX_PROFILE_VELOCITY, _U32, fastest, 1)
        self.speed = self._add(Object.PROFILE_VELOCITY, _U32, usual, 1)
        self.end_speed = self._add(Object.END_VELOCITY, _U32)
        self.acceleration = self._add(Object.PROFILE_ACCELERATION, _U32, slow_down, 1)
        self.deceleration = self._add(Object.PROFILE_DECELERATION, _U32, slow_down, 1)
        self.quick_stop = self._add(Object.QUICK_STOP_DECELERATION, _U32, quick, 1)
        self._add(Object.MOTION_PROFILE_TYPE, _I16, check=one_of((LINEAR_RAMP,)))
        relative = one_of(RelativeOption)
        self.relative = self._add(Object.POSITIONING_OPTION_CODE, _U16, check=relative)
        self.torque_slope = self._add(Object.TORQUE_SLOPE, _U32, 1000, 1)
        self._add(Object.TORQUE_PROFILE_TYPE, _I16, check=one_of((LINEAR_RAMP,)))
        self.max_acceleration = self._add(Object.MAX_ACCELERATION, _U32, UNLIMITED, 1)
        self.max_deceleration = self._add(Object.MAX_DECELERATION, _U32, UNLIMITED, 1)

    def _add_velocity_mode(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        self.vl_target = add_profile_object(self._dictionary, Object.VL_TARGET_VELOCITY, _I16, stored=False)
        self.vl_demand, self.vl_velocity = (
            add_profile_object(self._dictionary, index, _I16, Access.READ_ONLY)
            for index in (Object.VL_VELOCITY_DEMAND, Object.VL_VELOCITY_ACTUAL_VALUE)
        )
        amount = self._dictionary.add_array(
            Object.VL_VELOCITY_MIN_MAX_AMOUNT, Object.VL_VELOCITY_MIN_MAX_AMOUNT.title
        )
        fastest = math.floor(drive.speed_limit_rad_s(motor) / RAD_S_PER_RPM + 1e-6)
        self.vl_least = amount.add(1, "Minimum amount", _U32, mappable=True)
        self.vl_most = amount.add(2, "Maximum amount", _U32, default=fastest, mappable=True)
        slow_down = max(1, round(drive.slow_down_rad_s2(motor) / RAD_S_PER_RPM))
        quick = max(1, round(drive.quick_stop_rad_s2(motor) / RAD_S_PER_RPM))
        self.vl_acceleration = VelocityRamp(self._dictionary, Object.VL_VELOCITY_ACCELERATION, slow_down)
        self.vl_deceleration = VelocityRamp(self._dictionary, Object.VL_VELOCITY_DECELERATION, slow_down)
        self.vl_quick_stop = VelocityRamp(self._dictionary, Object.VL_VELOCITY_QUICK_STOP, quick)
        factor = self._dictionary.add_array(Object.VL_DIMENSION_FACTOR, Object.VL_DIMENSION_FACTOR.title)
        self.vl_numerator, self.vl_denominator = (
            factor.add(sub, part, _I32, default=1, low=1)
            for sub, part in ((1, "Numerator"), (2, "Denominator"))
        )

    def _add_homing(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        self.home_offset = self._add(Object.HOME_OFFSET, _I32)
        self.homing_method = self._add(Object.HOMING_METHOD, _I8, 35, check=one_of(HOMING_METHODS))
        speeds = self._dictionary.add_array(Object.HOMING_SPEEDS, "Homing speeds")

        def add_speed(sub: int, what: str, part: int) -> Variable:
            usual = max(1, round(motor.rated_speed_rad_s / _MRPM / part))
            name = f"Speed during search for {what}"
            return speeds.add(sub, name, _U32, default=usual, low=1, mappable=True)

        self.switch_speed, self.zero_speed = add_speed(1, "switch", 10), add_speed(2, "zero", 50)
        slow_down = max(1, round(drive.slow_down_rad_s2(motor) / RAD_S_PER_RPM))
        self.homing_acceleration = self._add(Object.HOMING_ACCELERATION, _U32, slow_down, 1)
        methods = self._dictionary.add_array(Object.SUPPORTED_HOMING_METHODS, "Supported homing methods")
        for sub, method in enumerate(HOMING_METHODS, start=1):
            methods.add(sub, f"Supported homing method {sub}", _I8, Access.READ_ONLY, default=method)

    def _add_windows(self, drive: DriveParameters) -> None:
        turn = drive.encoder_counts_per_revolution
        self.following_window = self._add(Object.FOLLOWING_ERROR_WINDOW, _U32, turn)
        self.following_ms = self._add(Object.FOLLOWING_ERROR_TIME_OUT, _U16, _FOLLOWING_MS)
        window = max(2, round(_POSITION_WINDOW_TURNS * turn))
        self.position_window = self._add(Object.POSITION_WINDOW, _U32, window)
        self.position_ms = self._add(Object.POSITION_WINDOW_TIME, _U16, _SETTLED_MS)
        self.velocity_window = self._add(Object.VELOCITY_WINDOW, _U16, _VELOCITY_WINDOW_MRPM)
        self.velocity_ms = self._add(Object.VELOCITY_WINDOW_TIME, _U16, _SETTLED_MS)
        self.threshold = self._add(Object.VELOCITY_THRESHOLD, _U16, _VELOCITY_THRESHOLD_MRPM)
        self.threshold_ms = self._add(Object.VELOCITY_THRESHOLD_TIME, _U16, _SETTLED_MS)

    def _add_demands(self) -> None:
        self.position_demand = self._demand(Object.POSITION_DEMAND_VALUE)
        self.position_demand_internal = self._demand(Object.POSITION_DEMAND_INTERNAL_VALUE)
        self.velocity_demand = self._demand(Object.VELOCITY_DEMAND_VALUE)
        self.following_error = self._demand(Object.FOLLOWING_ERROR_ACTUAL_VALUE)

    def _set_point(self, index: Object) -> Variable:
        return add_profile_object(self._dictionary, index, _I32, stored=False)

    def _demand(self, index: Object) -> Variable:
        return add_profile_object(self._dictionary, index, _I32, Access.READ_ONLY)
