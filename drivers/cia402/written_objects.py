"""Objects of CiA 301 and CiA 402 that the drive client writes, with the reason for each.

To have the client write a further object, add a line here; docs/make_writes.py then renews the page.
"""

from collections.abc import Iterable
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
from servobench.drivers.cia402.objects402 import Object

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
