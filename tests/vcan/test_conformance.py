"""The rules of CiA 301 and 305 on the kernel's virtual CAN interface."""

from collections.abc import Iterator

import can
import pytest

from tests.contract.conformance.live_device import live_servo
from tests.contract.conformance.rig import Rig
from tests.contract.conformance.suite import ConformanceSuite
from tests.vcan.conftest import CHANNEL


class TestOnVcan(ConformanceSuite):
    """Master and device have a socket each."""

    @pytest.fixture(scope="class")
    @classmethod
    def rig(cls) -> Iterator[Rig]:
        def open_bus() -> can.BusABC:
            return can.Bus(interface="socketcan", channel=CHANNEL, ignore_config=True)

        with open_bus() as bus, live_servo(open_bus):
            yield Rig(bus)
