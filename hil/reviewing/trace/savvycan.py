"""CSV logs of SavvyCAN and of GVRET adapters, which python-can does not read.

    Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
    166064000,0000021A,false,Rx,0,4,FE,36,12,FE,00,00,00,00,

Stamps are in us, LEN counts the bytes and the rest is filling. Older files have no column Dir; another kind,
``ID,Data Bytes``, has neither stamps nor flags. No kind tells remote, error or CAN FD frames.
"""

import re
from collections.abc import Callable
from typing import Final

from servobench.drivers.timebase import NS_PER_US
from servobench.drivers.wire.identifiers import EXTENDED_ID_MAX, STANDARD_ID_MAX
from servobench.hil.reviewing.trace.log_frame import CLASSICAL_BYTES_MAX, FD_BYTES_MAX, LogFrame

LineReader = Callable[[bytes, int], LogFrame | None]
"""Line and its number; None for a line that holds no frame."""
_WITH_TIMES: Final = re.compile(
    rb"\s*time stamp\s*,\s*id\s*,\s*extended\s*,(\s*dir\s*,)?\s*bus\s*,\s*len\b", re.I
)
_WITHOUT_TIMES: Final = re.compile(rb"\s*id\s*,\s*data bytes\s*$", re.I)
HEAD_MAX: Final = 120
"""Bytes of a file that hold its first line, if it is one of these."""
_TRUE: Final = (b"true", b"1")


def reader_of(head: bytes) -> LineReader | None:
    """Return the reader of the lines below the first, ``head``; None if SavvyCAN writes no such file."""
    first = head.split(b"\n", 1)[0]
    if match := _WITH_TIMES.match(first):
        return _sent_line if match[1] else _line
    return _plain_line if _WITHOUT_TIMES.match(first) else None


def _line(line: bytes, number: int) -> LogFrame | None:
    return _timed(line.strip().split(b","), number, b"")


def _sent_line(line: bytes, number: int) -> LogFrame | None:
    cells = line.strip().split(b",")
    return _timed([*cells[:3], *cells[4:]], number, cells[3].strip()[:1].upper()) if len(cells) > 3 else None


def _timed(cells: list[bytes], number: int, direction: bytes) -> LogFrame | None:
    """``cells``: stamp, identifier, extended, bus, length and bytes."""
    try:
        stamp, identifier, extended, bus, length = (cell.strip() for cell in cells[:5])
        at_ns, can_id, count = int(stamp) * NS_PER_US, int(identifier, 16), int(length)
        data = bytes(int(cell, 16) for cell in cells[5 : 5 + count])
    except ValueError:
        return None
    if len(data) != count or direction not in (b"", b"R", b"T"):
        return None
    channel = bus.decode("latin-1")
    return _frame(number, at_ns, channel, can_id, data, extended.lower() in _TRUE, direction.decode())


def _plain_line(line: bytes, number: int) -> LogFrame | None:
    identifier, comma, rest = line.strip().partition(b",")
    try:
        can_id, data = int(identifier, 16), bytes(int(part, 16) for part in rest.split())
    except ValueError:
        return None
    return _frame(number, None, "", can_id, data, False, "") if comma else None


def _frame(
    number: int, at_ns: int | None, channel: str, can_id: int, data: bytes, extended: bool, sent: str
) -> LogFrame | None:
    """Some adapters' files lack the flag of a long identifier."""
    if not 0 <= can_id <= EXTENDED_ID_MAX or len(data) > FD_BYTES_MAX:
        return None
    long, fd = extended or can_id > STANDARD_ID_MAX, len(data) > CLASSICAL_BYTES_MAX
    return LogFrame(number, at_ns, channel, can_id, data, long, fd=fd, sent=sent)
