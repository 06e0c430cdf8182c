"""The whole simulated servo against the rules: in simulated time, and live on a hub."""

from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.contract.conformance.live_device import live_servo
from tests.contract.conformance.rig import NODE, Rig
from tests.contract.conformance.suite import ConformanceSuite
from tests.motors import LING


class TestInSimulatedTime(ConformanceSuite):
    """On a segment."""

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        timeline = Timeline()
        segment = CanSegment(timeline)
        AttachedDevice(SimulatedServo(NODE, LING), segment)
        with can.Bus(interface="simulated", segment=segment, ignore_config=True) as bus:
            yield Rig(bus)


@pytest.mark.xdist_group("real time")
class TestOnTheHub(ConformanceSuite):
    """Master and device are participants of one hub."""

    @pytest.fixture(scope="class")
    @classmethod
    def rig(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
        def open_bus() -> can.BusABC:
            return can.Bus(interface="hub", channel="conformance", bitrate=1_000_000, ignore_config=True)

        with pytest.MonkeyPatch.context() as patch:
            runtime: Path = tmp_path_factory.mktemp("hub")
            runtime.chmod(0o700)
            patch.setenv("XDG_RUNTIME_DIR", str(runtime))
            with open_bus() as bus, live_servo(open_bus):
                yield Rig(bus)
