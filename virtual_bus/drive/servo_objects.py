"""The CiA 402 objects of state, torque, motor and load, with their types, limits and defaults.

Units of the drive at power-on: position in encoder counts (608Fh), velocity in 0.001 rev/min (60A9h),
acceleration in rev/min per second (60AAh), torque in per thousand of 6076h, current in per thousand of 6075h.
"""

import math
from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Any

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
from servobench.virtual_bus.device.object_dictionary import Access, ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode
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
