"""The pytest plugin's drives on the kernel's virtual CAN interface."""

import pytest

from servobench.drivers.cia402.profile import State
from servobench.hil.pytest_plugin import MakeDrive

pytestmark = pytest.mark.servo_bus("vcan")


def test_a_drive_turns_and_stops_and_says_nothing_else(servo_bus: str, servo_drive: MakeDrive) -> None:
    assert servo_bus == "socketcan:vcan0"
    rig = servo_drive(node=4, seed=2)
    rig.enable()
    rig.assert_controlwords(0x06, 0x07, 0x0F)
    assert rig.run(0.5, torque_nm=0.2)[-1].velocity_rad_s > 20.0
    rig.client.quick_stop(rig.deadline(5.0))
    rig.assert_reaches(State.SWITCH_ON_DISABLED, within_s=1.0)
    rig.assert_no_unintended_frame()
