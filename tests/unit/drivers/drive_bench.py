"""A configured drive client and its servo on a fake bus."""

from collections.abc import Iterator
from contextlib import contextmanager

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

SETTINGS = DriveSettings(Duration(NS_PER_MS), torque_max_nm=5.0, speed_max_rad_s=250.0)
Bench = tuple[FakeBus, FakeServo, CanopenNetwork, ServoDrive]


@contextmanager
def configured_drive() -> Iterator[Bench]:
    """Not enabled yet."""
    bus, network = make_network()
    servo, drive = FakeServo(bus), ServoDrive(network, 1, "axis1")
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    drive.configure(SETTINGS)
    yield bus, servo, network, drive
    bus.shutdown()
