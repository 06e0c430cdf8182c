"""SDO transfers out of their frames: the protocols of CiA 301 7.2.4.3 encoded here, and what breaks off."""

from collections.abc import Iterable
from typing import Any

import pytest

from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.hil.reviewing.trace.sdo_transfer import KEPT_MAX, SdoChannel, SdoTransfer

CHECK, CHECK_CRC = b"123456789", 0x31C3
"""The catalogue's check value of CRC-16/XMODEM, which is the CRC of CiA 301."""
OBJECT = bytes((0x34, 0x12, 0x05))
"""1234h:05."""
Line = tuple[str, bytes]
"""c: of the client, s: of the server; its data."""


def frame(number: int, data: bytes) -> LogFrame:
    return LogFrame(number, number * 1000, "can0", 0x600, data)


def ended(lines: Iterable[Line], channel: SdoChannel | None = None) -> list[SdoTransfer]:
    """The transfers that end with one of these frames."""
    channel = channel or SdoChannel()
    transfers: list[SdoTransfer] = []
    for number, (who, data) in enumerate(lines, 1):
        transfers += channel.take(frame(number, data), who == "s")
    return transfers


def initiate(command: int, size: int = 0) -> bytes:
    return bytes((command,)) + OBJECT + size.to_bytes(4, "little")


def told(lines: list[Line], last: int | None = None, **fields: Any) -> SdoTransfer:
    """The transfer of 1234h:05 in these frames, whole unless ``fields`` say otherwise."""
    last = last or len(lines)
    ends = frame(1, lines[0][1]), frame(last, lines[last - 1][1])
    transfer = SdoTransfer(0x1234, 0x05, False, *ends, frames=last, finished=True)
    for name, value in fields.items():
        setattr(transfer, name, value)
    transfer.length = len(transfer.data)
    return transfer


def pieces_of(data: bytes) -> list[bytes]:
    return [data[place : place + 7] for place in range(0, len(data), 7)] or [b""]


def segments(data: bytes) -> list[bytes]:
    """7.2.4.3.4: toggle bit 4, unused bytes in bits 3 to 1, last in bit 0."""
    pieces = pieces_of(data)
    return [
        bytes((place % 2 << 4 | (7 - len(piece)) << 1 | (place == len(pieces) - 1),))
        + piece.ljust(7, b"\xee")
        for place, piece in enumerate(pieces)
    ]


def segmented(data: bytes, download: bool, begin: int = 0x21) -> list[Line]:
    """7.2.4.3.3 to 7.2.4.3.6, with the size in the initiate frame of who sends."""
    writer, reader = ("c", "s") if download else ("s", "c")
    if download:
        lines: list[Line] = [("c", initiate(begin, len(data))), ("s", initiate(0x60))]
    else:
        lines = [("c", initiate(0x40)), ("s", initiate(0x41, len(data)))]
    for place, piece in enumerate(segments(data)):
        confirmed = bytes(((0x20 if download else 0x60) | place % 2 << 4,)) + bytes(7)
        pair = [(writer, piece), (reader, confirmed)]
        lines += pair if download else pair[::-1]
    return lines


def block(data: bytes, download: bool, crc: int | None = None, size: int = 127) -> list[Line]:
    """7.2.4.3.9 to 7.2.4.3.16, in sub-blocks of ``size`` segments; without a CRC where there is none."""
    writer, reader = ("c", "s") if download else ("s", "c")
    checked = 0 if crc is None else 4
    if download:
        lines: list[Line] = [
            ("c", initiate(0xC2 | checked, len(data))),
            ("s", initiate(0xA0 | checked, size)),
        ]
    else:
        lines = [
            ("c", initiate(0xA0 | checked, size)),
            ("s", initiate(0xC2 | checked, len(data))),
            ("c", b"\xa3" + bytes(7)),
        ]
    pieces = pieces_of(data)
    for start in range(0, len(pieces), size):
        batch = pieces[start : start + size]
        for number, piece in enumerate(batch, 1):
            last = start + number == len(pieces)
            lines.append((writer, bytes((number | last << 7,)) + piece.ljust(7, b"\xee")))
        lines.append((reader, bytes((0xA2, len(batch), size)) + bytes(5)))
    unused = 7 - len(pieces[-1])
    lines.append((writer, bytes((0xC1 | unused << 2,)) + (crc or 0).to_bytes(2, "little") + bytes(5)))
    return [*lines, (reader, b"\xa1" + bytes(7))]


def content(size: int) -> bytes:
    return (bytes(range(251)) * (size // 251 + 1))[:size]


@pytest.mark.parametrize("size", [0, 1, 6, 7, 8, 20, 21, 22, 42, 100])
@pytest.mark.parametrize("download", [False, True])
@pytest.mark.parametrize("per_block", [1, 3, 127])
def test_a_block_transfer_of_any_length(size: int, download: bool, per_block: int) -> None:
    lines = block(content(size), download, size=per_block)
    data = bytearray(content(size))
    assert ended(lines) == [told(lines, download=download, kind="block", data=data, announced=size)]


@pytest.mark.parametrize("download", [False, True])
def test_the_crc_of_a_block_transfer_is_compared_where_both_sides_reckon_one(download: bool) -> None:
    right: dict[str, Any] = {"download": download, "kind": "block", "data": bytearray(CHECK), "announced": 9}
    lines = block(CHECK, download, CHECK_CRC)
    assert ended(lines) == [told(lines, **right)]
    lines = block(CHECK, download, 0x0A0B)
    notes = ["its CRC is 0A0Bh, that of the data 31C3h"]
    assert ended(lines) == [told(lines, **right, notes=notes)]
    assert not ended(lines)[0].whole
    for side in (0, 1):
        alone = list(lines)
        who, data = alone[side]
        alone[side] = (who, bytes((data[0] & ~4,)) + data[1:])
        assert ended(alone) == [told(alone, **right)], side


def test_sizes_that_are_not_announced_are_not_compared() -> None:
    for lines, kind, download, first in (
        (segmented(b"abcdefgh", True), "segmented", True, (0, 0x20)),
        (segmented(b"abcdefgh", False), "segmented", False, (1, 0x40)),
        (block(b"abcdefgh", True), "block", True, (0, 0xC0)),
        (block(b"abcdefgh", False), "block", False, (1, 0xC0)),
    ):
        place, command = first
        lines[place] = (lines[place][0], initiate(command, 77))
        assert ended(lines) == [told(lines, download=download, kind=kind, data=bytearray(b"abcdefgh"))]


@pytest.mark.parametrize("download", [False, True])
def test_a_size_that_is_announced_and_does_not_come_is_noted(download: bool) -> None:
    place = 0 if download else 1
    for lines, kind, command in (
        (segmented(b"abcdefgh", download), "segmented", 0x21 if download else 0x41),
        (block(b"abcdefgh", download), "block", 0xC2),
    ):
        lines[place] = (lines[place][0], initiate(command, 9))
        fields: dict[str, Any] = {
            "download": download,
            "kind": kind,
            "data": bytearray(b"abcdefgh"),
            "announced": 9,
        }
        assert ended(lines) == [told(lines, **fields, notes=["9 bytes were announced, 8 came"])]


@pytest.mark.parametrize("download", [False, True])
def test_a_segment_of_a_block_that_was_acknowledged_and_is_not_there_is_missing(download: bool) -> None:
    """The CRC cannot be compared then."""
    lines = block(CHECK, download, 0x0A0B)
    del lines[2 if download else 3]
    fields: dict[str, Any] = {
        "download": download,
        "kind": "block",
        "data": bytearray(CHECK[7:]),
        "announced": 9,
    }
    assert ended(lines) == [told(lines, **fields, notes=["segments are missing"])]


def test_a_block_upload_that_the_server_answers_with_a_plain_one() -> None:
    """7.2.4.3.13, protocol switch: below pst bytes it may."""
    lines: list[Line] = [("c", initiate(0xA4, 127)), ("s", bytes((0x43,)) + OBJECT + b"abcd")]
    assert ended(lines) == [told(lines, kind="expedited", data=bytearray(b"abcd"))]
    lines = [("c", initiate(0xA4, 127)), *segmented(content(9), False)[1:]]
    assert ended(lines) == [told(lines, kind="segmented", data=bytearray(content(9)), announced=9)]


def test_an_acknowledgement_of_no_sub_block_counts_and_says_nothing() -> None:
    lines: list[Line] = [
        ("c", initiate(0x40)),
        ("c", b"\xa2\x03\x7f" + bytes(5)),
        ("s", b"\x43" + OBJECT + b"abcd"),
    ]
    assert ended(lines) == [told(lines, data=bytearray(b"abcd"))]


ABORT = initiate(0x80, 0x0504_0000)


@pytest.mark.parametrize("who", ["c", "s"])
@pytest.mark.parametrize("kind", ["expedited", "segmented", "block"])
@pytest.mark.parametrize("download", [False, True])
def test_either_side_aborts_at_any_frame(who: str, kind: str, download: bool) -> None:
    """It ends there, whatever had come."""
    whole = {
        "expedited": [("c", bytes((0x23,)) + OBJECT + b"abcd" if download else initiate(0x40))],
        "segmented": segmented(content(21), download)[:-1],
        "block": block(content(21), download)[:-1],
    }[kind]
    for cut in range(1, len(whole) + 1):
        lines = [*whole[:cut], (who, ABORT)]
        channel = SdoChannel()
        (transfer,) = ended(lines, channel)
        side = {"c": "client", "s": "server"}[who]
        assert (transfer.abort_code, transfer.aborted_by, transfer.finished) == (0x0504_0000, side, False)
        assert (transfer.frames, transfer.first, transfer.last) == (
            cut + 1,
            frame(1, whole[0][1]),
            frame(cut + 1, ABORT),
        )
        assert not transfer.whole
        assert channel.pending is None


def test_a_request_that_comes_again_before_its_answer_is_asked_twice() -> None:
    lines: list[Line] = [("c", initiate(0x40)), ("c", initiate(0x40)), ("c", initiate(0x40))]
    lines.append(("s", bytes((0x43,)) + OBJECT + b"abcd"))
    assert ended(lines) == [told(lines, asked=3, data=bytearray(b"abcd"))]


@pytest.mark.parametrize(
    ("answer", "fields"),
    [
        (b"\x43" + OBJECT + b"abcd", {"data": bytearray(b"abcd"), "finished": True}),
        (b"\x4b" + OBJECT + b"abcd", {"data": bytearray(b"ab"), "finished": True}),
        (b"\x41" + OBJECT + b"\7\0\0\0", {"finished": False}),
        (b"\x60" + OBJECT + bytes(4), {"download": True, "finished": False}),
        (ABORT, {"abort_code": 0x0504_0000, "aborted_by": "server", "finished": False}),
    ],
)
def test_an_answer_that_nobody_has_asked_for(answer: bytes, fields: dict[str, Any]) -> None:
    lines: list[Line] = [("s", answer)]
    unasked = told(lines, **fields, notes=["nobody is seen to ask"])
    assert ended(lines) == [unasked]
    assert not unasked.whole


@pytest.mark.parametrize("command", [0x00, 0x20, 0xA0, 0xC0])
def test_a_later_frame_of_a_transfer_that_nobody_has_begun_is_none(command: int) -> None:
    assert (
        ended([("s", initiate(command)), ("c", initiate(0x60)), ("c", ABORT), ("c", b"\xa1" + bytes(7))])
        == []
    )


@pytest.mark.parametrize("other", [b"\x35\x12\x05", b"\x34\x13\x05", b"\x34\x12\x06"])
@pytest.mark.parametrize("command", [0x43, 0x60])
def test_an_answer_about_another_object_is_not_of_the_transfer(command: int, other: bytes) -> None:
    channel = SdoChannel()
    (stray,) = ended([("c", initiate(0x40)), ("s", bytes((command,)) + other + b"abcd")], channel)
    asked = int.from_bytes(other[:2], "little"), other[2]
    assert (stray.index, stray.sub, stray.frames, stray.notes) == (*asked, 1, ["nobody is seen to ask"])
    assert channel.pending is not None
    assert channel.pending.frames == 1


@pytest.mark.parametrize("short", [b"", b"\x43", b"\x43" + OBJECT + b"abc"])
@pytest.mark.parametrize("who", ["c", "s"])
def test_a_frame_below_eight_bytes_counts_and_says_nothing(who: str, short: bytes) -> None:
    assert ended([(who, short)]) == []
    lines: list[Line] = [("c", initiate(0x40)), (who, short), ("s", b"\x43" + OBJECT + b"abcd")]
    assert ended(lines) == [told(lines, data=bytearray(b"abcd"))]


def test_a_transfer_keeps_its_first_bytes_and_counts_all() -> None:
    transfer = SdoTransfer(0x1F50, 1, True, frame(1, b""), frame(1, b""), finished=True)
    transfer.add(bytes(KEPT_MAX - 3))
    transfer.add(b"abc")
    assert (transfer.length, transfer.whole) == (KEPT_MAX, True)
    transfer.add(b"d")
    assert (transfer.length, len(transfer.data), bytes(transfer.data[-3:]), transfer.whole) == (
        KEPT_MAX + 1,
        KEPT_MAX,
        b"abc",
        False,
    )


@pytest.mark.parametrize("beyond", [-1, 0, 1, 3, 5, 6])
@pytest.mark.parametrize("padding", [0, 1, 4, 6])
def test_padding_is_dropped_wherever_the_kept_bytes_end(beyond: int, padding: int) -> None:
    data = content(KEPT_MAX + beyond)
    transfer = SdoTransfer(0x1F50, 1, True, frame(1, b""), frame(1, b""), finished=True)
    transfer.add(data)
    transfer.drop(padding)
    real = data[: len(data) - padding]
    kept = real[:KEPT_MAX]
    assert (transfer.length, len(transfer.data), bytes(transfer.data[-9:])) == (
        len(real),
        len(kept),
        kept[-9:],
    )
    assert transfer.whole is (len(real) <= KEPT_MAX)
