"""``hil run`` and ``hil simulate`` as two processes on the kernel's virtual CAN interface."""

import pytest

from tests.scenario.two_processes import TwoProcesses


class TestOnVcan(TwoProcesses):
    """The same bench file as on the other buses."""

    @pytest.fixture
    def bus_spec(self, channel: str) -> str:
        return f"socketcan:{channel}"
