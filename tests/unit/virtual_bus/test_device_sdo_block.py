"""SDO block transfers: sub-blocks, repetition after losses, CRC (CiA 301, 7.2.4.3.9..16)."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.sdo_server import block_crc
from tests.draws import examples_of
from tests.unit.virtual_bus.device_bench import LEVEL, NODE, NOTE, Bench

EXAMPLES = examples_of(40)
NOTE_MUX = NOTE.to_bytes(2, "little") + b"\x00"
REQUEST = 0x600 + NODE


def abort_of(answer: bytes) -> int:
    assert answer[0] == 0x80, answer.hex()
    return int.from_bytes(answer[4:8], "little")


def bitwise_crc(data: bytes) -> int:
    """x^16 + x^12 + x^5 + 1, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def segments_of(data: bytes) -> list[bytes]:
    return [data[start : start + 7] for start in range(0, len(data), 7)] or [b""]


def download(bench: Bench, data: bytes, loss: float = 0.0, crc: int | None = None) -> bytes:
    """Block download of NOTE over a bus that loses segments; returns the answer to the end request."""
    lottery = random.Random(len(data))
    answer = bench.request(b"\xc6" + NOTE_MUX + len(data).to_bytes(4, "little"))
    assert answer[0] == 0xA4
    pieces, done, block = segments_of(data), 0, answer[4]
    while done < len(pieces):
        batch = pieces[done : done + block]
        answers = []
        for number, piece in enumerate(batch, 1):
            last = done + number == len(pieces)
            if lottery.random() < loss and number < len(batch):
                continue
            segment = bytes([number | last << 7]) + piece.ljust(7, b"\x00")
            answers += bench.put(REQUEST, segment)
        (frame,) = answers
        assert frame.data[0] == 0xA2
        done, block = done + frame.data[1], frame.data[2]
    unused = 7 * len(pieces) - len(data)
    value = block_crc(data) if crc is None else crc
    return bench.request(bytes([0xC1 | unused << 2]) + value.to_bytes(2, "little") + bytes(5))


def upload(bench: Bench, block: int, loss: float = 0.0) -> bytes:
    """Block upload of NOTE over a bus that loses segments."""
    lottery = random.Random(block)
    answer = bench.request(b"\xa4" + NOTE_MUX + bytes([block, 0, 0, 0]))
    assert answer[0] == 0xC6
    size, data = int.from_bytes(answer[4:8], "little"), b""
    frames = bench.put(REQUEST, b"\xa3" + bytes(7))
    while True:
        expected = 1
        for frame in frames:
            if lottery.random() >= loss and frame.data[0] & 0x7F == expected:
                data += frame.data[1:]
                expected += 1
        frames = bench.put(REQUEST, bytes([0xA2, expected - 1, block]) + bytes(5))
        if frames[0].data[0] & 0xE3 == 0xC1 and expected > 1 and len(data) >= size:
            break
    end = frames[0].data
    data = data[: len(data) - (end[0] >> 2 & 7)]
    assert len(data) == size
    assert int.from_bytes(end[1:3], "little") == block_crc(data)
    assert bench.put(REQUEST, b"\xa1" + bytes(7)) == []
    return data


@given(st.binary(max_size=200))
@EXAMPLES
def test_crc_against_the_bitwise_one(data: bytes) -> None:
    assert block_crc(data) == bitwise_crc(data)


def test_crc_check_value() -> None:
    assert block_crc(b"123456789") == 0x31C3


@pytest.mark.parametrize("loss", [0.0, 0.2])
@given(length=st.integers(1, 2500))
@EXAMPLES
def test_download_with_and_without_losses(loss: float, length: int) -> None:
    bench, data = Bench(), random.Random(length).randbytes(length)
    assert download(bench, data, loss)[0] == 0xA1
    assert bench.device.dictionary.variable(NOTE).value == data


@pytest.mark.parametrize("loss", [0.0, 0.2])
@given(length=st.integers(0, 2500), block=st.integers(1, 127))
@EXAMPLES
def test_upload_with_and_without_losses(loss: float, length: int, block: int) -> None:
    bench, data = Bench(), random.Random(length).randbytes(length)
    bench.device.dictionary.variable(NOTE).value = data
    assert upload(bench, block, loss) == data


def test_wrong_crc_is_refused() -> None:
    bench = Bench()
    assert abort_of(download(bench, bytes(20), crc=0x1234)) == AbortCode.CRC
    assert bench.device.dictionary.variable(NOTE).value == b""


def test_client_without_crc_is_served() -> None:
    bench = Bench()
    bench.request(b"\xc0" + NOTE_MUX + bytes(4))
    bench.request(b"\x81abcdefg")
    assert bench.request(b"\xc1\xff\xff" + bytes(5))[0] == 0xA1
    assert bench.device.dictionary.variable(NOTE).value == b"abcdefg"


def test_segment_beyond_the_sequence_is_not_taken() -> None:
    bench = Bench()
    bench.request(b"\xc0" + NOTE_MUX + bytes(4))
    assert bench.put(REQUEST, b"\x01abcdefg") == []
    assert bench.request(b"\x83ABCDEFG")[:2] == b"\xa2\x01"
    assert bench.request(b"\x81hijklmn")[:2] == b"\xa2\x01"
    assert bench.request(b"\xc1" + bytes(7))[0] == 0xA1
    assert bench.device.dictionary.variable(NOTE).value == b"abcdefghijklmn"


def test_sequence_number_zero_is_aborted() -> None:
    bench = Bench()
    bench.request(b"\xc0" + NOTE_MUX + bytes(4))
    assert abort_of(bench.request(bytes(8))) == AbortCode.SEQUENCE_NUMBER


def test_client_may_abort_within_a_sub_block() -> None:
    bench = Bench()
    bench.request(b"\xc0" + NOTE_MUX + bytes(4))
    assert bench.put(REQUEST, b"\x80" + NOTE_MUX + bytes(4)) == []
    assert bench.read(LEVEL) == 7


@pytest.mark.parametrize("block", [0, 128, 255])
def test_block_size_beyond_127_is_refused(block: int) -> None:
    bench = Bench()
    answer = bench.request(b"\xa0" + NOTE_MUX + bytes([block, 0, 0, 0]))
    assert abort_of(answer) == AbortCode.BLOCK_SIZE


def test_acknowledging_more_than_was_sent_is_aborted() -> None:
    bench = Bench()
    bench.device.dictionary.variable(NOTE).value = bytes(100)
    bench.request(b"\xa0" + NOTE_MUX + bytes([4, 0, 0, 0]))
    assert len(bench.put(REQUEST, b"\xa3" + bytes(7))) == 4
    assert abort_of(bench.request(b"\xa2\x05\x04" + bytes(5))) == AbortCode.SEQUENCE_NUMBER


def test_short_data_switches_to_the_ordinary_upload_where_allowed() -> None:
    bench = Bench()
    answer = bench.request(b"\xa4" + LEVEL.to_bytes(2, "little") + b"\x00" + bytes([10, 4, 0, 0]))
    assert answer[0] == 0x43
    assert answer[4:] == (7).to_bytes(4, "little")


def test_fixed_length_object_by_block() -> None:
    bench = Bench()
    bench.request(b"\xc2" + LEVEL.to_bytes(2, "little") + b"\x00" + (4).to_bytes(4, "little"))
    bench.request(b"\x81" + (-9).to_bytes(4, "little", signed=True) + bytes(3))
    assert bench.request(bytes([0xC1 | 3 << 2]) + bytes(7))[0] == 0xA1
    assert bench.application.level.value == -9


@pytest.mark.parametrize("announced", [6, 8])
def test_announced_size_must_be_kept(announced: int) -> None:
    bench = Bench()
    bench.request(b"\xc2" + NOTE_MUX + announced.to_bytes(4, "little"))
    bench.request(b"\x81abcdefg")
    assert abort_of(bench.request(b"\xc1" + bytes(7))) == AbortCode.LENGTH
    assert bench.application.note.value == b""


@pytest.mark.parametrize("command", [0xA1, 0xA2])
def test_upload_that_was_not_started_is_aborted(command: int) -> None:
    bench = Bench()
    bench.application.note.value = bytes(20)
    bench.request(b"\xa0" + NOTE_MUX + bytes([4, 0, 0, 0]))
    assert abort_of(bench.request(bytes([command, 1, 4]) + bytes(5))) == AbortCode.COMMAND_UNKNOWN
