"""What ends a run from the drive's side."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault, NoAnswer, PowerLost
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration
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


@pytest.mark.parametrize(
    ("word", "inputs", "said"),
    [
        (0x0227, 0x4, "60FDh shows no interlock"),
        (0x0240, 0xC, "safe torque off: 60FDh shows an interlock"),
        (0x0000, None, "it has no 60FDh"),
    ],
    ids=["no voltage, still enabled", "safe torque off", "nothing to ask"],
)
def test_check_names_a_drive_that_lost_its_power(
    bench: Bench, word: int, inputs: int | None, said: str
) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    drive._told.take(0x0237, drive._now())
    drive.watch.begin()
    if inputs is not None:
        servo.types[0x60FD, 0], servo.values[0x60FD, 0] = "I", inputs
    drive._told.take(word, drive._now())
    with pytest.raises(PowerLost, match=f"lost the power of its stage.*{said}"):
        drive.check()


def test_a_drive_that_never_tells_of_its_voltage_is_not_said_to_have_lost_it(bench: Bench) -> None:
    _, _, _, drive = bench
    enabled(bench)
    drive._told.take(0x0227, drive._now())
    drive.watch.begin()
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
    drive.check()
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


def test_nothing_is_judged_before_the_drive_is_enabled(bench: Bench) -> None:
    _, servo, network, drive = bench
    assert not drive.enabled
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    drive.configure(SETTINGS)
    servo.fault(0x2310)
    cycle(bench)
    drive.check()
    assert not drive.enabled


def test_what_came_before_it_was_enabled_ends_nothing(bench: Bench) -> None:
    bus, servo, network, drive = bench
    servo.boot()
    network.pump(network.deadline_after(PERIOD))
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    drive.configure(SETTINGS)
    assert drive.status.boot_ups == 1
    bus.deliver(0x81, bytes.fromhex("1042010000000000"))
    network.pump(network.deadline_after(PERIOD))
    drive.enable(network.deadline_after(Duration(NS_PER_S)))
    asked = len(bus.sent_to(0x601))
    run_cycles(bench, 100)
    assert len(bus.sent_to(0x601)) == asked, "no statusword is asked for after an old EMCY"


def test_a_drive_without_heartbeat_is_not_missed_by_its_nmt_state(bench: Bench) -> None:
    _, servo, network, drive = bench
    del servo.types[0x1017, 0]
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    drive.configure(replace(SETTINGS, unwatched=True))
    drive.enable(network.deadline_after(Duration(NS_PER_S)))
    run_cycles(bench, 300)
    assert drive.enabled


def test_a_statusword_that_nothing_repeats_may_be_silent(bench: Bench) -> None:
    """By a plan that has none, one without event timer, or one that comes with the SYNC."""
    _, servo, _, drive = bench
    enabled(bench)
    assert drive.plan is not None
    plan = drive.plan
    told = plan.tpdo_with(Object.STATUSWORD)
    assert told is not None
    assert not told.synchronous
    unrepeated, synchronous = replace(told, event_timer_ms=0), replace(told, transmission_type=1)
    servo.lost_tpdos.add(3)
    for tpdos in ((), (unrepeated,), (synchronous,)):
        drive.watch.configure(True, PdoPlan(tpdos, ()), SETTINGS)
        run_cycles(bench, 200)
    assert drive.enabled
    drive.watch.configure(True, PdoPlan((told,), ()), SETTINGS)
    with pytest.raises(NoAnswer, match="the statusword has not been told"):
        drive.check()


@pytest.mark.parametrize(("timer_ms", "silence_ms", "borne_ms"), [(25, 150, 150), (100, 150, 200)])
def test_two_event_timers_at_least_are_borne(
    bench: Bench, timer_ms: int, silence_ms: int, borne_ms: int
) -> None:
    _, servo, network, drive = bench
    enabled(bench)
    assert drive.plan is not None
    told = drive.plan.tpdo_with(Object.STATUSWORD)
    assert told is not None
    plan = PdoPlan((replace(told, event_timer_ms=timer_ms),), ())
    drive.watch.configure(True, plan, replace(SETTINGS, drive_heartbeat_timeout_ms=silence_ms))
    servo.lost_tpdos.add(3)
    began = network.clock.now()
    with pytest.raises(NoAnswer, match=f"has not been told for {borne_ms} ms"):
        run_cycles(bench, 300)
    assert borne_ms - 26 <= (network.clock.now() - began) / NS_PER_MS <= borne_ms + 1


def test_a_drive_is_missed_only_once(bench: Bench) -> None:
    """What ended it is told by one error; from then on the drive is not enabled, and may be what it likes."""
    _, servo, _, drive = bench
    for end in ("fault", "boot", "nmt", "silence"):
        servo.lost_tpdos.clear()
        servo.state = State.SWITCH_ON_DISABLED
        enabled(bench)
        if end == "fault":
            servo.fault(0x2310)
        elif end == "boot":
            servo.boot()
        elif end == "nmt":
            servo.nmt_state = 0x7F
        else:
            servo.lost_tpdos.add(3)
        with pytest.raises((DriveInFault, NoAnswer)):
            run_cycles(bench, 300)
        assert not drive.enabled
        drive.check()


def test_a_statusword_of_zero_is_a_state_too(bench: Bench) -> None:
    _, _, network, drive = bench
    enabled(bench)
    drive.watch._told.take(0, network.clock.now())
    with pytest.raises(DriveInFault, match="fell out of operation into 'not ready to switch on'"):
        drive.check()
