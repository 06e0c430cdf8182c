"""How a drive is moved through its states, and what is believed of its faults."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from servobench.drivers.cia402.profile import DriveCommand, State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.state_control import NONE_SENT
from servobench.drivers.errors import DriveInFault
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from tests.unit.drivers.drive_bench import Bench, configured_drive
from tests.unit.drivers.fake_bus import ANSWER_AFTER_NS, FakeBus, FakeServo, make_network

RPDO, SDO = 0x201, 0x601


@pytest.fixture
def bench() -> Iterator[Bench]:
    with configured_drive() as bench:
        yield bench


def soon(bench: Bench, milliseconds: int = 1000) -> Instant:
    return bench[2].deadline_after(Duration(milliseconds * NS_PER_MS))


def wait(bench: Bench, milliseconds: float) -> None:
    bench[2].pump(bench[2].deadline_after(Duration(round(milliseconds * NS_PER_MS))))


def asked_for(bus: FakeBus, index: int) -> int:
    """How often an object was read by SDO."""
    request = b"\x40" + index.to_bytes(2, "little")
    return sum(data.startswith(request) for data in bus.sent_to(SDO))


def words_by_sdo(bus: FakeBus) -> list[int]:
    """Controlwords that were written by SDO."""
    return [
        int.from_bytes(data[4:6], "little")
        for data in bus.sent_to(SDO)
        if data[1:4] == b"\x40\x60\x00" and data[0] >> 5 == 1
    ]


def test_a_command_without_effect_is_repeated_every_50_ms(bench: Bench) -> None:
    bus, servo, _, drive = bench
    servo._control = lambda word: None  # type: ignore[method-assign]
    began = bus.now()
    with pytest.raises(DriveInFault, match="did not reach 'operation enabled' in time"):
        drive.control.walk(State.OPERATION_ENABLED, soon(bench, 230))
    assert words_by_sdo(bus) == [6] * 5
    assert 230 <= (bus.now() - began) / NS_PER_MS < 235


def test_it_is_repeated_at_the_very_end_of_that_time(bench: Bench) -> None:
    """By a drive that takes 1 ms for an answer, so that it is asked at that instant."""
    bus, servo, _, drive = bench
    servo.sdo_takes_ns = NS_PER_MS
    servo._control = lambda word: None  # type: ignore[method-assign]
    bus.sent.clear()
    with pytest.raises(DriveInFault):
        drive.control.walk(State.OPERATION_ENABLED, soon(bench, 120))
    first, second, third = [at for at, frame in bus.sent if frame.can_id == RPDO]
    assert second - first == third - second == 50 * NS_PER_MS


def test_a_command_without_effect_is_looked_after_once_a_millisecond(bench: Bench) -> None:
    bus, servo, _, drive = bench
    servo._control = lambda word: None  # type: ignore[method-assign]
    asked = asked_for(bus, 0x6041)
    with pytest.raises(DriveInFault):
        drive.control.walk(State.OPERATION_ENABLED, soon(bench, 100))
    assert 80 <= asked_for(bus, 0x6041) - asked <= 105


def test_no_command_goes_out_at_the_deadline(bench: Bench) -> None:
    """The first statusword comes at that very instant."""
    bus, _, _, drive = bench
    with pytest.raises(DriveInFault, match="did not reach 'operation enabled' in time"):
        drive.control.walk(State.OPERATION_ENABLED, Instant(bus.now() + ANSWER_AFTER_NS))
    assert words_by_sdo(bus) == []


def test_no_state_is_asked_for_after_the_deadline_but_as_evidence(bench: Bench) -> None:
    bus, _, _, drive = bench
    asked = asked_for(bus, 0x6041)
    with pytest.raises(DriveInFault, match="did not go on in time"):
        drive.control.await_state(lambda state: False, Instant(bus.now() + ANSWER_AFTER_NS), "go on")
    assert asked_for(bus, 0x6041) - asked == 2


def test_each_state_gets_its_command_at_once(bench: Bench) -> None:
    bus, servo, _, drive = bench
    began = bus.now()
    drive.control.walk(State.OPERATION_ENABLED, soon(bench))
    assert words_by_sdo(bus) == [6, 7, 15]
    assert (bus.now() - began) / NS_PER_MS < 10
    assert servo.state is State.OPERATION_ENABLED


@pytest.mark.parametrize("state", [State.FAULT, State.FAULT_REACTION])
def test_a_fault_on_the_way_ends_it_at_once(bench: Bench, state: State) -> None:
    bus, servo, _, drive = bench
    servo.state = state
    began = bus.now()
    with pytest.raises(DriveInFault, match="is in fault"):
        drive.control.walk(State.OPERATION_ENABLED, soon(bench))
    with pytest.raises(DriveInFault, match="is in fault"):
        drive.control.await_state(lambda state: False, soon(bench), "go on")
    assert (bus.now() - began) / NS_PER_MS < 10
    assert words_by_sdo(bus) == []


def test_a_fault_may_be_waited_out(bench: Bench) -> None:
    bus, servo, _, drive = bench
    servo.state = State.FAULT_REACTION
    bus.call_after(40 * NS_PER_MS, lambda: setattr(servo, "state", State.FAULT))
    reached = drive.control.await_state(lambda state: state is State.FAULT, soon(bench), "end", faults=False)
    assert reached is State.FAULT


def test_a_state_that_does_not_come_is_polled_until_the_deadline(bench: Bench) -> None:
    bus, _, _, drive = bench
    began, asked = bus.now(), len(bus.sent_to(SDO))
    with pytest.raises(DriveInFault, match=r"did not go on in time.*statusword 0240h"):
        drive.control.await_state(lambda state: False, soon(bench, 100), "go on")
    assert 100 <= (bus.now() - began) / NS_PER_MS < 105
    assert 80 <= len(bus.sent_to(SDO)) - asked <= 105, "once a millisecond, and an answer takes its time"


def test_a_command_goes_by_both_ways_and_holds(bench: Bench) -> None:
    bus, _, _, drive = bench
    control = drive.control
    control.command(DriveCommand.SHUTDOWN)
    assert control.controlword == 6
    assert [data[:2] for data in bus.sent_to(RPDO)] == [b"\x06\x00"]
    assert words_by_sdo(bus) == [6]
    asked = len(bus.sent_to(SDO))
    control.command_by_pdo(DriveCommand.QUICK_STOP)
    assert control.controlword == 2
    assert [data[:2] for data in bus.sent_to(RPDO)] == [b"\x06\x00", b"\x02\x00"]
    assert len(bus.sent_to(SDO)) == asked, "nothing is waited for"


def test_before_the_mapping_a_command_by_pdo_goes_nowhere() -> None:
    bus, network = make_network()
    FakeServo(bus)
    control = ServoDrive(network, 1, "axis1").control
    control.command_by_pdo(DriveCommand.QUICK_STOP)
    assert bus.sent == []
    control.command(DriveCommand.SHUTDOWN)
    assert words_by_sdo(bus) == [6]
    assert bus.sent_to(RPDO) == []
    bus.shutdown()


def test_bits_are_changed_in_the_word_in_force(bench: Bench) -> None:
    bus, _, _, drive = bench
    control = drive.control
    control.clear_bits(0x10)
    assert control.controlword == NONE_SENT
    assert words_by_sdo(bus) == [], "no word was in force"
    control.set_bits(0x30, 0x10)
    control.set_bits(0x100, 0x100)
    control.set_bits(0x30, 0x20)
    control.clear_bits(0x100)
    assert words_by_sdo(bus) == [0x10, 0x110, 0x120, 0x20]
    control.clear_bits(0x100)
    assert words_by_sdo(bus)[4:] == [], "they are clear"


def test_only_an_emergency_of_its_own_is_noted(bench: Bench) -> None:
    bus, _, _, drive = bench
    bus.deliver(0x85, bytes.fromhex("1023010000000000"))
    wait(bench, 1)
    assert not drive.control.emergency_came
    assert not drive.control.emergencies
    bus.deliver(0x81, bytes.fromhex("1023010000000000"))
    wait(bench, 1)
    assert drive.control.emergency_came
    assert [each.code for each in drive.control.emergencies] == [0x2310]


def test_what_an_emergency_meant_is_asked_without_waiting(bench: Bench) -> None:
    bus, servo, _, drive = bench
    servo.state = State.FAULT
    drive.control.emergency_came = True
    began, asked = bus.now(), asked_for(bus, 0x6041)
    drive.control.ask_after_emergency()
    assert bus.now() == began, "in the middle of a cycle"
    assert not drive.control.emergency_came
    wait(bench, 1)
    assert drive.state is State.FAULT
    assert asked_for(bus, 0x6041) == asked + 1


def test_a_statusword_of_more_octets_than_two_is_borne(bench: Bench) -> None:
    _, servo, _, drive = bench
    servo.lost_tpdos.add(3)
    servo.types[0x6041, 0] = "I"
    servo.mode_status = 0xABCD << 16
    drive.control.ask_after_emergency()
    wait(bench, 1)
    assert drive.control._told.statusword == 0x0240


@pytest.mark.parametrize(
    ("before_ms", "by_emergency"), [(0, True), (98, True), (99.9, True), (100, False), (110, False)]
)
def test_a_fault_is_seen_by_the_emergency_that_goes_with_it(
    bench: Bench, before_ms: float, by_emergency: bool
) -> None:
    """Up to 100 ms before the statusword, which takes 0.1 ms to be asked for."""
    _, servo, _, drive = bench
    servo.fault(0x2310)
    servo.lost_tpdos.add(3)
    bench[2].pump_one(soon(bench))
    came = drive.control.emergencies[-1].at
    wait(bench, before_ms)
    drive.control.read_status()
    told_at = drive.control.status_told_at
    assert drive.control.fault_seen_at == (came if by_emergency else told_at)
    error = drive.control.in_fault()
    assert error.seen_at == drive.control.fault_seen_at
    assert "2310h" in error.evidence


def test_an_emergency_that_takes_an_error_back_is_no_fault(bench: Bench) -> None:
    bus, _, _, drive = bench
    bus.deliver(0x81, bytes(8))
    wait(bench, 5)
    drive.control.read_status()
    assert drive.control.fault_seen_at == drive.control.status_told_at


def test_the_first_of_several_emergencies_tells_when(bench: Bench) -> None:
    bus, _, _, drive = bench
    for after_ms in (1, 10):
        bus.deliver(0x81, bytes.fromhex("1023010000000000"), after_ms * NS_PER_MS)
    wait(bench, 20)
    drive.control.read_status()
    assert drive.control.fault_seen_at == drive.control.emergencies[0].at


def test_words_of_the_way_to_operation_are_waited_for_a_while(bench: Bench) -> None:
    """By a plan whose statusword comes by itself; it may be lost, so for no longer than 50 ms."""
    bus, servo, _, drive = bench
    control, plan = drive.control, drive.plan
    assert plan is not None
    servo.lost_tpdos.add(3)
    for limit_ms, waited_ms in ((1000, 50), (20, 20)):
        began = bus.now()
        control.await_older_words(plan, soon(bench, limit_ms))
        assert (bus.now() - began) / NS_PER_MS == waited_ms
    began = bus.now()
    control.await_older_words(None, soon(bench))
    synchronous = tuple(replace(tpdo, transmission_type=1) for tpdo in plan.tpdos)
    control.await_older_words(replace(plan, tpdos=synchronous), soon(bench))
    assert bus.now() == began
    servo.lost_tpdos.clear()
    servo.state = State.OPERATION_ENABLED
    control.await_older_words(plan, soon(bench))
    assert 0 < (bus.now() - began) / NS_PER_MS < 40
    again = bus.now()
    control.await_older_words(plan, soon(bench))
    assert bus.now() == again
