"""The Lawicel protocol of serial CAN adapters ("SLCAN"): lines of ASCII, each frame a line.

Source: Lawicel AB, CAN232 Manual, version 3.0 (February 2010), "CAN232 Commands"; the same set in the CANUSB
manual. A command ends with CR; it is answered with CR, with a value and CR, or with BEL if it was refused.
Received frames come as lines between the answers, with four digits of a time stamp behind the data if
that was asked for (Z1; ms, 0..59999). The lines of error states and bus errors ("s", "e") are those that
Linux's slcan driver understands, an extension of some firmwares.
"""

import re
from enum import IntFlag
from typing import NamedTuple

from servobench.drivers.wire.frame_port import EXTENDED_ID_MAX, STANDARD_ID_MAX, WireFrame

CR, BEL = b"\r", b"\a"
_BITRATES_BIT_S = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
BITRATE_CODES = {bitrate: code for code, bitrate in enumerate(_BITRATES_BIT_S)}
"""bit/s -> n of the command Sn."""
STAMP_PERIOD_MS = 60_000
"""The stamps of Z1 count to 59999."""
LINE_LENGTH_MAX = 128
"""Longest line accepted; the longest frame has 30 characters."""

_END = re.compile(b"([\r\a])")
_FRAME = re.compile(rb"([trTR])((?<=[tr])[0-9A-Fa-f]{3}|(?<=[TR])[0-9A-Fa-f]{8})([0-8])([0-9A-Fa-f]*)")
"""Kind, identifier, length, and the rest: data, and the digits of a stamp."""
_STATUS = re.compile(rb"F([0-9A-Fa-f]{2})")


class SlcanStatus(IntFlag):
    """The flags that the command F returns, and clears."""

    RECEIVE_FIFO_FULL = 0x01
    TRANSMIT_FIFO_FULL = 0x02
    ERROR_WARNING = 0x04
    DATA_OVERRUN = 0x08
    ERROR_PASSIVE = 0x20
    ARBITRATION_LOST = 0x40
    BUS_ERROR = 0x80


_STATUS_TEXTS = {
    SlcanStatus.RECEIVE_FIFO_FULL: "its receive queue overflowed",
    SlcanStatus.TRANSMIT_FIFO_FULL: "its transmit queue is full",
    SlcanStatus.ERROR_WARNING: "error warning",
    SlcanStatus.DATA_OVERRUN: "data overrun",
    SlcanStatus.ERROR_PASSIVE: "error passive",
    SlcanStatus.ARBITRATION_LOST: "arbitration lost",
    SlcanStatus.BUS_ERROR: "bus error",
}


def status_text(status: SlcanStatus) -> str:
    """Describe the flags; ``no error`` for none."""
    return ", ".join(text for flag, text in _STATUS_TEXTS.items() if status & flag) or "no error"


class SlcanLine(NamedTuple):
    """A line without its terminator."""

    text: bytes
    refused: bool
    """True if it ended with BEL."""


class LineSplitter:
    """Cuts a stream of bytes into lines, however it arrives in pieces."""

    def __init__(self) -> None:
        self.overlong = 0
        """Lines given up because no terminator came."""
        self._rest = b""

    def feed(self, data: bytes) -> list[SlcanLine]:
        """Return the lines that ``data`` completes."""
        *pieces, rest = _END.split(self._rest + data)
        lines = [SlcanLine(text, end == BEL) for text, end in zip(pieces[::2], pieces[1::2], strict=True)]
        if len(rest) > LINE_LENGTH_MAX:
            self.overlong += 1
            rest = b""
        self._rest = rest
        return lines


def encode_frame(frame: WireFrame, stamp_ms: int | None = None) -> bytes:
    """Encode a frame as a line with its CR; ``stamp_ms``: as an adapter sends it with time stamps on."""
    can_id, data, extended = frame.can_id, frame.data, frame.extended
    remote, remote_length = frame.remote, frame.remote_length
    kind = ("R" if extended else "r") if remote else ("T" if extended else "t")
    digits = f"{can_id:08X}" if extended else f"{can_id:03X}"
    length = remote_length if remote else len(data)
    stamp = "" if stamp_ms is None else f"{stamp_ms:04X}"
    return f"{kind}{digits}{length}{data.hex().upper()}{stamp}\r".encode("ascii")


def decode_frame(text: bytes) -> WireFrame | None:
    """Decode the frame in a line, with or without a time stamp; None for anything else, also if it is spoilt.

    The protocol has no checksum: a line in which digits were changed into other digits passes.
    """
    match = _FRAME.fullmatch(text)
    if match is None:
        return None
    kind, digits, length, rest = match.groups()
    can_id, extended, remote = int(digits, 16), kind in b"TR", kind in b"rR"
    end = 0 if remote else 2 * int(length)
    if can_id > (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX) or len(rest) not in (end, end + 4):
        return None
    data = bytes.fromhex(rest[:end].decode("ascii"))
    return WireFrame(can_id, data, extended, remote, int(length) if remote else 0)


def decode_status(text: bytes) -> SlcanStatus | None:
    """Decode the flags in an answer ``Fxx``; None for any other."""
    match = _STATUS.fullmatch(text)
    return None if match is None else SlcanStatus(int(match[1], 16) & 0xEF)


def is_error_report(text: bytes) -> bool:
    """Return True for a line by which some firmwares report an error state (``sb256256``) or a bus error
    (``e1a``)."""
    if text[:1] == b"s":
        return len(text) == 8 and text[1:2] in (b"a", b"w", b"p", b"b") and text[2:].isdigit()
    return text[:1] == b"e" and text[1:2].isdigit() and len(text) == 2 + text[1] - 0x30
