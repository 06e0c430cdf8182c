"""Lines of the Lawicel protocol: frames, answers, and what is none of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.wire.frame_port import WireFrame
from servobench.drivers.wire.slcan_protocol import (
    LINE_LENGTH_MAX,
    LineSplitter,
    SlcanLine,
    SlcanStatus,
    decode_frame,
    decode_status,
    encode_frame,
    is_error_report,
    status_text,
)
from tests.draws import examples_of


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        (b"t10021133", WireFrame(0x100, b"\x11\x33")),
        (b"t1000", WireFrame(0x100)),
        (b"T0000010021133", WireFrame(0x100, b"\x11\x33", True)),
        (b"r1002", WireFrame(0x100, b"", False, True, 2)),
        (b"R000001002", WireFrame(0x100, b"", True, True, 2)),
        (b"t10021133EA5F", WireFrame(0x100, b"\x11\x33")),
        (b"r10021234", WireFrame(0x100, b"", False, True, 2)),
        (b"t7FF0", WireFrame(0x7FF)),
        (b"t7fF1ab", WireFrame(0x7FF, b"\xab")),
    ],
)
def test_frames_of_the_manual_are_read(text: bytes, frame: WireFrame) -> None:
    assert decode_frame(text) == frame


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"t",
        b"t100",
        b"t1009" + b"00" * 9,
        b"t100211",
        b"t1002113",
        b"t1002113344",
        b"t8000",
        b"T200000000",
        b"t10 0",
        b"t+100",
        b"t1_00",
        b"t1002zz33",
        b"t10021 33",
        b"t1001\xff\xfe",
        b"t1000 123",
        b"x1000",
        b"d1000",
        b"F00",
    ],
)
def test_what_is_cut_or_spoilt_is_no_frame(text: bytes) -> None:
    assert decode_frame(text) is None


NO = st.just(False)
FRAMES = st.one_of(
    st.builds(WireFrame, st.integers(0, 0x7FF), st.binary(max_size=8), NO, NO, st.just(0)),
    st.builds(WireFrame, st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.just(True), NO, st.just(0)),
    st.builds(
        WireFrame, st.integers(0, 0x7FF), st.just(b""), st.just(False), st.just(True), st.integers(0, 8)
    ),
    st.builds(
        WireFrame, st.integers(0, 0x1FFFFFFF), st.just(b""), st.just(True), st.just(True), st.integers(0, 8)
    ),
)


@examples_of(100)
@given(FRAMES, st.one_of(st.none(), st.integers(0, 59_999)))
def test_a_frame_survives_its_line(frame: WireFrame, stamp_ms: int | None) -> None:
    line = encode_frame(frame, stamp_ms)
    assert line.endswith(b"\r")
    assert decode_frame(line[:-1]) == frame


@examples_of(100)
@given(st.binary(max_size=200))
def test_no_bytes_raise(data: bytes) -> None:
    for line in LineSplitter().feed(data + b"\r"):
        frame = decode_frame(line.text)
        assert frame is None or decode_frame(encode_frame(frame)[:-1]) == frame
        decode_status(line.text)
        is_error_report(line.text)


@examples_of(100)
@given(st.binary(max_size=100), st.integers(1, 7))
def test_lines_do_not_depend_on_the_pieces_in_which_they_come(data: bytes, size: int) -> None:
    pieces = LineSplitter()
    lines = [line for start in range(0, len(data), size) for line in pieces.feed(data[start : start + size])]
    assert lines == LineSplitter().feed(data)


def test_cr_and_bel_end_lines() -> None:
    assert LineSplitter().feed(b"z\r\at100\a0\r") == [
        SlcanLine(b"z", False),
        SlcanLine(b"", True),
        SlcanLine(b"t100", True),
        SlcanLine(b"0", False),
    ]


def test_a_line_without_end_is_given_up() -> None:
    splitter = LineSplitter()
    assert splitter.feed(b"t" * (LINE_LENGTH_MAX + 1)) == []
    assert splitter.overlong == 1
    assert splitter.feed(b"z\r") == [SlcanLine(b"z", False)]


def test_status_flags_are_those_of_the_manual() -> None:
    assert decode_status(b"F00") == SlcanStatus(0)
    assert (
        decode_status(b"FA2")
        == SlcanStatus.BUS_ERROR | SlcanStatus.ERROR_PASSIVE | SlcanStatus.TRANSMIT_FIFO_FULL
    )
    assert decode_status(b"F0") is None
    assert decode_status(b"F0G") is None
    assert (
        status_text(SlcanStatus.TRANSMIT_FIFO_FULL | SlcanStatus.BUS_ERROR)
        == "its transmit queue is full, bus error"
    )
    assert status_text(SlcanStatus(0)) == "no error"


@pytest.mark.parametrize(
    ("text", "report"),
    [
        (b"sb256256", True),
        (b"sa057033", True),
        (b"e1a", True),
        (b"e3bcO", True),
        (b"sx057033", False),
        (b"sa05703", False),
        (b"e3b", False),
        (b"e", False),
        (b"s", False),
    ],
)
def test_error_reports_are_told_from_noise(text: bytes, report: bool) -> None:
    assert is_error_report(text) is report
