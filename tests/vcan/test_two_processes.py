"""``hil run`` and ``hil simulate`` as two processes on the kernel's virtual CAN interface."""

import pytest

from tests.scenario.two_process_suite import TwoProcesses


@pytest.mark.servo_bus("vcan")
class TestOnVcan(TwoProcesses):
    """The same bench file as on the other buses."""
