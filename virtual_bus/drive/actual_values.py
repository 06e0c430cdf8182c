"""The actual values of every cycle: 6041h, 6064h, 606Ch and 6077h, as of the last inner tick."""

from typing import Final, cast

from drivers.cia402.profile import Status
from virtual_bus.drive.firmware import Firmware
from virtual_bus.drive.motor_kernel import S_COUNT, S_LIMITED, S_SPEED_MEASURED, S_TORQUE_MEASURED
from virtual_bus.drive.servo_objects import ServoObjects
from virtual_bus.drive.slow_values import clipped
from virtual_bus.drive.user_units import UserUnits

_INTERNAL_LIMIT_ACTIVE: Final = int(Status.INTERNAL_LIMIT_ACTIVE)
_COUNT: Final = int(S_COUNT)
_SPEED: Final = int(S_SPEED_MEASURED)
_TORQUE: Final = int(S_TORQUE_MEASURED)
_LIMITED: Final = int(S_LIMITED)
_INT32_MAX: Final = 2147483647.0
_round: Final = round
"""As constants of this module: found without a look-up where it is compiled."""


class ActualValues:
    """Where the firmware's state becomes what the TPDOs carry."""

    def __init__(self, firmware: Firmware, objects: ServoObjects, units: UserUnits) -> None:
        # gives plain floats, which an array does not; numpy's stubs call every buffer one of integers
        self._state = cast("memoryview[float]", firmware.state.data)
        self._units = units
        self._objects = objects
        self._torque_unit_nm = objects.torque_unit_nm
        self.statusword = objects.statusword
        self._position = objects.position
        self._velocity = objects.velocity
        self._torque = objects.torque
        self._plain = True
        self._origin = 0
        self._velocity_per_rad_s = 1.0

    def take_units(self) -> None:
        """They have changed; the cyclic path asks for them thousands of times a second."""
        units = self._units
        self._origin = int(units.origin)
        self._plain = units.plain and units.origin == self._origin
        self._velocity_per_rad_s = units.velocity_per_rad_s
        self._torque_unit_nm = self._objects.torque_unit_nm

    def refresh(self, status: int) -> bool:
        """``status``: the statusword but for what the inner loops add. Whether it has changed."""
        state = self._state
        if self._plain:
            count = int(state[_COUNT]) - self._origin
            self._position.value = (count + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        else:
            self._position.value = self._units.position_of(state[_COUNT])
        speed = state[_SPEED] * self._velocity_per_rad_s
        self._velocity.value = _round(speed) if -_INT32_MAX < speed < _INT32_MAX else clipped(speed, 32)
        self._torque.value = _int16(state[_TORQUE] / self._torque_unit_nm)
        if state[_LIMITED] != 0.0:
            status |= _INTERNAL_LIMIT_ACTIVE
        statusword = self.statusword
        if status == statusword.value:
            return False
        statusword.value = status
        return True


def _int16(value: float) -> int:
    """``value`` rounded into INTEGER16."""
    return min(max(_round(value), -0x8000), 0x7FFF)
