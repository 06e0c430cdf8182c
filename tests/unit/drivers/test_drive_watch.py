"""What ends a run from the drive's side."""

from collections.abc import Iterator
from itertools import pairwise

import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.cia402.drive_setup import DriveSettings
from drivers.cia402.profile import State
from drivers.cia402.servo import ServoDrive
from drivers.errors import DriveInFault, NoAnswer
from drivers.timebase import NS_PER_MS, NS_PER_S, Duration
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

PERIOD = Duration(NS_PER_MS)
SETTINGS = DriveSettings(PERIOD, torque_max_nm=5.0, speed_max_rad_s=250.0)
Bench = tuple[FakeBus, FakeServo, CanopenNetwork, ServoDrive]


@pytest.fixture
def bench() -> Iterator[Bench]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network, ServoDrive(network, 1, "axis1")
    bus.shutdown()


def enabled(bench: Bench) -> None:
    _, _, network, drive = bench
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    drive.configure(SETTINGS)
    drive.enable(network.deadline_after(Duration(NS_PER_S)))


def cycle(bench: Bench) -> None:
    _, _, network, _ = bench
    due = network.deadline_after(PERIOD)
    network.send_sync()
    network.pump(due)


def run_cycles(bench: Bench, cycles: int) -> None:
    for _ in range(cycles):
        cycle(bench)
        bench[3].check()


def test_check_is_silent_on_a_healthy_drive(bench: Bench) -> None:
    bus, _, network, drive = bench
    enabled(bench)
    for _ in range(300):
        cycle(bench)
        drive.check()
    assert drive.status.lost_at is None
    assert len(drive.take_readings()) == 300
    beats = [at for at, frame in bus.sent if frame.can_id == 0x77F]
    assert {later - at for at, later in pairwise(beats)} == {50 * NS_PER_MS}
    assert network.emergencies_seen == 0


def test_check_names_the_fault(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    cycle(bench)
    servo.fault(0x2310)
    cycle(bench)
    with pytest.raises(DriveInFault, match=r"axis1 \(node 1 on fake\) is in fault.*2310h.*continuous over"):
        drive.check()


def test_check_names_a_drive_that_left_operation(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.state = State.SWITCH_ON_DISABLED
    cycle(bench)
    with pytest.raises(DriveInFault, match="fell out of operation into 'switch on disabled'"):
        drive.check()


def test_check_names_a_drive_that_left_nmt_operational(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.nmt_state = 0x7F
    for _ in range(60):
        cycle(bench)
    with pytest.raises(DriveInFault, match="fell back to PRE_OPERATIONAL"):
        drive.check()
    drive.check()


def test_check_names_a_restart(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.boot()
    cycle(bench)
    with pytest.raises(DriveInFault, match="restarted"):
        drive.check()


def test_check_names_a_lost_heartbeat(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.silent = True
    cycle(bench)
    drive.check()
    for _ in range(200):
        cycle(bench)
    with pytest.raises(NoAnswer, match="no heartbeat for 150 ms"):
        drive.check()


def test_check_names_a_statusword_that_is_not_told_any_more(bench: Bench) -> None:
    _, servo, network, drive = bench
    enabled(bench)
    servo.lost_tpdos.add(3)
    began = network.clock.now()
    with pytest.raises(NoAnswer, match="the statusword has not been told for 150 ms"):
        run_cycles(bench, 300)
    assert 0.15 < (network.clock.now() - began) / NS_PER_S < 0.18, "as fast as a lost heartbeat"
    assert not drive.enabled
    drive.check()


def test_a_fault_whose_statusword_is_lost_is_asked_for_when_the_emergency_comes(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.lost_tpdos.add(3)
    servo.fault(0x2310)
    cycle(bench)
    with pytest.raises(DriveInFault, match="is in fault"):
        drive.check()


def test_a_warning_by_emergency_ends_nothing(bench: Bench) -> None:
    bus, _, _, drive = bench
    enabled(bench)
    bus.deliver(0x81, bytes.fromhex("1042010000000000"))
    cycle(bench)
    asked = len(bus.sent_to(0x601))
    drive.check()
    assert len(bus.sent_to(0x601)) == asked + 1
    drive.check()
    assert len(bus.sent_to(0x601)) == asked + 1, "asked for once"
