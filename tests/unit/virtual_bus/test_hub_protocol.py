"""The hub's records: what is encoded is decoded, and nothing else is."""

import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servobench.drivers.timebase import Instant
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
    frame_of,
    is_own,
    split_batch,
)
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.timeline import Timeline
from tests.unit.virtual_bus.can_reference import random_frame

EXAMPLES = settings(derandomize=True, deadline=None)


@EXAMPLES
@given(st.integers(0, 1 << 20), st.integers(0, (1 << 63) - 1), st.booleans())
def test_frame_round_trip(seed: int, at: int, own: bool) -> None:
    frame = random_frame(random.Random(seed))
    packet = encode_frame(frame, Instant(at), own)
    assert len(packet) == FRAME_BYTES
    assert decode_frame(packet) == Received(frame, Instant(at), own)


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


def received(packet: bytes) -> list[Received]:
    """As a client takes a batch apart."""
    return [
        Received(frame_of(handed_at, can_id, flags, dlc, data), Instant(at), is_own(flags))
        for at, handed_at, can_id, flags, dlc, data in split_batch(packet)
    ]


@EXAMPLES
@given(st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, (1 << 63) - 1), st.booleans()), min_size=1))
def test_a_batch_is_its_frames_in_order(records: list[tuple[int, int, bool]]) -> None:
    sent = [Received(random_frame(random.Random(seed)), Instant(at), own) for seed, at, own in records]
    assert received(b"".join(encode_frame(*each) for each in sent)) == sent


@EXAMPLES
@given(st.binary(max_size=5 * FRAME_BYTES))
def test_any_bytes_are_a_batch_of_valid_frames_or_malformed(packet: bytes) -> None:
    parts = [packet[start : start + FRAME_BYTES] for start in range(0, len(packet), FRAME_BYTES)]
    try:
        frames = received(packet)
    except (MalformedRecord, struct.error):
        with pytest.raises(MalformedRecord):
            [decode_frame(part) for part in parts]
    else:
        assert frames == [decode_frame(part) for part in parts]


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
