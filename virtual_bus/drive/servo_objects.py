"""The CiA 402 objects of state, torque, motor and load, with their types, limits and defaults.

Units of the drive at power-on: position in encoder counts (608Fh), velocity in 0.001 rev/min (60A9h),
acceleration in rev/min per second (60AAh), torque in per thousand of 6076h, current in per thousand of 6075h.
"""

import math

from design.motor import PmsmParameters, Transform
from drivers.canopen.data_types import DataType
from drivers.cia402.objects402 import Object
from drivers.cia402.profile import Mode
from drivers.rotation import RAD_S_PER_RPM
from virtual_bus.device.object_dictionary import Access, ObjectDictionary, Variable
from virtual_bus.drive.option_objects import add_option_codes, one_of
from virtual_bus.drive.servo_parameters import DriveParameters

I8, I16, I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
RO, RW, CONST = Access.READ_ONLY, Access.READ_WRITE, Access.CONST

PERMANENT_MAGNET_SINUSOIDAL = 10
"""Motor type 6402h: sinusoidal, PM, brushless."""
LOAD_MACHINE = 0x2100
"""Manufacturer-specific: the load machine on the simulated shaft."""
PER_THOUSAND_MAX = 0xFFFF
VELOCITY_UNIT_RAD_S = RAD_S_PER_RPM / 1000.0


class ServoObjects:
    """The variables that the drive reads and writes while it runs, by name."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        motor: PmsmParameters,
        drive: DriveParameters,
        modes: frozenset[Mode],
    ) -> None:
        self._dictionary = dictionary
        add_option_codes(dictionary, drive.abort_connection)
        self._add_state(modes)
        self._add_set_points()
        self._add_actual_values()
        self._add_limits(motor, drive)
        self._add_motor(motor)
        self._add_load_machine()

    def option(self, index: Object) -> int:
        """The present value of an option code."""
        return int(self._dictionary.variable(index).value)

    @property
    def torque_unit_nm(self) -> float:
        """A thousandth of 6076h, which a vendor's dictionary may set."""
        return float(self.rated_torque.value) * 1e-6

    @property
    def current_unit_a(self) -> float:
        """A thousandth of 6075h, as amplitude in the motor's transform."""
        return float(self.rated_current.value / self._rated_current_ma) * self._current_unit_a

    def _add(
        self, index: Object, name: str, data_type: DataType, access: Access, **options: object
    ) -> Variable:
        return self._dictionary.add(index, name, data_type, access, **options)

    def _add_state(self, modes: frozenset[Mode]) -> None:
        self.error_code = self._add(Object.ERROR_CODE, "Error code", U16, RO, mappable=True)
        self.controlword = self._add(Object.CONTROLWORD, "Controlword", U16, RW, mappable=True)
        self.statusword = self._add(Object.STATUSWORD, "Statusword", U16, RO, mappable=True)
        default = int(Mode.CYCLIC_SYNCHRONOUS_TORQUE)
        self.mode = self._add(
            Object.MODES_OF_OPERATION,
            "Modes of operation",
            I8,
            RW,
            default=default,
            mappable=True,
            check=one_of(frozenset(int(mode) for mode in (*modes, Mode.NONE))),
        )
        self.mode_display = self._add(
            Object.MODES_OF_OPERATION_DISPLAY,
            "Modes of operation display",
            I8,
            RO,
            default=default,
            mappable=True,
        )
        bits = sum(1 << (mode - 1) for mode in modes)
        self._add(Object.SUPPORTED_DRIVE_MODES, "Supported drive modes", U32, RO, default=bits, mappable=True)

    def _add_set_points(self) -> None:
        self.target_torque = self._add(Object.TARGET_TORQUE, "Target torque", I16, RW, mappable=True)
        self.torque_offset = self._add(Object.TORQUE_OFFSET, "Torque offset", I16, RW, mappable=True)

    def _add_actual_values(self) -> None:
        self.position = self._add(
            Object.POSITION_ACTUAL_VALUE, "Position actual value", I32, RO, mappable=True
        )
        self.position_internal = self._add(
            Object.POSITION_ACTUAL_INTERNAL_VALUE, "Position actual internal value", I32, RO, mappable=True
        )
        self.velocity = self._add(
            Object.VELOCITY_ACTUAL_VALUE, "Velocity actual value", I32, RO, mappable=True
        )
        self.torque = self._add(Object.TORQUE_ACTUAL_VALUE, "Torque actual value", I16, RO, mappable=True)
        self.torque_demand = self._add(Object.TORQUE_DEMAND, "Torque demand", I16, RO, mappable=True)
        self.current = self._add(Object.CURRENT_ACTUAL_VALUE, "Current actual value", I16, RO, mappable=True)

    def _add_limits(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        torque = min(
            PER_THOUSAND_MAX, math.floor(1000.0 * motor.torque_max_nm / motor.rated_torque_nm + 1e-6)
        )
        current = min(
            PER_THOUSAND_MAX, math.floor(1000.0 * motor.current_max_a / motor.rated_current_a + 1e-6)
        )
        speed = math.floor(drive.speed_limit_rad_s(motor) / RAD_S_PER_RPM + 1e-6)
        self.max_torque = self._add(
            Object.MAX_TORQUE, "Max torque", U16, RW, default=torque, high=torque, mappable=True
        )
        self.max_current = self._add(
            Object.MAX_CURRENT, "Max current", U16, RW, default=current, high=current, mappable=True
        )
        self.max_motor_speed = self._add(
            Object.MAX_MOTOR_SPEED,
            "Max motor speed",
            U32,
            RW,
            default=speed,
            low=1,
            high=speed,
            mappable=True,
        )

    def _add_motor(self, motor: PmsmParameters) -> None:
        per_rms = 3.0 if motor.transform is Transform.POWER_INVARIANT else 2.0
        rated_rms_a = motor.rated_current_a / math.sqrt(per_rms)
        self._rated_current_ma = round(1000 * rated_rms_a)
        self._current_unit_a = motor.rated_current_a / 1000.0
        self._dictionary.add(0x6402, "Motor type", U16, RO, default=PERMANENT_MAGNET_SINUSOIDAL)
        self.rated_current = self._add(
            Object.MOTOR_RATED_CURRENT,
            "Motor rated current",
            U32,
            RO,
            default=self._rated_current_ma,
            low=1,
        )
        self.rated_torque = self._add(
            Object.MOTOR_RATED_TORQUE,
            "Motor rated torque",
            U32,
            RO,
            default=round(1000 * motor.rated_torque_nm),
            low=1,
        )
        self._add(
            Object.DC_LINK_CIRCUIT_VOLTAGE,
            "DC link circuit voltage",
            U32,
            RO,
            default=round(1000 * motor.dc_bus_voltage_v),
            mappable=True,
        )

    def _add_load_machine(self) -> None:
        load = self._dictionary.add_record(LOAD_MACHINE, "Load machine")
        self.load_torque = load.add(1, "Load torque, mN m against positive speed", I32, RW, mappable=True)
        self.load_actual = load.add(2, "Load torque actual value, mN m", I32, RO, mappable=True)
