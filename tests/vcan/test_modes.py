"""Every mode of operation from the drive client; drive, client and monitor on the kernel's virtual CAN."""

from collections.abc import Iterator

import can
import pytest

from servobench.drivers.wire.link import StampSource
from tests.contract.live_modes import live_modes
from tests.contract.modes_suite import ModesRig, ModesSuite
from tests.vcan.conftest import CHANNEL


class TestOnVcan(ModesSuite):
    """A socket each."""

    @pytest.fixture
    def rig(self) -> Iterator[ModesRig]:
        def open_bus() -> can.BusABC:
            return can.Bus(interface="socketcan", channel=CHANNEL, ignore_config=True)

        with live_modes(open_bus, StampSource.RECEIPT) as rig:
            yield rig
