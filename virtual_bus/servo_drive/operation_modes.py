"""Modes of operation of the simulated drive: how set-points of the dictionary reach the inner loops.

A mode is one class and one entry of :data:`MODES`; the state machine, the limits and the ways to
rest are common to all.
"""

from collections.abc import Callable
from typing import Protocol

from drivers.profile402 import Mode, Status
from virtual_bus.servo_drive.firmware import Firmware, InnerControl
from virtual_bus.servo_drive.servo_objects import ServoObjects


class OperationMode(Protocol):
    """What the drive does in OPERATION_ENABLED while nothing stops it."""

    def begin(self) -> None:
        """OPERATION_ENABLED begins, or the mode was changed in it."""
        ...

    def take_set_points(self) -> None:
        """A set-point of the dictionary was written."""
        ...

    def status_bits(self) -> int:
        """Statusword bits 10, 12 and 13 of this mode while it is followed."""
        ...


class CyclicSynchronousTorque:
    """CST, CiA 402-2: target torque (6071h) plus torque offset (60B2h), at once, within the limits."""

    def __init__(self, objects: ServoObjects, firmware: Firmware) -> None:
        self._target = objects.target_torque
        self._offset = objects.torque_offset
        self._firmware = firmware
        self._nm_per_raw = objects.rated_torque.default * 1e-6

    def begin(self) -> None:
        self.take_set_points()
        self._firmware.control(InnerControl.TORQUE)

    def take_set_points(self) -> None:
        self._firmware.demand_torque((self._target.value + self._offset.value) * self._nm_per_raw)

    def status_bits(self) -> int:
        return Status.FOLLOWS_COMMAND


MODES: dict[Mode, Callable[[ServoObjects, Firmware], OperationMode]] = {
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: CyclicSynchronousTorque,
}
"""Every mode that the drive has; 6502h and the range of 6060h follow from it."""
