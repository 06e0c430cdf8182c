"""The modes of operation of the simulated drive. A mode is one class and one entry here."""

from collections.abc import Callable

from servobench.design.motor import PmsmParameters
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.axis import SimulatedAxis
from servobench.virtual_bus.drive.cyclic_modes import (
    CyclicSynchronousPosition,
    CyclicSynchronousTorque,
    CyclicSynchronousTorqueWithAngle,
    CyclicSynchronousVelocity,
    InterpolatedPosition,
)
from servobench.virtual_bus.drive.homing import Homing
from servobench.virtual_bus.drive.operation_mode import OperationMode
from servobench.virtual_bus.drive.profile_modes import ProfilePosition, ProfileTorque, ProfileVelocity
from servobench.virtual_bus.drive.vl_mode import VelocityMode

MODES: dict[Mode, Callable[[SimulatedAxis], OperationMode]] = {
    Mode.PROFILE_POSITION: ProfilePosition,
    Mode.VELOCITY: VelocityMode,
    Mode.PROFILE_VELOCITY: ProfileVelocity,
    Mode.PROFILE_TORQUE: ProfileTorque,
    Mode.HOMING: Homing,
    Mode.INTERPOLATED_POSITION: InterpolatedPosition,
    Mode.CYCLIC_SYNCHRONOUS_POSITION: CyclicSynchronousPosition,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: CyclicSynchronousVelocity,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: CyclicSynchronousTorque,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE: CyclicSynchronousTorqueWithAngle,
}
"""Every mode of a simulated drive."""


def modes_for(motor: PmsmParameters) -> frozenset[Mode]:
    """Return the modes that a drive of ``motor`` has; 6502h and the range of 6060h follow from it. That with
    an angle is there where the motor's commutation has to be told."""
    with_angle = Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE
    return frozenset(MODES) - (set() if motor.commutation is not None else {with_angle})
