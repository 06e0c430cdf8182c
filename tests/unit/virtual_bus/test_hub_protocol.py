"""The hub's records: what is encoded is decoded, and nothing else is."""

import random
import socket
from collections import deque
from collections.abc import Iterator
from itertools import repeat
from typing import NoReturn

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import NEVER, Instant, MonotonicClock
from servobench.drivers.wire.frame_port import UNTOLD
from servobench.virtual_bus.bus.hub_protocol import (
    BATCH_FRAMES_MAX,
    FRAME_BYTES,
    PACKET_BYTES_MAX,
    Hello,
    MalformedRecord,
    Received,
    Request,
    decode_answer,
    decode_frame,
    decode_hello,
    encode_frame,
    encode_hello,
    encode_refusal,
    encode_request,
    encode_status,
    encode_welcome,
)
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import HubEnd
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.draws import examples_of
from tests.unit.virtual_bus.can_reference import random_frame

EXAMPLES = examples_of(100)


@EXAMPLES
@given(st.integers(0, 1 << 20), st.integers(0, (1 << 63) - 1), st.booleans())
def test_frame_round_trip(seed: int, at: int, own: bool) -> None:
    frame = random_frame(random.Random(seed))
    packet = encode_frame(frame, Instant(at), own)
    assert len(packet) == FRAME_BYTES
    assert decode_frame(packet) == Received(frame, Instant(at), own)


def test_the_hand_over_travels_and_a_ninth_octet_does_not() -> None:
    frame = Frame(0x7FF, b"12345678")
    frame.handed_at = Instant(1 << 40)
    packet = encode_frame(frame)
    assert decode_frame(packet).frame.handed_at == 1 << 40
    with pytest.raises(MalformedRecord, match="identifier 0x7ff, DLC 9"):
        decode_frame(packet[:21] + b"\x09" + packet[22:])


@EXAMPLES
@given(st.binary(min_size=FRAME_BYTES, max_size=FRAME_BYTES) | st.binary(max_size=64))
def test_any_bytes_are_a_valid_frame_or_malformed(packet: bytes) -> None:
    try:
        frame = decode_frame(packet).frame
    except MalformedRecord:
        return
    assert len(packet) == FRAME_BYTES
    assert 0 <= frame.can_id < (1 << 29 if frame.extended else 1 << 11)
    assert len(frame.data) <= 8
    assert frame.remote_length <= 8


class Told:
    """Of a client's end: packets that are no frames, and failures by the system's number."""

    def __init__(self) -> None:
        self.packets: list[bytes] = []
        self.asked = 0

    def note(self, packet: bytes) -> None:
        self.packets.append(packet)

    def failed(self, error: int) -> NoReturn:
        raise OSError(error, "told")

    def check_state(self) -> None:
        self.asked += 1


class Connection:
    """The broker's socket of a connection, and the client's end."""

    def __init__(self) -> None:
        self.broker, self._client = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._client.setblocking(False)
        self.told = Told()
        self.end = HubEnd(self._client.fileno(), self.told)

    def received(self) -> list[Received]:
        """All that is there."""
        frames = []
        while (received := self.end.receive(MonotonicClock().now())) is not None:
            frames.append(Received(*received))
        return frames

    def close(self) -> None:
        self.broker.close()
        self._client.close()


@pytest.fixture(scope="module")
def connection() -> Iterator[Connection]:
    """One for all drawn packets: each test takes out all that it put in."""
    connection = Connection()
    yield connection
    connection.close()


@EXAMPLES
@given(st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, (1 << 63) - 1), st.booleans()), min_size=1))
def test_a_batch_is_its_frames_in_order(connection: Connection, records: list[tuple[int, int, bool]]) -> None:
    sent = [Received(random_frame(random.Random(seed)), Instant(at), own) for seed, at, own in records]
    for first in range(0, len(sent), BATCH_FRAMES_MAX):
        connection.broker.send(b"".join(encode_frame(*each) for each in sent[first:][:BATCH_FRAMES_MAX]))
    assert connection.received() == sent
    assert [each.frame.handed_at for each in sent] == [UNTOLD] * len(sent)


@EXAMPLES
@given(st.binary(min_size=1, max_size=5 * FRAME_BYTES))
def test_any_bytes_are_a_batch_of_valid_frames_or_malformed_or_no_frames(
    connection: Connection, packet: bytes
) -> None:
    parts = [packet[start : start + FRAME_BYTES] for start in range(0, len(packet), FRAME_BYTES)]
    connection.broker.send(packet)
    frames, malformed = [], 0
    while True:
        try:
            frames += connection.received()
        except ValueError:
            malformed += 1
        else:
            break
    if len(packet) % FRAME_BYTES:
        assert (connection.told.packets.pop(), frames, malformed) == (packet, [], 0)
        return
    assert not connection.told.packets
    for part in parts:
        try:
            decode_frame(part)
        except MalformedRecord:
            malformed -= 1
    assert not malformed


def test_what_came_before_the_broker_closed_is_handed_on() -> None:
    connection = Connection()
    connection.broker.send(encode_frame(Frame(0x181), Instant(5)))
    connection.broker.send(b"a status")
    connection.broker.close()
    assert connection.end.receive(NEVER) == (Frame(0x181), 5, False)
    assert connection.told.packets == [b"a status"]
    for _ in range(2):
        with pytest.raises(OSError, match=r"\[Errno 0\]"):
            connection.end.receive(NEVER)
    with pytest.raises(BrokenPipeError):
        connection.end.transmit(Frame(1))
    connection.end.close()
    with pytest.raises(OSError, match=r"\[Errno 0\]"):
        connection.end.transmit(Frame(1))
    with pytest.raises(OSError, match=r"\[Errno 0\]"):
        connection.end.receive(MonotonicClock().now())
    connection.close()


def test_what_waits_is_handed_on_though_the_deadline_has_passed(connection: Connection) -> None:
    for count in (9, 4, 1):
        for number in range(count):
            connection.broker.send(encode_frame(Frame(number)))
        for number in range(count):
            assert connection.end.receive(Instant(0)) == (Frame(number), 0, False)
        assert connection.end.receive(Instant(0)) is None


def test_only_frames_that_the_filter_accepts_are_handed_on(connection: Connection) -> None:
    connection.end.accepts = lambda frame: frame.can_id % 2 == 0
    connection.broker.send(b"".join(encode_frame(Frame(number)) for number in range(5)))
    assert [received.frame.can_id for received in connection.received()] == [0, 2, 4]
    connection.end.accepts = None
    connection.broker.send(encode_frame(Frame(1)))
    assert [received.frame.can_id for received in connection.received()] == [1]


def test_sending_is_refused_once_the_socket_is_full_and_asks_for_the_state_while_bus_off() -> None:
    connection = Connection()
    connection.end.transmit(Frame(0x201, b"1"))
    assert (decode_frame(connection.broker.recv(64)).frame, connection.told.asked) == (Frame(0x201, b"1"), 0)
    connection.end.bus_off = True
    connection.end.transmit(Frame(0x201))
    assert connection.told.asked == 1
    with pytest.raises(BlockingIOError):
        deque(map(connection.end.transmit, repeat(Frame(0x201))), maxlen=0)
    connection.close()


def test_a_full_batch_is_a_packet_and_no_request_or_answer_is_as_long_as_frames() -> None:
    assert PACKET_BYTES_MAX - FRAME_BYTES < BATCH_FRAMES_MAX * FRAME_BYTES <= PACKET_BYTES_MAX
    port = CanSegment(Timeline()).attach("port", Listener())
    for packet in (encode_status(port, 0.0, 0, asked=True, alone=True), encode_request(Request.STATUS)):
        assert len(packet) % FRAME_BYTES


@pytest.mark.parametrize("batches", [False, True])
@pytest.mark.parametrize("receive_own", [False, True])
def test_hello_round_trip(receive_own: bool, batches: bool) -> None:
    hello = Hello(500_000, receive_own, batches)
    assert decode_hello(encode_hello(hello)) == hello


def test_other_version_is_named() -> None:
    packet = bytearray(encode_hello(Hello(0, False)))
    packet[4] = 99
    with pytest.raises(MalformedRecord, match="client version 99"):
        decode_hello(bytes(packet))


@EXAMPLES
@given(st.binary(max_size=40))
def test_other_bytes_are_no_hello(packet: bytes) -> None:
    with pytest.raises(MalformedRecord):
        decode_hello(packet)


def test_answers() -> None:
    assert decode_answer(encode_welcome(125_000, Instant(7))) == (125_000, 7)
    assert decode_answer(encode_refusal("too late")) == "too late"
    assert len(encode_refusal("x" * 2_000)) <= PACKET_BYTES_MAX
    with pytest.raises(MalformedRecord):
        decode_answer(b"HTTP/1.1 400 Bad Request")
