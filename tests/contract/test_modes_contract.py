"""Every mode of operation from the drive client, on the simulated drive with its motor.

In simulated time, with set-points that act on arrival or at a SYNC, and live on a hub.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.contract.live_modes import live_modes
from tests.contract.modes_suite import NODE, WRITES, ModesRig, ModesSuite
from tests.motors import LING


def simulated_rig(synchronous: bool) -> Iterator[ModesRig]:
    timeline = Timeline()
    clock, segment = SimulatedClock(timeline), CanSegment(timeline)
    device = SimulatedServo(NODE, LING)
    AttachedDevice(device, segment)

    def tell(action: Callable[[SimulatedServo], None]) -> None:
        device.wake(timeline.now)
        action(device)
        device.wake(timeline.now)

    with can.Bus(interface="simulated", segment=segment, ignore_config=True) as bus:
        network = CanopenNetwork(
            BusLink(bus, clock, StampSource.MONOTONIC, "simulated"), clock, writes=WRITES
        )
        rig = ModesRig(network, device, ServoDrive(network, NODE, "axis1"), tell, synchronous)

        def hear(frame: Frame, _at: Instant) -> None:
            rig.heard.append((frame.can_id, bytes(frame.data)))

        segment.add_monitor(hear)
        rig.start()
        yield rig


class TestInSimulatedTime(ModesSuite):
    """RPDOs act when they arrive."""

    @pytest.fixture
    def rig(self) -> Iterator[ModesRig]:
        yield from simulated_rig(synchronous=False)


class TestWithSynchronousCommands(ModesSuite):
    """RPDOs wait for a SYNC: an old one must not bring an old controlword back."""

    @pytest.fixture
    def rig(self) -> Iterator[ModesRig]:
        yield from simulated_rig(synchronous=True)


@pytest.mark.xdist_group("real time")
class TestOnTheHub(ModesSuite):
    """Client, drive and monitor are participants of one hub, in real time."""

    @pytest.fixture(scope="class")
    @classmethod
    def runtime(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        folder = tmp_path_factory.mktemp("hub")
        folder.chmod(0o700)
        return folder

    @pytest.fixture
    def rig(self, runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModesRig]:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))

        def open_bus() -> can.BusABC:
            return can.Bus(interface="hub", channel="modes", bitrate=1_000_000, ignore_config=True)

        with live_modes(open_bus, StampSource.MONOTONIC) as rig:
            yield rig
