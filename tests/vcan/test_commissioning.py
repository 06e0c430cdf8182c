"""``hil commission`` on the kernel's virtual CAN interface, and over a serial adapter that is on it."""

from collections.abc import Iterator

import pytest

from tests.scenario.commission_suite import CommissionSuite
from tests.scenario.serial_processes import adapter_process


class TestOnVcan(CommissionSuite):
    """Host and drive on the same interface."""

    @pytest.fixture
    def bus_spec(self, channel: str) -> str:
        return f"socketcan:{channel}"


class TestOverSerial(CommissionSuite):
    """The host has an emulated SLCAN adapter on a pty; the drive is on the interface behind it."""

    @pytest.fixture
    def drive_spec(self, channel: str) -> str:
        return f"socketcan:{channel}"

    @pytest.fixture
    def bus_spec(self, drive_spec: str) -> Iterator[str]:
        with adapter_process(drive_spec) as adapter:
            yield adapter.bus
