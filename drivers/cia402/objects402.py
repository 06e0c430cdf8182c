"""Object indices of CiA 402-2 and the unit words that scale them.

A unit word (0x60A8 position, 0x60A9 velocity) is ``prefix | numerator | denominator | 0``, one octet each;
the prefix is a signed power of ten (CiA 402-2 clause 8.4, codes of CiA 303-2).

Objects of CiA 301 and CiA 402 that the drive client writes, with the reason for each.

To have the client write a further object, add a line here; docs/make_writes.py then renews the page.
"""

from collections.abc import Iterable
from enum import IntEnum
from functools import cached_property
from typing import Final

from servobench.drivers.canopen.nmt_states import NODE_ID_MAX
from servobench.drivers.canopen.objects301 import (
    PDO_ENTRIES_MAX,
    PDOS_MAX,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    Cia301,
)
from servobench.drivers.canopen.write_list import ListedWrite, WriteList

INTERLOCK: Final = 1 << 3
"""Bit of 60FDh: motion is forbidden; shows safe torque off on some drives."""


class Object(IntEnum):
    """Index of a CiA 402 object, with its unit: fixed by the standard, or "user" if a unit word scales it."""

    ABORT_CONNECTION_OPTION = 0x6007
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    VL_TARGET_VELOCITY = 0x6042
    """r/min divided by 0x604C, like everything in the velocity mode."""
    VL_VELOCITY_DEMAND = 0x6043
    VL_VELOCITY_ACTUAL_VALUE = 0x6044
    VL_VELOCITY_MIN_MAX_AMOUNT = 0x6046
    """Sub 1 minimum, sub 2 maximum."""
    VL_VELOCITY_ACCELERATION = 0x6048
    """Sub 1: change of speed; sub 2: its time in seconds; likewise the next two."""
    VL_VELOCITY_DECELERATION = 0x6049
    VL_VELOCITY_QUICK_STOP = 0x604A
    VL_DIMENSION_FACTOR = 0x604C
    """Sub 1 over sub 2: r/min of one unit."""
    QUICK_STOP_OPTION = 0x605A
    SHUTDOWN_OPTION = 0x605B
    DISABLE_OPERATION_OPTION = 0x605C
    HALT_OPTION = 0x605D
    FAULT_REACTION_OPTION = 0x605E
    MODES_OF_OPERATION = 0x6060
    MODES_OF_OPERATION_DISPLAY = 0x6061
    POSITION_DEMAND_VALUE = 0x6062
    POSITION_ACTUAL_INTERNAL_VALUE = 0x6063
    """Encoder increments."""
    POSITION_ACTUAL_VALUE = 0x6064
    """User position unit."""
    FOLLOWING_ERROR_WINDOW = 0x6065
    FOLLOWING_ERROR_TIME_OUT = 0x6066
    """ms."""
    POSITION_WINDOW = 0x6067
    POSITION_WINDOW_TIME = 0x6068
    """ms."""
    VELOCITY_DEMAND_VALUE = 0x606B
    VELOCITY_ACTUAL_VALUE = 0x606C
    """User velocity unit."""
    VELOCITY_WINDOW = 0x606D
    VELOCITY_WINDOW_TIME = 0x606E
    """ms."""
    VELOCITY_THRESHOLD = 0x606F
    VELOCITY_THRESHOLD_TIME = 0x6070
    """ms."""
    TARGET_TORQUE = 0x6071
    """Per thousand of 0x6076."""
    MAX_TORQUE = 0x6072
    """Per thousand of 0x6076."""
    MAX_CURRENT = 0x6073
    """Per thousand of 0x6075."""
    TORQUE_DEMAND = 0x6074
    """Per thousand of 0x6076."""
    MOTOR_RATED_CURRENT = 0x6075
    """mA."""
    MOTOR_RATED_TORQUE = 0x6076
    """mN m."""
    TORQUE_ACTUAL_VALUE = 0x6077
    """Per thousand of 0x6076."""
    CURRENT_ACTUAL_VALUE = 0x6078
    """Per thousand of 0x6075."""
    DC_LINK_CIRCUIT_VOLTAGE = 0x6079
    """mV."""
    TARGET_POSITION = 0x607A
    POSITION_RANGE_LIMIT = 0x607B
    """Sub 1 minimum, sub 2 maximum."""
    HOME_OFFSET = 0x607C
    SOFTWARE_POSITION_LIMIT = 0x607D
    """Sub 1 minimum, sub 2 maximum."""
    POLARITY = 0x607E
    MAX_PROFILE_VELOCITY = 0x607F
    MAX_MOTOR_SPEED = 0x6080
    """rev/min."""
    PROFILE_VELOCITY = 0x6081
    END_VELOCITY = 0x6082
    PROFILE_ACCELERATION = 0x6083
    PROFILE_DECELERATION = 0x6084
    QUICK_STOP_DECELERATION = 0x6085
    """User acceleration unit."""
    MOTION_PROFILE_TYPE = 0x6086
    TORQUE_SLOPE = 0x6087
    """Per thousand of 0x6076, per second."""
    TORQUE_PROFILE_TYPE = 0x6088
    POSITION_ENCODER_RESOLUTION = 0x608F
    """Sub 1 encoder increments per sub 2 motor revolutions."""
    VELOCITY_ENCODER_RESOLUTION = 0x6090
    GEAR_RATIO = 0x6091
    FEED_CONSTANT = 0x6092
    POSITION_FACTOR = 0x6093
    """Encoder increments per user position unit, of DSP 402 version 2."""
    VELOCITY_ENCODER_FACTOR = 0x6094
    """Encoder increments per second per user velocity unit, of DSP 402 version 2."""
    VELOCITY_FACTOR = 0x6096
    ACCELERATION_FACTOR = 0x6097
    """Acceleration units per position unit and second squared; otherwise in DSP 402 version 2."""
    HOMING_METHOD = 0x6098
    HOMING_SPEEDS = 0x6099
    """Sub 1 while searching for the switch, sub 2 for the zero."""
    HOMING_ACCELERATION = 0x609A
    PROFILE_JERK_USE = 0x60A3
    PROFILE_JERK = 0x60A4
    SI_UNIT_POSITION = 0x60A8
    SI_UNIT_VELOCITY = 0x60A9
    SI_UNIT_ACCELERATION = 0x60AA
    SI_UNIT_JERK = 0x60AB
    POSITION_OFFSET = 0x60B0
    VELOCITY_OFFSET = 0x60B1
    TORQUE_OFFSET = 0x60B2
    """Per thousand of 0x6076."""
    INTERPOLATION_SUB_MODE_SELECT = 0x60C0
    INTERPOLATION_DATA_RECORD = 0x60C1
    """Sub 1: the set-point of interpolated position, user position unit."""
    INTERPOLATION_TIME_PERIOD = 0x60C2
    TOUCH_PROBE_FUNCTION = 0x60B8
    TOUCH_PROBE_STATUS = 0x60B9
    TOUCH_PROBE_1_POSITIVE_EDGE = 0x60BA
    TOUCH_PROBE_1_NEGATIVE_EDGE = 0x60BB
    TOUCH_PROBE_2_POSITIVE_EDGE = 0x60BC
    TOUCH_PROBE_2_NEGATIVE_EDGE = 0x60BD
    """User position unit, as the three above."""
    MAX_ACCELERATION = 0x60C5
    MAX_DECELERATION = 0x60C6
    TOUCH_PROBE_SOURCE = 0x60D0
    POSITIVE_TORQUE_LIMIT = 0x60E0
    NEGATIVE_TORQUE_LIMIT = 0x60E1
    """Per thousand of 0x6076, as the one above."""
    SUPPORTED_HOMING_METHODS = 0x60E3
    """Sub 1 and on: one method each."""
    ADDITIONAL_POSITION = 0x60E4
    """Sub 1: of a second encoder."""
    COMMUTATION_ANGLE = 0x60EA
    """65536 of an electrical turn."""
    POSITIONING_OPTION_CODE = 0x60F2
    FOLLOWING_ERROR_ACTUAL_VALUE = 0x60F4
    POSITION_DEMAND_INTERNAL_VALUE = 0x60FC
    """Encoder increments."""
    DIGITAL_INPUTS = 0x60FD
    DIGITAL_OUTPUTS = 0x60FE
    TARGET_VELOCITY = 0x60FF
    MOTOR_TYPE = 0x6402
    SUPPORTED_DRIVE_MODES = 0x6502

    @cached_property
    def title(self) -> str:
        """Its name in words: ``Target torque``."""
        words = self.name.replace("_", " ").capitalize()
        return words.replace("Si unit", "SI unit").replace("Dc link", "DC link").replace("Vl ", "vl ")


class Unit(IntEnum):
    """Codes of CiA 303-2 in unit words, and those that drives use in addition for turns and increments."""

    DIMENSIONLESS = 0x00
    METRE = 0x01
    SECOND = 0x03
    RADIAN = 0x10
    DEGREE = 0x41
    MINUTE = 0x47
    HOUR = 0x48
    SQUARE_SECOND = 0x57
    CUBIC_SECOND = 0xA0
    REVOLUTION = 0xB4
    INCREMENT = 0xB5
    REVOLUTION_PER_MINUTE = 0xC0


def unit_word(exponent: int, numerator: Unit, denominator: Unit = Unit.DIMENSIONLESS) -> int:
    """Return the UNSIGNED32 for ``10**exponent numerator/denominator``."""
    return (exponent & 0xFF) << 24 | numerator << 16 | denominator << 8


def unit_parts(word: int) -> tuple[int, int, int]:
    """Exponent of ten, numerator code and denominator code of a unit word."""
    exponent = word >> 24 & 0xFF
    return (exponent - 0x100 if exponent > 0x7F else exponent), word >> 16 & 0xFF, word >> 8 & 0xFF


_SET_UP: Final = "set-up"
_SET_UP_AND_END: Final = "set-up; cleared at the end"
_ALWAYS: Final = "each change of state"
_MOTION: Final = "before a move"


def listed(entry: Cia301 | Object, why: str, when: str, subs: Iterable[int] = (0,)) -> ListedWrite:
    """List one object of a profile, or sub-indices of one."""
    return ListedWrite(range(entry, entry + 1), tuple(subs), entry.title, why, when)


def _pdo(first: int, subs: tuple[int, ...], name: str, why: str) -> ListedWrite:
    return ListedWrite(range(first, first + PDOS_MAX), subs, f"{name} parameter", why, _SET_UP)


_COMMUNICATION_SUBS: Final = (1, 2, 3, 5)
"""COB-ID, transmission type, inhibit time, event timer (CiA 301 7.5.2.35)."""
_MAPPING_SUBS: Final = tuple(range(PDO_ENTRIES_MAX + 1))

CONTROL = WriteList(
    "state control", (listed(Object.CONTROLWORD, "leads the drive through its states", _ALWAYS),)
)
"""For stopping, disabling, resetting a fault."""

SET_UP = CONTROL | WriteList(
    "drive set-up",
    (
        listed(Cia301.CYCLE_PERIOD, "SYNC period", _SET_UP),
        listed(Cia301.GUARD_TIME, "life guarding of a drive that lacks 1016h or 1017h", _SET_UP_AND_END),
        listed(
            Cia301.LIFE_TIME_FACTOR, "life guarding of a drive that lacks 1016h or 1017h", _SET_UP_AND_END
        ),
        listed(
            Cia301.CONSUMER_HEARTBEAT_TIME,
            "the drive stops when the host is gone",
            _SET_UP_AND_END,
            range(1, NODE_ID_MAX + 1),
        ),
        listed(Cia301.PRODUCER_HEARTBEAT_TIME, "the host notices when the drive is gone", _SET_UP),
        listed(Cia301.ERROR_BEHAVIOUR, "the NMT state is kept when the host is lost", _SET_UP, (1,)),
        _pdo(
            RPDO_COMMUNICATION,
            _COMMUNICATION_SUBS,
            "RPDO communication",
            "set-points; 05: time-out of the commands, until the end",
        ),
        _pdo(RPDO_MAPPING, _MAPPING_SUBS, "RPDO mapping", "set-points"),
        _pdo(TPDO_COMMUNICATION, _COMMUNICATION_SUBS, "TPDO communication", "readings"),
        _pdo(TPDO_MAPPING, _MAPPING_SUBS, "TPDO mapping", "readings"),
        listed(Object.ABORT_CONNECTION_OPTION, "quick stop when the host is lost", _SET_UP),
        listed(Object.QUICK_STOP_OPTION, "how a quick stop ends", _SET_UP),
        listed(Object.SHUTDOWN_OPTION, "shutdown by ramp", _SET_UP),
        listed(Object.DISABLE_OPERATION_OPTION, "disabling by ramp", _SET_UP),
        listed(Object.FAULT_REACTION_OPTION, "a fault ends in a stop by ramp", _SET_UP),
        listed(Object.MODES_OF_OPERATION, "mode of operation", "each change of mode"),
        listed(Object.TARGET_TORQUE, "a torque mode begins without torque", "each change of mode, enabling"),
        listed(Object.MAX_TORQUE, "torque limit of the bench", _SET_UP),
        listed(
            Object.TARGET_POSITION,
            "a position mode begins where the shaft is",
            "each change of mode, enabling",
        ),
        listed(Object.MAX_MOTOR_SPEED, "speed limit of the bench", _SET_UP),
        listed(Object.QUICK_STOP_DECELERATION, "ramp of a quick stop", _SET_UP),
        listed(
            Object.INTERPOLATION_TIME_PERIOD,
            "period of the commands, 02: its power of ten",
            _SET_UP,
            (1, 2),
        ),
        listed(
            Object.TARGET_VELOCITY,
            "a velocity mode begins at the present speed",
            "each change of mode, enabling",
        ),
        listed(
            Object.VL_TARGET_VELOCITY,
            "velocity mode (vl) begins at the present speed",
            "each change of mode, enabling",
        ),
        *(
            listed(index, "ramp of velocity mode (vl)", _SET_UP, (1, 2))
            for index in (
                Object.VL_VELOCITY_ACCELERATION,
                Object.VL_VELOCITY_DECELERATION,
                Object.VL_VELOCITY_QUICK_STOP,
            )
        ),
        *(
            listed(
                index, "bound of the drive that is below the set-points' change", f"{_SET_UP}, csv and csp"
            )
            for index in (Object.MAX_ACCELERATION, Object.MAX_DECELERATION)
        ),
        listed(
            Object.INTERPOLATION_SUB_MODE_SELECT,
            "linear interpolation, where a drive holds another",
            "set-up, interpolated position",
        ),
        listed(
            Object.INTERPOLATION_DATA_RECORD,
            "interpolated position begins where the shaft is",
            "each change of mode, enabling",
            (1,),
        ),
    ),
)
"""Every write of :class:`servobench.drivers.cia402.servo.ServoDrive`, except moves and homing."""

MOTION = WriteList(
    "profile moves and homing",
    (
        listed(Object.HOME_OFFSET, "position of the home", _MOTION),
        listed(Object.PROFILE_VELOCITY, "speed of a move", _MOTION),
        listed(Object.PROFILE_ACCELERATION, "ramp of a move", _MOTION),
        listed(Object.PROFILE_DECELERATION, "ramp of a move", _MOTION),
        listed(Object.TORQUE_SLOPE, "slope of a torque", _MOTION),
        listed(Object.HOMING_METHOD, "way of homing", _MOTION),
        listed(Object.HOMING_SPEEDS, "speeds of homing", _MOTION, (1, 2)),
        listed(Object.HOMING_ACCELERATION, "ramp of homing", _MOTION),
    ),
)
"""Writes of :mod:`servobench.drivers.cia402.motion`, in addition to the set-up."""
