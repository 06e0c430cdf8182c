"""Exported logs against python-can's reader of the same format, an independent one."""

from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.wire.frame_port import EXTENDED_FLAG, REMOTE_FLAG
from servobench.hil.reviewing.frames_export import candump_lines
from servobench.hil.rows.side_rows import FRAME, FRAME_DTYPE
from tests.draws import examples_of

Row = tuple[int, int, int, int, bytes]


@st.composite
def frame_rows(draw: st.DrawFn) -> Row:
    extended, remote = draw(st.booleans()), draw(st.booleans())
    can_id = draw(st.integers(0, 2**29 - 1 if extended else 2**11 - 1))
    flags = (EXTENDED_FLAG if extended else 0) | (REMOTE_FLAG if remote else 0)
    data = b"" if remote else draw(st.binary(max_size=8))
    return draw(st.integers(0, 4 * 10**18)), can_id | flags, len(data), draw(st.integers(0, 1)), data


def packed(rows: list[Row]) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    return np.frombuffer(b"".join(FRAME.pack(*row) for row in rows), FRAME_DTYPE)


def test_lines_by_the_letter() -> None:
    rows = packed(
        [
            (1_436_509_052_249_713_999, 0x123, 4, 1, bytes.fromhex("11223344")),
            (0, 0x12345678 | EXTENDED_FLAG, 0, 0, b""),
            (5_000, 0x7F | REMOTE_FLAG, 0, 0, b""),
        ]
    )
    assert candump_lines(rows, ["can0"]).decode().splitlines() == [
        "(1436509052.249713) can0 123#11223344",
        "(0000000000.000000) can0 12345678#",
        "(0000000000.000005) can0 07F#R",
    ]


def test_nothing_gives_nothing() -> None:
    assert candump_lines(packed([]), ["can0"]) == b""


@examples_of(100)
@given(rows=st.lists(frame_rows(), min_size=1, max_size=20))
def test_python_can_reads_back_what_was_written(
    rows: list[Row], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path: Path = tmp_path_factory.mktemp("frames") / "frames.log"
    path.write_bytes(candump_lines(packed(rows), ["vcan0"]))
    with can.CanutilsLogReader(path) as reader:
        messages = list(reader)
    assert len(messages) == len(rows)
    for message, (at, word, _, _, data) in zip(messages, rows, strict=True):
        assert message.arbitration_id == word & (2**29 - 1)
        assert message.is_extended_id == bool(word & EXTENDED_FLAG)
        assert message.is_remote_frame == bool(word & REMOTE_FLAG)
        assert bytes(message.data) == data
        assert message.timestamp == pytest.approx(at / 1e9, rel=1e-12, abs=2e-6)
        assert message.channel == "vcan0"


def test_frames_of_further_segments_bear_their_names() -> None:
    rows = packed(
        [(0, 0x181, 0, 0, b""), (0, 0x182, 0, 2, b""), (0, 0x202, 0, 3, b""), (0, 0x203, 0, 5, b"")]
    )
    assert [line[20:] for line in candump_lines(rows, ("can0", "feed", "x")).decode().splitlines()] == [
        "can0 181#",
        "feed 182#",
        "feed 202#",
        "x 203#",
    ]
