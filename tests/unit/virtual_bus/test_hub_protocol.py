"""The hub's records: what is encoded is decoded, and nothing else is."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import Instant
from tests.unit.virtual_bus.can_reference import random_frame
from virtual_bus.can_bus.hub_protocol import (
    FRAME_BYTES,
    PACKET_BYTES_MAX,
    Hello,
    MalformedRecord,
    Received,
    decode_answer,
    decode_frame,
    decode_hello,
    encode_frame,
    encode_hello,
    encode_refusal,
    encode_welcome,
)

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


@pytest.mark.parametrize("receive_own", [False, True])
def test_hello_round_trip(receive_own: bool) -> None:
    assert decode_hello(encode_hello(Hello(500_000, receive_own))) == Hello(500_000, receive_own)


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
    assert decode_answer(encode_welcome(125_000)) == 125_000
    assert decode_answer(encode_refusal("too late")) == "too late"
    assert len(encode_refusal("x" * 2_000)) <= PACKET_BYTES_MAX
    with pytest.raises(MalformedRecord):
        decode_answer(b"HTTP/1.1 400 Bad Request")
