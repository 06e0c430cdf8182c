"""The drive client against a scripted node."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.rest import REST_FOR
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault, NoAnswer, PeerFault, TransferAborted
from servobench.drivers.exchange import Command, SpeedCommand
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import UNTOLD
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

PERIOD = Duration(NS_PER_MS)
SETTINGS = DriveSettings(
    PERIOD, torque_max_nm=5.0, speed_max_rad_s=250.0, quick_stop_deceleration_rad_s2=1000.0
)
Bench = tuple[FakeBus, FakeServo, CanopenNetwork, ServoDrive]


@pytest.fixture
def bench() -> Iterator[Bench]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network, ServoDrive(network, 1, "axis1")
    bus.shutdown()


def soon(network: CanopenNetwork, seconds: float = 1.0) -> Instant:
    return network.deadline_after(Duration(int(seconds * NS_PER_S)))


def enabled(bench: Bench) -> None:
    _, _, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    drive.enable(soon(network))


def cycle(bench: Bench) -> None:
    _, _, network, _ = bench
    due = network.deadline_after(PERIOD)
    network.send_sync()
    network.pump(due)


def command(torque_nm: float, network: CanopenNetwork) -> Command:
    now = network.clock.now()
    return Command(network.sync_count, torque_nm, now, Instant(now + PERIOD))


def test_identity_is_read_with_its_name(bench: Bench) -> None:
    _, _, network, drive = bench
    identity = drive.connect(soon(network))
    assert identity.device_name == "Fake servo with a long name"
    assert identity.vendor == 0x1234
    assert str(identity).startswith("Fake servo")


def test_no_drive_names_node_bus_and_who_was_heard(bench: Bench) -> None:
    bus, servo, network, _ = bench
    servo.silent = True
    bus.deliver(0x705, b"\x7f", 10 * NS_PER_MS)
    started = network.clock.now()
    with pytest.raises(NoAnswer, match=r"node 7 on fake.*heard on the bus: nodes 5"):
        ServoDrive(network, 7).connect(soon(network))
    assert 1.0 <= (network.clock.now() - started) / NS_PER_S < 1.2


def test_a_drive_that_comes_late_is_waited_for(bench: Bench) -> None:
    bus, servo, network, drive = bench
    servo.silent = True
    bus.call_after(500 * NS_PER_MS, lambda: setattr(servo, "silent", False))
    drive.connect(soon(network))
    assert drive.identity is not None


def test_another_profile_is_refused(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.values[0x1000, 0] = 401
    with pytest.raises(PeerFault, match="profile 401"):
        drive.connect(soon(network))


def test_configure_writes_heartbeats_reactions_limits_and_mode(bench: Bench) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    notes = drive.configure(SETTINGS)
    values = servo.values
    assert values[0x1016, 1] == 127 << 16 | 150
    assert values[0x1017, 0] == 50
    assert values[0x1802, 5] == 25
    assert values[0x6007, 0] == 3
    assert values[0x6072, 0] == 2500
    assert values[0x6080, 0] == round(250.0 * 60 / (2 * math.pi))
    assert values[0x6085, 0] == round(1000.0 / (2 * math.pi / 60 / 1000))
    assert values[0x6061, 0] == 10
    assert values[0x1006, 0] == 1000
    assert servo.nmt_state == 5
    assert any(note.startswith("605Bh:00 is missing") for note in notes)
    assert any(note.startswith("60C2h:02 is missing") for note in notes)
    assert network.produces_heartbeat


def test_the_host_takes_a_free_entry_of_the_consumer_heartbeats(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.values[0x1016, 1] = 9 << 16 | 500
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    assert servo.values[0x1016, 1] == 9 << 16 | 500
    assert servo.values[0x1016, 2] == 127 << 16 | 150


def test_a_drive_that_cannot_watch_the_host_is_refused(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.stubborn.add((0x1016, 1))
    drive.connect(soon(network))
    with pytest.raises(SettingRefused, match="1016h:01"):
        drive.configure(SETTINGS)


def test_a_limit_that_is_not_taken_becomes_a_note(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.stubborn.add((0x6080, 0))
    servo.refuse[0x6072, 0] = 0x06090031
    drive.connect(soon(network))
    notes = " ".join(drive.configure(SETTINGS))
    assert "6080h:00 holds 0" in notes
    assert "06090031h" in notes


def test_a_mapping_that_stays_wrong_is_named(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.stubborn.add((0x1A00, 1))
    drive.connect(soon(network))
    with pytest.raises(SettingRefused, match=r"TPDO1 maps 0000h:00/0 1013h:00/32 instead of 606Ch:00/32"):
        drive.configure(SETTINGS)


def test_without_device_clock_the_stamp_is_left_out(bench: Bench) -> None:
    _, servo, _, drive = bench
    del servo.types[0x1013, 0]
    enabled(bench)
    cycle(bench)
    (reading,) = drive.take_readings()
    assert reading.device_time_ns is None


def test_enable_walks_the_states_with_torque_zero(bench: Bench) -> None:
    _, servo, _, drive = bench
    servo.values[0x6071, 0] = 77
    enabled(bench)
    assert servo.state is State.OPERATION_ENABLED
    assert drive.state is State.OPERATION_ENABLED
    assert servo.values[0x6071, 0] == 0
    # Each word goes by PDO and by SDO; none that was not asked for goes anywhere.
    assert servo.control_history == [6, 6, 7, 7, 15, 15]


def test_a_drive_in_fault_is_not_enabled_and_not_reset(bench: Bench) -> None:
    bus, servo, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    servo.fault(0x3210)
    network.pump(network.deadline_after(PERIOD))
    with pytest.raises(DriveInFault, match=r"error code 3210h \(DC link over-voltage\).*EMCY 3210h"):
        drive.enable(soon(network))
    assert servo.state is State.FAULT
    assert not any(data[0] & 0x80 for data in bus.sent_to(0x201))


def test_a_fault_is_reset_on_request(bench: Bench) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    servo.fault(0x3210)
    drive.reset_fault(soon(network))
    assert drive.state is State.SWITCH_ON_DISABLED
    drive.enable(soon(network))
    assert servo.state is State.OPERATION_ENABLED


def test_a_state_that_is_not_reached_tells_what_was_seen(bench: Bench) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    servo._control = lambda word: None  # type: ignore[method-assign]
    with pytest.raises(DriveInFault, match=r"did not reach 'operation enabled' in time.*statusword 0240h"):
        drive.enable(soon(network, 0.2))


def test_reading_is_in_si(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.values[0x6064, 0] = -65536 // 4
    servo.values[0x606C, 0] = 1_500_000
    servo.values[0x6077, 0] = 500
    cycle(bench)
    drive.take_readings()
    cycle(bench)
    (reading,) = drive.take_readings()
    assert reading.position_rad == pytest.approx(-math.pi / 2 + 1500 * 2 * math.pi / 60 * 0.001)
    assert reading.velocity_rad_s == pytest.approx(1500 * 2 * math.pi / 60)
    assert reading.torque_nm == pytest.approx(1.0)
    assert reading.statusword == 0x0227
    assert reading.device_time_ns == reading.received_at - 130_000
    assert drive.take_readings() == []


def test_a_command_tells_what_was_sent_and_when_it_was_on_the_bus(bench: Bench) -> None:
    bus, _, network, drive = bench
    enabled(bench)
    sent = drive.write(Command(7, 1.0, Instant(0), soon(network)))
    assert sent is not None
    assert (sent.sequence, sent.raw, sent.handed_at, sent.on_bus_at) == (7, 500, network.clock.now(), None)
    network.frame_pump.echo_handlers[0x201](bus.sent_to(0x201)[-1], Instant(4711), UNTOLD)
    assert sent.on_bus_at == 4711


def test_the_torque_demand_is_read_back(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.values[0x6074, 0] = 321
    cycle(bench)
    (readback,) = drive.take_readbacks()
    assert (readback.demand_raw, readback.readings) == (321, 1)
    assert drive.take_readbacks() == []
    assert drive.torque_shown == (0.0, readback.received_at)


def test_write_scales_clips_and_keeps_the_controlword(bench: Bench) -> None:
    bus, servo, network, drive = bench
    enabled(bench)
    drive.write(command(1.0, network))
    assert bus.sent_to(0x201)[-1] == bytes.fromhex("0f00f401")
    drive.write(command(-50.0, network))
    assert servo.values[0x6071, 0] == -2500
    assert servo.state is State.OPERATION_ENABLED


def test_a_torque_that_is_no_number_is_never_sent_nor_a_speed_for_a_torque(bench: Bench) -> None:
    bus, _, network, drive = bench
    enabled(bench)
    sent = len(bus.sent)
    for torque in (math.nan, math.inf):
        with pytest.raises((ValueError, OverflowError)):
            drive.write(command(torque, network))
    with pytest.raises(RuntimeError, match="no RPDO of the plan carries 60FFh"):
        drive.write(SpeedCommand(1, 1.0, network.clock.now(), soon(network)))
    assert len(bus.sent) == sent


def test_an_expired_command_is_not_sent(bench: Bench) -> None:
    bus, _, network, drive = bench
    enabled(bench)
    late = command(1.0, network)
    network.pump(network.deadline_after(Duration(2 * PERIOD)))
    sent = len(bus.sent)
    assert drive.write(late) is None
    assert len(bus.sent) == sent
    assert drive.unsent_commands == 1


def test_disable_uses_the_ramp_and_ends_disabled(bench: Bench) -> None:
    _, servo, network, drive = bench
    enabled(bench)
    servo.control_history.clear()
    drive.disable(soon(network))
    assert servo.state is State.SWITCH_ON_DISABLED
    assert servo.control_history == [7, 7, 0, 0]


def test_quick_stop_waits_for_rest(bench: Bench) -> None:
    _, servo, network, drive = bench
    enabled(bench)
    servo.values[0x606C, 0] = 1_500_000
    servo.stop_ns = 300 * NS_PER_MS
    started = network.clock.now()
    drive.quick_stop(soon(network))
    assert servo.state is State.SWITCH_ON_DISABLED
    assert servo.values[0x606C, 0] == 0
    assert network.clock.now() - started >= servo.stop_ns


def test_release_leaves_the_drive_at_rest_and_unwatched(bench: Bench) -> None:
    _, servo, _, drive = bench
    enabled(bench)
    servo.values[0x606C, 0] = 1_500_000
    released = drive.release()
    assert released.at_rest, released
    assert servo.state is State.SWITCH_ON_DISABLED
    assert servo.values[0x1016, 1] == 0
    assert servo.nmt_state == 0x7F


def test_a_shaft_that_turns_round_is_not_at_rest_by_one_reading(bench: Bench) -> None:
    bus, servo, network, drive = bench
    enabled(bench)
    started = network.clock.now()

    def swing(milliseconds: int) -> None:
        """40 r/min at first, through zero every 50 ms, and still from 400 ms on."""
        servo.values[0x606C, 0] = round(40_000 * math.cos(math.pi * milliseconds / 50))
        if milliseconds < 400:
            bus.call_after(NS_PER_MS, lambda: swing(milliseconds + 1))
        else:
            servo.values[0x606C, 0] = 0

    servo.stop_ns = 10 * NS_PER_S
    swing(0)
    servo.stop_ns = 5 * NS_PER_MS
    released = drive.release()
    assert released.at_rest, released
    assert released.rested_at is not None
    assert 390 * NS_PER_MS < released.rested_at - started < 420 * NS_PER_MS
    assert network.clock.now() - released.rested_at >= REST_FOR


def test_a_shaft_that_goes_on_turning_is_told(bench: Bench) -> None:
    bus, servo, network, drive = bench
    enabled(bench)

    def turned() -> None:
        servo.values[0x606C, 0] = 40_000

    bus.call_after(30 * NS_PER_MS, turned)
    started = network.clock.now()
    released = drive.release(Duration(NS_PER_S))
    assert not released.at_rest
    assert "the host's heartbeat ended" in released.evidence
    assert network.clock.now() - started < 2 * NS_PER_S


def test_release_of_a_dead_bus_raises_nothing(bench: Bench) -> None:
    bus, _, _, drive = bench
    enabled(bench)
    bus.broken = True
    released = drive.release()
    assert not released.at_rest
    assert "the adapter is gone" in released.evidence


def test_release_of_a_silent_drive_is_bounded(bench: Bench) -> None:
    bus, servo, network, drive = bench
    enabled(bench)
    drive.write(command(1.0, network))
    servo.silent = True
    started = network.clock.now()
    released = drive.release(Duration(NS_PER_S))
    assert not released.at_rest
    assert network.clock.now() - started < 3 * NS_PER_S
    # The first thing that went out was the quick stop, with no torque behind it.
    assert bus.sent_to(0x201)[-1] == bytes.fromhex("02000000")
    # The last: nobody hears a heartbeat any more, and every drive stops that listens for it.
    assert "the host's heartbeat ended: each drive on fake that watches it (1016h) stops" in released.evidence
    beats = len(bus.sent_to(0x77F))
    network.pump(soon(network))
    assert len(bus.sent_to(0x77F)) == beats


def test_a_drive_that_does_not_watch_the_host_is_left_to_a_hand(bench: Bench) -> None:
    _, servo, network, drive = bench
    del servo.types[0x1016, 0]
    drive.connect(soon(network))
    drive.configure(replace(SETTINGS, unwatched=True))
    servo.silent = True
    assert drive.release(Duration(NS_PER_S)).evidence.endswith("stop it by hand")
    assert network.produces_heartbeat


def test_release_before_connect_touches_nothing(bench: Bench) -> None:
    bus, _, _, drive = bench
    assert drive.release().at_rest
    assert bus.sent == []


def test_refused_controlword_is_an_error(bench: Bench) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    servo.refuse[0x6040, 0] = 0x08000022
    servo.nmt_state = 0x04
    with pytest.raises(TransferAborted, match="08000022h"):
        drive.enable(soon(network))
