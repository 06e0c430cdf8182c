"""The modes of operation of the simulated drive. A mode is one class and one entry here."""

from collections.abc import Callable

from drivers.profile402 import Mode
from virtual_bus.servo_drive.axis import Axis
from virtual_bus.servo_drive.cyclic_modes import (
    CyclicSynchronousPosition,
    CyclicSynchronousTorque,
    CyclicSynchronousVelocity,
)
from virtual_bus.servo_drive.homing import Homing
from virtual_bus.servo_drive.operation_mode import OperationMode
from virtual_bus.servo_drive.profile_position import ProfilePosition
from virtual_bus.servo_drive.profile_torque import ProfileTorque
from virtual_bus.servo_drive.profile_velocity import ProfileVelocity

MODES: dict[Mode, Callable[[Axis], OperationMode]] = {
    Mode.PROFILE_POSITION: ProfilePosition,
    Mode.PROFILE_VELOCITY: ProfileVelocity,
    Mode.PROFILE_TORQUE: ProfileTorque,
    Mode.HOMING: Homing,
    Mode.CYCLIC_SYNCHRONOUS_POSITION: CyclicSynchronousPosition,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: CyclicSynchronousVelocity,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: CyclicSynchronousTorque,
}
"""Every mode that the drive has; 6502h and the range of 6060h follow from it."""
