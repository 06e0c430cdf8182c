"""SDO server: expedited, segmented, block; aborts; timeouts; malformed requests (CiA 301, 7.2.4)."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.virtual_bus.device.sdo_abort import AbortCode
from tests.draws import examples_of
from tests.unit.virtual_bus.device_bench import (
    LEVEL,
    NODE,
    NOTE,
    RATIO,
    SECRET,
    SWITCHES,
    TARGET,
    TRIPLE,
    Bench,
    SdoRefused,
)

EXAMPLES = examples_of(60)
NOTE_MUX = NOTE.to_bytes(2, "little") + b"\x00"


def abort_of(answer: bytes) -> int:
    assert answer[0] == 0x80, answer.hex()
    return int.from_bytes(answer[4:8], "little")


def download_segments(bench: Bench, data: bytes, size: int | None) -> bytes:
    """Segmented download of NOTE; returns the last answer."""
    command = 0x20 if size is None else 0x21
    answer = bench.request(bytes([command]) + NOTE_MUX + (size or 0).to_bytes(4, "little"))
    pieces = [data[start : start + 7] for start in range(0, len(data), 7)] or [b""]
    for number, piece in enumerate(pieces):
        if answer[0] == 0x80:
            break
        toggle = (number & 1) << 4
        last = number == len(pieces) - 1
        request = bytes([toggle | (7 - len(piece)) << 1 | last]) + piece.ljust(7, b"\x00")
        answer = bench.request(request)
    return answer


def upload_segments(bench: Bench) -> bytes:
    """Segmented upload of NOTE."""
    answer = bench.request(b"\x40" + NOTE_MUX + bytes(4))
    assert answer[0] == 0x41
    size, data, toggle = int.from_bytes(answer[4:8], "little"), b"", 0
    while True:
        answer = bench.request(bytes([0x60 | toggle]) + bytes(7))
        assert answer[0] & 0x10 == toggle
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
        if answer[0] & 1:
            assert len(data) == size
            return data


@pytest.mark.parametrize(
    ("index", "subindex", "value", "length"),
    [
        (TARGET, 0, -1000, 2),
        (TARGET, 0, 1000, 2),
        (LEVEL, 0, -70000, 4),
        (SWITCHES, 3, 1, 1),
        (TRIPLE, 0, -2, 3),
        (0x1016, 2, 0, 4),
    ],
)
def test_expedited_both_ways(index: int, subindex: int, value: int, length: int) -> None:
    bench = Bench()
    bench.write(index, subindex, value, length)
    assert bench.read(index, subindex) == value % (1 << 8 * length)
    assert bench.device.dictionary.variable(index, subindex).value == value


def test_real_is_ieee_754() -> None:
    bench = Bench()
    bench.write(RATIO, 0, struct.unpack("<I", struct.pack("<f", -1.5))[0], 4)
    assert bench.device.dictionary.variable(RATIO).value == -1.5


def test_expedited_without_size_takes_the_length_of_the_object() -> None:
    bench = Bench()
    assert bench.request(b"\x22" + TARGET.to_bytes(2, "little") + b"\x00\x64\x00\xff\xff")[0] == 0x60
    assert bench.application.target.value == 100


def test_application_acts_on_a_download() -> None:
    bench = Bench()
    bench.write(TARGET, 0, 9, 2)
    assert bench.application.calls[-1] == ("target", 9)


@pytest.mark.parametrize(
    ("index", "subindex", "value", "length", "code"),
    [
        (0x5FFF, 0, 0, 1, AbortCode.NO_OBJECT),
        (SWITCHES, 9, 0, 1, AbortCode.NO_SUBINDEX),
        (0x1000, 0, 1, 4, AbortCode.READ_ONLY),
        (0x1008, 0, 0, 1, AbortCode.READ_ONLY),
        (SWITCHES, 0, 8, 1, AbortCode.READ_ONLY),
        (LEVEL, 0, 0, 2, AbortCode.TOO_SHORT),
        (TARGET, 0, 0, 4, AbortCode.TOO_LONG),
        (TARGET, 0, 1001, 2, AbortCode.TOO_HIGH),
        (TARGET, 0, -1001, 2, AbortCode.TOO_LOW),
        (SWITCHES, 1, 2, 1, AbortCode.TOO_HIGH),
    ],
)
def test_refused_download_changes_nothing(
    index: int, subindex: int, value: int, length: int, code: AbortCode
) -> None:
    bench = Bench()
    variable = bench.device.dictionary.get(index, subindex)
    before = None if variable is None else variable.value
    with pytest.raises(SdoRefused) as refused:
        bench.write(index, subindex, value, length)
    assert refused.value.code == code
    assert (None if variable is None else variable.value) == before
    assert not [call for call in bench.application.calls if call[0] == "target"]


@pytest.mark.parametrize(
    ("index", "subindex", "code"),
    [
        (0x5FFF, 0, AbortCode.NO_OBJECT),
        (SWITCHES, 9, AbortCode.NO_SUBINDEX),
        (SECRET, 0, AbortCode.WRITE_ONLY),
        (0x1003, 1, AbortCode.NO_DATA),
    ],
)
def test_refused_upload(index: int, subindex: int, code: AbortCode) -> None:
    with pytest.raises(SdoRefused) as refused:
        Bench().read(index, subindex)
    assert refused.value.code == code


@pytest.mark.parametrize("sized", [False, True])
@given(data=st.binary(min_size=5, max_size=300))
@EXAMPLES
def test_segmented_round_trip(sized: bool, data: bytes) -> None:
    bench = Bench()
    assert download_segments(bench, data, len(data) if sized else None)[0] & 0xE0 == 0x20
    assert bench.device.dictionary.variable(NOTE).value == data
    assert upload_segments(bench) == data


def test_empty_domain_goes_by_segments() -> None:
    assert upload_segments(Bench()) == b""


@pytest.mark.parametrize("announced", [9, 11])
def test_announced_size_must_be_kept(announced: int) -> None:
    bench = Bench()
    assert abort_of(download_segments(bench, bytes(10), announced)) == AbortCode.LENGTH
    assert bench.device.dictionary.variable(NOTE).value == b""


@pytest.mark.parametrize(("size", "code"), [(5, AbortCode.TOO_LONG), (2, AbortCode.TOO_SHORT)])
@pytest.mark.parametrize("command", [0x21, 0xC2])
def test_impossible_size_is_refused_at_once(command: int, size: int, code: AbortCode) -> None:
    request = bytes([command]) + LEVEL.to_bytes(2, "little") + b"\x00" + size.to_bytes(4, "little")
    assert abort_of(Bench().request(request)) == code


def test_more_than_the_memory_is_refused() -> None:
    bench = Bench()
    assert abort_of(bench.request(b"\x21" + NOTE_MUX + (1 << 20).to_bytes(4, "little"))) == (
        AbortCode.OUT_OF_MEMORY
    )
    bench.request(b"\x20" + NOTE_MUX + bytes(4))
    for number in range(9362):
        answer = bench.request(bytes([(number & 1) << 4]) + bytes(7))
    assert answer[0] & 0xE0 == 0x20
    assert abort_of(bench.request(bytes(8))) == AbortCode.OUT_OF_MEMORY


def test_repeated_toggle_aborts_and_ends_the_transfer() -> None:
    bench = Bench()
    bench.request(b"\x20" + NOTE_MUX + bytes(4))
    bench.request(bytes(8))
    answer = bench.request(bytes(8))
    assert abort_of(answer) == AbortCode.TOGGLE_BIT
    assert answer[1:4] == NOTE_MUX
    assert abort_of(bench.request(b"\x10" + bytes(7))) == AbortCode.COMMAND_UNKNOWN


def test_new_transfer_takes_the_place_of_the_running_one() -> None:
    bench = Bench()
    bench.request(b"\x20" + NOTE_MUX + bytes(4))
    assert bench.read(LEVEL) == 7
    assert abort_of(bench.request(bytes(8))) == AbortCode.COMMAND_UNKNOWN


def test_abort_of_the_client_is_not_answered() -> None:
    bench = Bench()
    bench.request(b"\x20" + NOTE_MUX + bytes(4))
    assert bench.put(0x600 + NODE, b"\x80" + NOTE_MUX + bytes(4)) == []
    assert abort_of(bench.request(bytes(8))) == AbortCode.COMMAND_UNKNOWN


def test_silent_client_is_timed_out() -> None:
    bench = Bench()
    bench.request(b"\x20" + NOTE_MUX + bytes(4))
    bench.run_until_ms(2000)
    bench.request(bytes(8))
    ((at, frame),) = bench.run_until_ms(9000)
    assert at == 5_000_000_000
    assert abort_of(frame.data) == AbortCode.TIMED_OUT
    assert frame.data[1:4] == NOTE_MUX


@pytest.mark.parametrize("length", range(8))
def test_message_of_another_length_is_no_sdo(length: int) -> None:
    assert Bench().put(0x600 + NODE, bytes([0x40, 0, 0x10, 0, 0, 0, 0, 0])[:length]) == []


@pytest.mark.parametrize("command", [0x00, 0x60, 0xA1, 0xA2, 0xA3, 0xC1, 0xE0, 0xFF])
def test_command_out_of_place_is_aborted(command: int) -> None:
    answer = Bench().request(bytes([command]) + bytes(7))
    assert abort_of(answer) == AbortCode.COMMAND_UNKNOWN


def test_upload_with_a_repeated_toggle_bit_is_aborted() -> None:
    bench = Bench()
    bench.application.note.value = bytes(20)
    bench.request(b"\x40" + NOTE_MUX + bytes(4))
    bench.request(b"\x60" + bytes(7))
    assert abort_of(bench.request(b"\x60" + bytes(7))) == AbortCode.TOGGLE_BIT
