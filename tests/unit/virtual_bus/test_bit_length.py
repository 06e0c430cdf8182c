"""Frame lengths against a bitwise reference and against published figures."""

import random

import pytest

from servobench.virtual_bus.bus.frame_image import (
    INTERMISSION_BITS,
    LONGEST_FRAME_BITS,
    bits_duration,
    frame_bits,
)
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.can_reference import crc_sequence, random_frame, stuff, wire_bits


def test_ten_thousand_random_frames_match_the_reference() -> None:
    source = random.Random(20110)
    for _ in range(10_000):
        frame = random_frame(source)
        assert frame_bits(frame) == len(wire_bits(frame)), frame


def test_every_length_and_kind_is_covered_by_the_random_frames() -> None:
    source = random.Random(20110)
    kinds = set()
    for _ in range(10_000):
        frame = random_frame(source)
        kinds.add((frame.extended, frame.remote, frame.remote_length if frame.remote else len(frame.data)))
    assert len(kinds) == 2 * 2 * 9


def test_reference_crc_is_zero_over_a_frame_with_its_crc() -> None:
    """A property of any cyclic code: the receiver's remainder over fields and CRC is zero."""
    source = random.Random(5)
    for _ in range(100):
        fields = f"{source.getrandbits(83):083b}"
        assert int(crc_sequence(fields + crc_sequence(fields)), 2) == 0


def test_reference_stuffing_counts_its_own_bits() -> None:
    assert stuff("00000111100001111") == "00000" + "1" + "1111" + "0" + "0000" + "1" + "1111" + "0"
    assert stuff("11111") == "111110"  # also after the last bit of the CRC sequence


@pytest.mark.parametrize(
    ("frame", "bits_without_stuffing"),
    [
        (Frame(0x555), 44),
        (Frame(0x555, b"\x55" * 8), 108),
        (Frame(0x15555555, b"", extended=True), 64),
        (Frame(0x15555555, b"\x55" * 8, extended=True), 128),
        (Frame(0x555, b"", remote=True, remote_length=8), 44),
    ],
)
def test_published_frame_sizes(frame: Frame, bits_without_stuffing: int) -> None:
    """44 + 8 n and 64 + 8 n bits before stuffing; at most (stuffable - 1) / 4 stuff bits more."""
    stuffable = bits_without_stuffing - 10  # CRC delimiter to end of frame are never stuffed
    assert bits_without_stuffing <= frame_bits(frame) <= bits_without_stuffing + (stuffable - 1) // 4


def test_no_frame_is_longer_than_the_longest() -> None:
    source = random.Random(9)
    assert max(frame_bits(random_frame(source)) for _ in range(5_000)) <= LONGEST_FRAME_BITS
    assert LONGEST_FRAME_BITS + INTERMISSION_BITS == 160


def test_duration_is_rounded_up_to_a_nanosecond() -> None:
    assert bits_duration(130, 1_000_000) == 130_000
    assert bits_duration(1, 83_333) == 12_001
    assert bits_duration(0, 500_000) == 0
