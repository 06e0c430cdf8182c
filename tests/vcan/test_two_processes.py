"""``hil run`` and ``hil simulate`` as two processes on the kernel's virtual CAN interface."""

from typing import ClassVar

import pytest

from tests.scenario.two_process_suite import TwoProcesses
from tests.vcan.late_machine import NO_MATTER_HOW_LATE


@pytest.mark.servo_bus("vcan")
class TestOnVcan(TwoProcesses):
    """The same bench file as on the other buses."""

    limits: ClassVar = {key.removeprefix("verdict."): limit for key, limit in NO_MATTER_HOW_LATE.items()}
