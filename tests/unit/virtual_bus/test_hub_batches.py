"""What a hub's broker sends to one client in one packet, and when."""

import socket
from collections.abc import Iterator

import pytest

from servobench.drivers.timebase import NEVER, Instant
from servobench.virtual_bus.bus.hub_client import Client
from servobench.virtual_bus.bus.hub_protocol import (
    BATCH_FRAMES_MAX,
    ECHO_HELD_NS,
    FRAME_BYTES,
    PACKET_BYTES_MAX,
    Received,
    decode_frame,
    encode_frame,
)
from servobench.virtual_bus.frame import Frame

STATUS = b"a record of another length"


class Ends:
    """A client as the broker has it, and the client's own end of the connection."""

    def __init__(self) -> None:
        connection, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        connection.setblocking(False)
        self.far.setblocking(False)
        self.client = Client(connection, 1)

    def push(self, can_id: int, at: int) -> None:
        self.client.push(encode_frame(Frame(can_id), Instant(at)), Instant(at))

    def packets(self) -> list[bytes]:
        """All that has come."""
        packets = []
        while True:
            try:
                packets.append(self.far.recv(PACKET_BYTES_MAX + 1))
            except BlockingIOError:
                return packets

    def close(self) -> None:
        self.client.socket.close()
        self.far.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    ends = Ends()
    yield ends
    ends.close()


def frames_in(packet: bytes) -> list[Received]:
    return [decode_frame(packet[start : start + FRAME_BYTES]) for start in range(0, len(packet), FRAME_BYTES)]


def ids(packet: bytes) -> list[int]:
    return [received.frame.can_id for received in frames_in(packet)]


def test_frames_that_wait_go_in_as_few_packets_as_they_fit(ends: Ends) -> None:
    ends.client.batches = True
    count = 2 * BATCH_FRAMES_MAX + 1
    for number in range(count):
        ends.push(number, number)
    ends.client.flush()
    packets = ends.packets()
    assert [len(packet) for packet in packets] == [BATCH_FRAMES_MAX * FRAME_BYTES] * 2 + [FRAME_BYTES]
    assert [can_id for packet in packets for can_id in ids(packet)] == list(range(count))
    assert not ends.client.outbox


def test_a_record_that_is_no_frame_has_a_packet_of_its_own_in_its_place(ends: Ends) -> None:
    ends.client.batches = True
    for number in (1, 2):
        ends.push(number, 0)
    ends.client.push(STATUS, Instant(0))
    ends.push(3, 0)
    ends.client.flush()
    first, status, last = ends.packets()
    assert (ids(first), status, ids(last)) == ([1, 2], STATUS, [3])


def test_a_client_that_takes_no_batches_gets_frame_by_frame(ends: Ends) -> None:
    for number in (1, 2, 3):
        ends.push(number, 0)
    ends.client.flush()
    assert [ids(packet) for packet in ends.packets()] == [[1], [2], [3]]


def test_an_echo_waits_for_the_frame_that_answers_it(ends: Ends) -> None:
    ends.client.batches = True
    ends.client.echo(Frame(0x080), Instant(1_000))
    assert ends.client.due == 1_000 + ECHO_HELD_NS
    ends.push(0x181, 201_000)
    assert ends.client.due == 201_000
    ends.client.flush()
    (packet,) = ends.packets()
    echo, answer = frames_in(packet)
    assert (echo.frame.can_id, echo.at, echo.own) == (0x080, 1_000, True)
    assert (answer.frame.can_id, answer.at, answer.own) == (0x181, 201_000, False)
    assert ends.client.due == NEVER


def test_an_echo_waits_for_nothing_where_no_batches_are_taken(ends: Ends) -> None:
    ends.client.echo(Frame(0x080), Instant(1_000))
    assert ends.client.due == 1_000


def test_what_a_full_socket_does_not_take_is_sent_later_in_its_order(ends: Ends) -> None:
    ends.client.batches = True
    count = 0
    while not ends.client.full:
        ends.push(count % 0x7FF, count)
        count += 1
        ends.client.flush()
    assert ends.client.outbox
    for _ in range(3):
        ends.push(count % 0x7FF, count)
        count += 1
    assert ends.client.due == NEVER
    stamps = []
    while ends.client.outbox:
        stamps += [received.at for packet in ends.packets() for received in frames_in(packet)]
        ends.client.flush()
    stamps += [received.at for packet in ends.packets() for received in frames_in(packet)]
    assert stamps == list(range(count))
    assert not ends.client.full


def test_a_client_that_is_gone_gets_nothing_more(ends: Ends) -> None:
    ends.far.close()
    ends.push(1, 0)
    ends.client.flush()
    assert ends.client.deaf
    ends.push(2, 0)
    assert not ends.client.outbox
