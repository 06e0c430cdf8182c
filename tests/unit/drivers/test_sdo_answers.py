"""SDO answers that are lost, late, or given by two nodes."""

from collections.abc import Iterator
from contextlib import suppress

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.polls import Polled
from servobench.drivers.canopen.sdo import SDO_ATTEMPTS
from servobench.drivers.errors import AnswersTwice, NoAnswer
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

Rig = tuple[FakeBus, FakeServo, CanopenNetwork]
READS = 4


@pytest.fixture
def rig() -> Iterator[Rig]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network
    bus.shutdown()


def later(network: CanopenNetwork, ms: float) -> Instant:
    return network.deadline_after(Duration(round(ms * NS_PER_MS)))


def read_repeatedly(network: CanopenNetwork) -> None:
    for _ in range(READS):
        network.upload(1, 0x1000)
        network.pump(later(network, 2))


def test_two_nodes_on_one_id_are_refused_and_told_at_their_answers(rig: Rig) -> None:
    bus, _, network = rig
    FakeServo(bus)
    told: list[tuple[int, Instant]] = []
    network.on_surplus_answer = lambda node_id, _data, at: told.append((node_id, at))
    read_repeatedly(network)
    with pytest.raises(AnswersTwice, match="two devices are likely to have the node id 1"):
        network.refuse_two(1)
    assert [node_id for node_id, _ in told] == [1] * READS
    assert all(at <= bus.now() for _, at in told)


def test_answers_to_another_master_are_not_too_many(rig: Rig) -> None:
    bus, _, network = rig
    another = bytes.fromhex("4018100100000000")
    answer = bytes.fromhex("4318100134120000")
    network.upload(1, 0x1000)
    for place in range(20):
        bus.deliver(0x601, another, place * NS_PER_MS)
        bus.deliver(0x581, answer, place * NS_PER_MS + NS_PER_MS // 4)
    read_repeatedly(network)
    network.pump(later(network, 30))
    network.refuse_two(1)


def test_an_answer_under_way_to_another_master_at_the_first_look_is_none_too_many(rig: Rig) -> None:
    bus, _, network = rig
    told: list[int] = []
    network.on_surplus_answer = lambda node_id, _data, _at: told.append(node_id)
    bus.deliver(0x581, bytes.fromhex("4318100134120000"), NS_PER_MS // 20)
    read_repeatedly(network)
    assert told == []


@pytest.mark.parametrize("late_ms", [250, 2000])
def test_answers_to_repeated_requests_are_owed_however_late(rig: Rig, late_ms: int) -> None:
    """Each request is answered once, the repeated ones too, by a node that is slow for a while."""
    _, servo, network = rig
    told: list[int] = []
    network.on_surplus_answer = lambda node_id, _data, _at: told.append(node_id)
    servo.sdo_takes_ns = late_ms * NS_PER_MS
    poll = network.poll(Polled(1, 0x6061, 0, Duration(50 * NS_PER_MS), lambda _data, _at: None))
    for index in (0x1000, 0x6071):
        with suppress(NoAnswer):
            network.upload(1, index)
    network.pump(later(network, 3000))
    network.polls.end(poll)
    servo.sdo_takes_ns = NS_PER_MS // 10
    network.pump(later(network, 3000))
    read_repeatedly(network)
    network.refuse_two(1)
    assert told == []


@pytest.mark.parametrize(
    ("late", "writes"),
    [("4b85600034120000", True), ("6085600000000000", False)],
    ids=["answer to a read before a write", "answer to a write before a read"],
)
def test_a_late_answer_of_the_other_kind_is_not_taken_for_that_to_the_same_object(
    rig: Rig, late: str, writes: bool
) -> None:
    """A slow node answers a repeated request once more, after the next one has been sent."""
    bus, _, network = rig
    bus.deliver(0x581, bytes.fromhex(late), NS_PER_MS // 20)
    if writes:
        network.download(1, 0x6085, 0, bytes(4))
    assert network.upload(1, 0x6085) == bytes(4)


def test_a_read_is_given_up_though_polls_of_the_silent_node_are_due(rig: Rig) -> None:
    """Each poll is due again by the time at which the one before is given up."""
    bus, servo, network = rig
    servo.deaf_to_sdo = 1000
    network.poll(Polled(1, 0x6061, 0, Duration(50 * NS_PER_MS), lambda _data, _at: None))
    with pytest.raises(NoAnswer, match="did not answer the SDO read of 1000h:00"):
        network.upload(1, 0x1000)
    assert bus.now() < 2000 * NS_PER_MS


def test_requests_that_nobody_answered_hide_two_nodes_for_a_while_only(rig: Rig) -> None:
    bus, servo, network = rig
    servo.deaf_to_sdo = 5 * (SDO_ATTEMPTS + 1)  # and the abort of each
    for _ in range(5):
        with pytest.raises(NoAnswer):
            network.upload(1, 0x1000)
    FakeServo(bus)
    network.pump(later(network, 5000))
    read_repeatedly(network)
    with pytest.raises(AnswersTwice):
        network.refuse_two(1)


def test_a_read_whose_segment_is_lost_begins_anew(rig: Rig) -> None:
    """A server takes a segment that is asked for again for an error of the protocol (CiA 301 7.2.4.3.6)."""
    _, servo, network = rig
    servo.segments_lost = 2
    assert RemoteObjects(network, 1).read_text(0x1008) == "Fake servo with a long name"


def test_a_read_that_breaks_off_again_and_again_is_no_refusal(rig: Rig) -> None:
    _, servo, network = rig
    servo.segments_lost = 100
    with pytest.raises(NoAnswer, match=r"did not answer the SDO read of 1008h:00; .*05030000h"):
        RemoteObjects(network, 1).read_text(0x1008)
