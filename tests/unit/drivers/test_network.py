"""The pumped master: dispatch, heartbeats, emergencies, SDO and posted downloads."""

from collections.abc import Iterator
from typing import Any

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.posted import TransferPost
from servobench.drivers.errors import BusDown, NoAnswer, TransferAborted
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

MS = Duration(NS_PER_MS)
Rig = tuple[FakeBus, FakeServo, CanopenNetwork]


@pytest.fixture
def rig() -> Iterator[Rig]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network
    bus.shutdown()


def later(network: CanopenNetwork, ms: float) -> Instant:
    return network.deadline_after(Duration(round(ms * NS_PER_MS)))


def test_pump_lets_exactly_the_time_pass(rig: Rig) -> None:
    bus, _, network = rig
    network.pump(Instant(5 * NS_PER_MS))
    assert bus.now() == 5 * NS_PER_MS
    network.pump(Instant(0))
    assert bus.now() == 5 * NS_PER_MS


def test_pump_one_handles_one_frame(rig: Rig) -> None:
    bus, _, network = rig
    seen: list[tuple[bytes, Instant]] = []
    network.listen(0x181, lambda data, at: seen.append((data, at)))
    for place in (1, 2):
        bus.deliver(0x181, bytes([place]), place * NS_PER_MS)
    assert network.pump_one(Instant(10 * NS_PER_MS))
    assert seen == [(b"\x01", NS_PER_MS)]
    assert network.pump_one(Instant(10 * NS_PER_MS))
    assert not network.pump_one(Instant(10 * NS_PER_MS))
    assert bus.now() == 10 * NS_PER_MS


def test_remote_and_extended_frames_are_no_data(rig: Rig) -> None:
    bus, _, network = rig
    seen: list[bytes] = []
    network.listen(0x181, lambda data, _at: seen.append(data))
    bus.deliver(0x181, b"", remote=True, remote_length=8)
    bus.deliver(0x181, b"\x07", extended=True)
    network.pump(later(network, 1))
    assert seen == []
    assert network.link.ignored_frames == 2


def test_sync_is_counted_and_empty(rig: Rig) -> None:
    bus, _, network = rig
    network.pump(Instant(NS_PER_MS))
    assert network.send_sync() == NS_PER_MS
    assert network.sync_count == 1
    assert bus.sent_to(0x080) == [b""]


def test_heartbeat_keeps_its_grid_and_is_not_made_up_for(rig: Rig) -> None:
    bus, _, network = rig
    network.produce_heartbeat(Duration(10 * MS))
    network.pump(Instant(25 * NS_PER_MS))
    bus.sleep_until(Instant(57 * NS_PER_MS))
    network.pump(Instant(75 * NS_PER_MS))
    beats = [at // NS_PER_MS for at, frame in bus.sent if frame.can_id == 0x77F]
    assert beats == [0, 10, 20, 57, 60, 70]
    network.produce_heartbeat(Duration(0))
    network.pump(Instant(200 * NS_PER_MS))
    assert len(bus.sent_to(0x77F)) == 6


def test_heartbeat_goes_out_under_a_flood(rig: Rig) -> None:
    bus, _, network = rig
    network.produce_heartbeat(Duration(10 * MS))
    for place in range(1000):
        bus.deliver(0x123, b"", place * NS_PER_MS // 10)
    while network.pump_one(Instant(100 * NS_PER_MS)):
        pass
    assert len(bus.sent_to(0x77F)) == 11


def test_a_silent_node_is_noted_when_it_was_due(rig: Rig) -> None:
    bus, _, network = rig
    network.watch(2, Duration(30 * MS))
    for place in range(1, 5):
        bus.deliver(0x702, b"\x05", place * 10 * NS_PER_MS)
    network.pump(Instant(69 * NS_PER_MS))
    assert network.status(2).lost_at is None
    assert network.status(2).state is NmtState.OPERATIONAL
    network.pump(Instant(90 * NS_PER_MS))
    assert network.status(2).lost_at == 70 * NS_PER_MS
    bus.deliver(0x702, b"\x7f", NS_PER_MS)
    network.pump(later(network, 2))
    assert network.status(2).lost_at is None


def test_boot_up_is_counted_and_odd_heartbeats_are_borne(rig: Rig) -> None:
    bus, _, network = rig
    status = network.status(3)
    for data in (b"\x00", b"", b"\x05\x05", b"\x42"):
        bus.deliver(0x703, data)
    network.pump(later(network, 1))
    assert status.boot_ups == 1
    assert status.state is None


def test_a_guarded_node_is_asked_and_its_toggle_bit_has_to_alternate(rig: Rig) -> None:
    """CiA 301 7.2.8.3.2.1: an answer whose toggle bit does not change counts as none."""
    bus, _, network = rig
    network.guard(3, Duration(10 * MS))
    status = network.status(3)
    heard = []
    for place, data in enumerate((b"\x05", b"\x85", b"\x85", b"\x05", b"\x00", b"\x7f"), start=1):
        bus.deliver(0x703, data)
        network.pump(Instant(place * NS_PER_MS + 1))
        heard.append(status.heartbeat_at)
    assert heard[2] == heard[1], "repeated"
    assert len(set(heard)) == 5
    assert (status.state, status.boot_ups) == (NmtState.PRE_OPERATIONAL, 1)
    asked = [(frame.remote, frame.remote_length) for _, frame in bus.sent if frame.can_id == 0x703]
    assert set(asked) == {(True, 1)}
    network.pump(Instant(100 * NS_PER_MS))
    assert len([frame for _, frame in bus.sent if frame.can_id == 0x703]) == 11
    network.guard(3, Duration(0))
    bus.deliver(0x703, b"\x7f")
    network.pump(Instant(120 * NS_PER_MS))
    assert status.heartbeat_at == 100 * NS_PER_MS, "a heartbeat has no toggle bit"


def test_life_signs_are_withheld_and_their_longest_gap_is_known(rig: Rig) -> None:
    bus, _, network = rig
    network.produce_heartbeat(Duration(10 * MS))
    network.guard(3, Duration(10 * MS))
    network.pump(Instant(30 * NS_PER_MS))
    assert network.life_signs.longest_gap_ns == 10 * MS
    bus.sleep_until(Instant(77 * NS_PER_MS))
    network.pump(Instant(80 * NS_PER_MS))
    assert network.life_signs.longest_gap_ns == 47 * MS
    network.life_signs.longest_gap_ns = Duration(0)
    network.withhold_life_signs()
    sent = len(bus.sent)
    network.pump(Instant(500 * NS_PER_MS))
    assert len(bus.sent) == sent
    network.resume_life_signs()
    assert len(bus.sent) == sent + 2
    assert network.life_signs.longest_gap_ns == 0, "what was withheld is no gap"
    network.fall_silent()
    network.pump(Instant(900 * NS_PER_MS))
    assert len(bus.sent) == sent + 2


def test_emergencies_are_values(rig: Rig) -> None:
    bus, _, network = rig
    told: list[Emergency] = []
    network.status(1)
    network.on_emergency(told.append)
    bus.deliver(0x081, bytes.fromhex("3081110000000005"), NS_PER_MS)
    bus.deliver(0x081, b"\x00\x10", NS_PER_MS)
    network.pump(later(network, 2))
    (emergency,) = network.emergencies
    assert told == [emergency]
    assert (emergency.code, emergency.register, emergency.at) == (0x8130, 0x11, NS_PER_MS)
    assert "heartbeat" in str(emergency)


def test_canopens_own_services_send_data_frames_alone(rig: Rig) -> None:
    bus, _, network = rig
    network.send_message(0x201, [1, 2])
    with pytest.raises(ValueError, match="remote frames"):
        network.send_message(0x701, b"", remote=True)
    assert [(frame.can_id, frame.data) for _, frame in bus.sent] == [(0x201, b"\x01\x02")]


def test_nmt_command(rig: Rig) -> None:
    bus, servo, network = rig
    network.command(NmtCommand.START, 1)
    assert bus.sent_to(0) == [b"\x01\x01"]
    assert servo.nmt_state == 5


def test_sdo_reads_and_writes(rig: Rig) -> None:
    _, servo, network = rig
    objects = RemoteObjects(network, 1)
    objects.write(0x6071, 0, "h", -123)
    assert servo.values[0x6071, 0] == -123
    assert objects.read(0x6071, 0, "h") == -123
    assert objects.read_text(0x1008) == "Fake servo with a long name"
    assert objects.read_if_there(0x5555) is None
    with pytest.raises(ValueError, match="70000 does not fit"):
        objects.write(0x6071, 0, "h", 70000)


def test_sdo_abort_names_node_object_and_code(rig: Rig) -> None:
    _, servo, network = rig
    servo.refuse[0x6040, 0] = 0x06010002
    with pytest.raises(TransferAborted, match=r"node 1 on fake refused to write 6040h:00; .*06010002h"):
        network.download(1, 0x6040, 0, b"\0\0")


def test_sdo_request_is_repeated_then_given_up(rig: Rig) -> None:
    bus, servo, network = rig
    servo.deaf_to_sdo = 2
    assert network.upload(1, 0x1000) == bytes.fromhex("92010200")
    servo.deaf_to_sdo = 10
    started = bus.now()
    with pytest.raises(NoAnswer, match=r"node 1 on fake did not answer the SDO read of 1000h:00"):
        network.upload(1, 0x1000)
    assert bus.now() - started == 6 * 200 * NS_PER_MS
    # What is given up is aborted with its multiplexer (CiA 301 7.2.4.3.17).
    assert bus.sent_to(0x601)[-1] == bytes.fromhex("8000100000000405")


def test_a_late_answer_is_not_taken_for_the_next_ones(rig: Rig) -> None:
    bus, servo, network = rig
    servo.values[0x6071, 0] = 42
    bus.deliver(0x581, bytes.fromhex("4300100011223344"), NS_PER_MS // 20)
    bus.deliver(0x581, b"\x43", NS_PER_MS // 20)
    assert network.upload(1, 0x6071) == b"\x2a\x00"


def test_a_doubled_answer_does_not_disturb_segments(rig: Rig) -> None:
    bus, _, network = rig
    bus.deliver(0x581, bytes.fromhex("410810001b000000"), NS_PER_MS // 20)
    assert network.upload(1, 0x1008) == b"Fake servo with a long name"


def test_posted_download_is_confirmed_without_waiting(rig: Rig) -> None:
    bus, servo, network = rig
    posted = network.post_download(1, 0x6085, 0, (600).to_bytes(4, "little", signed=True))
    assert bus.now() == 0
    assert posted.done_at is None
    network.pump(Instant(NS_PER_MS))
    assert posted.done_at == NS_PER_MS // 10
    assert posted.failure is None
    assert servo.values[0x6085, 0] == 600


def test_posted_download_is_repeated(rig: Rig) -> None:
    _, servo, network = rig
    servo.deaf_to_sdo = 2
    posted = network.post_download(1, 0x6085, 0, bytes(4))
    network.pump(Instant(NS_PER_S))
    assert posted.failure is None
    assert posted.attempts == 3


def test_posted_download_is_given_up(rig: Rig) -> None:
    _, servo, network = rig
    servo.silent = True
    posted = network.post_download(1, 0x6085, 0, bytes(4))
    network.pump(Instant(NS_PER_S))
    assert isinstance(posted.failure, NoAnswer)
    assert posted.done_at == 100 * NS_PER_MS


def test_a_posted_upload_is_repeated_and_given_up_with_nobody_told(rig: Rig) -> None:
    bus, servo, network = rig
    servo.silent = True
    told: list[bytes] = []
    network.post_upload(1, 0x6041, 0, lambda data, _at: told.append(data))
    network.pump(Instant(NS_PER_S))
    assert len(bus.sent_to(0x601)) == TransferPost.ATTEMPTS
    with pytest.raises(NoAnswer):  # its channel is free again
        network.upload(1, 0x6041)
    assert told == []


def test_posted_download_that_is_refused(rig: Rig) -> None:
    _, _, network = rig
    posted = network.post_download(1, 0x6099, 1, b"\x01")
    network.pump(Instant(NS_PER_S))
    assert isinstance(posted.failure, TransferAborted)


def test_the_latest_of_waiting_posts_wins(rig: Rig) -> None:
    bus, servo, network = rig
    first, *_ = [network.post_download(1, 0x6085, 0, bytes([value, 0, 0, 0])) for value in (1, 2, 3)]
    network.post_download(1, 0x6071, 0, b"\x07\x00")
    network.pump(Instant(NS_PER_S))
    assert first.done_at is not None
    assert servo.values[0x6085, 0] == 3
    assert servo.values[0x6071, 0] == 7
    assert [data[4] for data in bus.sent_to(0x601)] == [1, 3, 7]


def test_a_transfer_waits_for_posts_on_its_channel(rig: Rig) -> None:
    _, servo, network = rig
    network.post_download(1, 0x6085, 0, bytes([9, 0, 0, 0]))
    assert network.upload(1, 0x6085) == bytes([9, 0, 0, 0])
    assert servo.values[0x6085, 0] == 9


def test_a_dead_bus_is_one_error(rig: Rig) -> None:
    bus, _, network = rig
    bus.broken = True
    with pytest.raises(BusDown, match=r"receive from fake; the adapter is gone"):
        network.pump(Instant(NS_PER_MS))
    with pytest.raises(BusDown, match="send on fake"):
        network.send_sync()


def test_node_ids_are_checked(rig: Rig) -> None:
    _, _, network = rig
    with pytest.raises(ValueError, match="128"):
        network.status(128)


def test_lss_answers_are_pumped_too(rig: Rig) -> None:
    bus, _, network = rig
    lss: Any = network.lss
    bus.listeners.append(
        lambda frame: bus.deliver(0x7E4, b"\x5e\x05" + bytes(6), NS_PER_MS) if frame.can_id == 0x7E5 else None
    )
    assert lss.inquire_node_id() == 5


@pytest.mark.parametrize(
    ("beat", "seen"), [(b"\x7f", "its heartbeat says PRE_OPERATIONAL"), (b"", "no heartbeat")]
)
def test_a_command_of_nmt_that_has_no_effect_is_told(rig: Rig, beat: bytes, seen: str) -> None:
    """Sent again after two heartbeats each, until a second and four of them have passed."""
    bus, _, network = rig
    if beat:
        for ms in range(0, 2_000, 50):
            bus.deliver(0x701, beat, ms * NS_PER_MS)
    with pytest.raises(NoAnswer) as caught:
        network.change_nmt(1, "the drive", NmtCommand.START, NmtState.OPERATIONAL, Duration(50 * MS))
    assert (
        str(caught.value) == f"the drive did not become OPERATIONAL; {seen}; check its supply and the cable"
    )
    assert set(bus.sent_to(0x000)) == {b"\x01\x01"}
