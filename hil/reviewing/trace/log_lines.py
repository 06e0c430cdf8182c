"""Logs as frames: candump's, and those that python-can reads.

candump's log (-L, -l), and what it shows, with each -t, -x, -a, -e and -c:

    (1436509052.249713) can0 123#11223344          (1436509052.249713) can0 123#11223344 T
    (1436509052.249713) can0 123#R                 (1436509052.249713) can0 123##1223344
     (2015-07-10 08:17:32.249713)  can0  TX - -  123   [4]  11 22 33 44   '."3D'
     can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME

python-can reads the first of these alone, and ends at the first line that it does not know. By the end of
their names it reads Vector's asc and blf, PEAK's trc, csv, db and mf4.

CSV logs of SavvyCAN and of GVRET adapters, which python-can does not read.

    Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
    166064000,0000021A,false,Rx,0,4,FE,36,12,FE,00,00,00,00,

Stamps are in us, LEN counts the bytes and the rest is filling. Older files have no column Dir; another kind,
``ID,Data Bytes``, has neither stamps nor flags. No kind tells remote, error or CAN FD frames.

A window of a long candump log in order of time: its lines, and of the others those that they rest on.

Those are looked for in arrays of bytes: everything else outside of the window, nearly all of a log, is never
decoded. Recordings up to format 4 have their frames so.
"""

import gzip
import math
import re
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.lean_can import mf4_reader
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_ID_MAX, STANDARD_ID_MAX
from servobench.hil.reviewing.trace.frame_columns import (
    CLASSICAL_BYTES_MAX,
    FD_BYTES_MAX,
    MARGIN_NS,
    Hold,
    LogFrame,
    LogWindow,
    held_against_nothing,
)
from servobench.hil.rows.frames_file import TellingFrames

if TYPE_CHECKING:
    from can import Message

_STAMP: Final = rb"\((?:(?P<date>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)|(?P<s>\d{1,12}))\.(?P<part>\d{1,9})\)"
_ID: Final = rb"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
_LOGGED: Final = re.compile(
    rb"\s*" + _STAMP + rb"\s+(?P<channel>\S+)\s+" + _ID + rb"#(?:(?P<fd>#[0-9A-Fa-f])|(?P<remote>R\d?))?"
    rb"(?P<data>(?:[0-9A-Fa-f]{2}\.?)*)(?:_[0-9A-Fa-f])?(?:\s+(?P<sent>[TR]))?\s*\Z"
)
_SHOWN: Final = re.compile(
    rb"\s*(?:" + _STAMP + rb"\s+)?(?P<channel>\S+)\s+(?:(?P<sent>[TR])X\s+[B-]\s+[E-]\s+)?" + _ID +
    rb"\s+\[(?P<length>\d{1,2})\](?:\s+\{\d+\})?(?:\s+(?P<rest>.*?))?\s*\Z",
    re.DOTALL,
)  # fmt: skip
_COLOUR: Final = re.compile(rb"\x1b\[[0-9;]*m")
_EXTENDED_DIGITS: Final = 8


def frame_of_line(line: bytes, number: int) -> LogFrame | None:
    """The frame in a line, or None if it is no line of candump. A date counts as UTC: none tells its zone."""
    if b"\x1b" in line:
        line = _COLOUR.sub(b"", line)
    logged = _LOGGED.match(line)
    match = logged or _SHOWN.match(line)
    if match is None:
        return None
    try:
        at_ns = _stamp_ns(match)
        data, remote, fd = _logged(match) if logged else _shown(match)
    except ValueError:
        return None
    digits = match["id"]
    can_id, extended = int(digits, 16), len(digits) == _EXTENDED_DIGITS
    error = extended and bool(can_id & ERROR_FLAG)
    if can_id > (EXTENDED_ID_MAX | ERROR_FLAG if extended else STANDARD_ID_MAX):
        return None
    channel = match["channel"].decode("utf-8", "replace")
    sent = (match["sent"] or b"").decode()
    can_id &= EXTENDED_ID_MAX
    return LogFrame(number, at_ns, channel, can_id, data, extended and not error, remote, error, fd, sent)


def is_remark(line: bytes) -> bool:
    """An empty line, or what candump -e says of the error frame before, behind a tab."""
    return not line.strip() or line.startswith(b"\t")


def _stamp_ns(match: re.Match[bytes]) -> int | None:
    """None: the line has none. Raises ValueError for a date that there is not, or that lies before 1970."""
    if match["part"] is None:
        return None
    part_ns = int(match["part"].ljust(9, b"0"))
    if match["date"] is None:
        return int(match["s"]) * NS_PER_S + part_ns
    date = datetime.strptime(match["date"].decode(), "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    at_ns = int(date.timestamp()) * NS_PER_S + part_ns
    if at_ns < 0:
        raise ValueError(match["date"])
    return at_ns


def _logged(match: re.Match[bytes]) -> tuple[bytes, bool, bool]:
    """Data, and whether it is a remote or a CAN FD frame. Raises ValueError for what no frame has."""
    data = bytes.fromhex(match["data"].replace(b".", b"").decode())
    remote, fd = match["remote"] is not None, match["fd"] is not None
    if len(data) > (0 if remote else FD_BYTES_MAX if fd else CLASSICAL_BYTES_MAX):
        raise ValueError(match["data"])
    return data, remote, fd


def _shown(match: re.Match[bytes]) -> tuple[bytes, bool, bool]:
    """The same."""
    length, rest = int(match["length"]), match["rest"] or b""
    if rest.startswith(b"remote request"):
        return b"", True, False
    words = rest.split(None, length)
    if length > FD_BYTES_MAX or len(words) < length or any(len(word) != 2 for word in words[:length]):
        raise ValueError(rest)
    return bytes(int(word, 16) for word in words[:length]), False, len(match["length"]) == 2


SUFFIXES: Final = (".asc", ".blf", ".csv", ".db", ".mf4", ".trc")
_UNDIRECTED: Final = (".csv", ".db")
"""python-can takes every frame in there for a received one."""
_PACKED: Final = ".gz"


_ASC_RELATIVE: Final = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)
_ASC_TIME: Final = re.compile(r"\s*(\d+\.\d+)(?=\s)")


class BrokenLog(Exception):
    """The file cannot be read from here on."""


def kind_of(path: Path) -> str:
    """The end of its name if python-can reads such files, packed or not; else empty."""
    suffix = (path.with_suffix("") if path.suffix.lower() == _PACKED else path).suffix.lower()
    return suffix if suffix in SUFFIXES else ""


def other_frames(path: Path) -> Iterator[LogFrame]:
    """The frames of the file, stamps to 1 us. Raises BrokenLog where it is damaged."""
    number, directed = 0, kind_of(path) not in _UNDIRECTED
    try:
        with _opened(path) as messages:
            for message in messages:
                number += 1
                yield _frame(number, message, directed)
    except ModuleNotFoundError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever another library raises on a file of whatever content
        raise BrokenLog(f"frame {number + 1}: {error or type(error).__name__}") from None


@contextmanager
def _opened(path: Path) -> Iterator[Iterable["Message"]]:
    """The file is closed here: a reader that refuses it leaves it open."""
    from can.io.generic import BinaryIOMessageReader, TextIOMessageReader
    from can.io.player import MESSAGE_READERS

    kind = kind_of(path)
    reader: Any = mf4_reader() if kind == ".mf4" else MESSAGE_READERS[kind]
    packed = path.suffix.lower() == _PACKED
    if not issubclass(reader, BinaryIOMessageReader | TextIOMessageReader):
        with reader(path) as messages:
            yield messages
        return
    mode = "rt" if issubclass(reader, TextIOMessageReader) else "rb"
    with (gzip.open if packed else open)(path, mode) as file:
        yield reader(_AscLines(cast(Iterable[str], file)) if kind == ".asc" else file)


class _AscLines:
    """Lines of an asc whose times count from its beginning, as python-can takes them all.

    Under ``timestamps relative`` each line, whether or not it holds a frame, counts from the one before.
    """

    def __init__(self, file: Iterable[str]) -> None:
        self._lines = self._absolute(file)

    def __iter__(self) -> Iterator[str]:
        """Go on where the iterator before was left, as a file does."""
        return self._lines

    def _absolute(self, file: Iterable[str]) -> Iterator[str]:
        relative, at_us = False, 0
        for line in file:
            relative |= _ASC_RELATIVE.match(line) is not None
            if relative and (match := _ASC_TIME.match(line)):
                at_us += round(float(match[1]) * 1e6)
                yield f"{at_us / 1e6:.6f}{line[match.end() :]}"
            else:
                yield line

    def close(self) -> None:
        """Leave it to who opened the file."""


def _frame(number: int, message: "Message", directed: bool) -> LogFrame:
    at_s = message.timestamp
    return LogFrame(
        number=number,
        at_ns=round(at_s * 1e6) * NS_PER_US if math.isfinite(at_s) else None,
        channel="" if message.channel is None else str(message.channel),
        can_id=message.arbitration_id,
        data=b"" if message.is_remote_frame else bytes(message.data),
        extended=message.is_extended_id and not message.is_error_frame,
        remote=message.is_remote_frame,
        error=message.is_error_frame,
        fd=message.is_fd,
        sent=("R" if message.is_rx else "T") if directed else "",
    )


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
    return _row_frame(number, at_ns, channel, can_id, data, extended.lower() in _TRUE, direction.decode())


def _plain_line(line: bytes, number: int) -> LogFrame | None:
    identifier, comma, rest = line.strip().partition(b",")
    try:
        can_id, data = int(identifier, 16), bytes(int(part, 16) for part in rest.split())
    except ValueError:
        return None
    return _row_frame(number, None, "", can_id, data, False, "") if comma else None


def _row_frame(
    number: int, at_ns: int | None, channel: str, can_id: int, data: bytes, extended: bool, sent: str
) -> LogFrame | None:
    """Some adapters' files lack the flag of a long identifier."""
    if not 0 <= can_id <= EXTENDED_ID_MAX or len(data) > FD_BYTES_MAX:
        return None
    long, fd = extended or can_id > STANDARD_ID_MAX, len(data) > CLASSICAL_BYTES_MAX
    return LogFrame(number, at_ns, channel, can_id, data, long, fd=fd, sent=sent)


_SECONDS: Final = re.compile(rb"\((\d{1,12})\.(\d{1,9})\)")
_CHUNK: Final = 1 << 22
"""Bytes that are looked through at once; a few arrays of this length are held."""
_SPACE, _NEWLINE, _DATA, _REMOTE = (ord(mark) for mark in " \n#R")
_DIGIT: Final = np.full(256, -1, np.int32)
"""By byte: the hexadecimal digit that it is."""
_DIGIT[[ord(digit) for digit in "0123456789ABCDEF"]] = range(16)


def lines_of_window(
    path: Path, window: LogWindow, hold: Hold = held_against_nothing
) -> Iterator[tuple[int, bytes]]:
    """Number, from 1 on, and text of the lines that ``window`` needs, in the order of the log.

    The log is one of candump -L whose times never fall. Behind the window come lines of SDO transfers alone.
    """
    size = path.stat().st_size
    if not size:
        return
    hold(path.name, 0, size)
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as log:
        begin = _line_at(log, window.begin_ns - MARGIN_NS)
        end = max(begin, _line_at(log, window.end_ns + MARGIN_NS))
        number = yield from _telling(log, 0, begin, 0, TellingFrames(first=True))
        place = begin
        while place < end:
            stop = log.find(b"\n", place) + 1 or size
            number += 1
            yield number, log[place:stop]
            place = stop
        yield from _telling(log, end, size, number, TellingFrames(first=False))


def _line_at(log: mmap, at_ns: int) -> int:
    """Where the first line begins whose time is ``at_ns`` or later; the length of the log if none is."""
    low, high = 0, len(log)
    while low < high:
        middle = log.rfind(b"\n", 0, (low + high) // 2) + 1
        stop = log.find(b"\n", middle) + 1 or len(log)
        stamp = _SECONDS.match(log, middle)
        if stamp is not None and int(stamp[1]) * NS_PER_S + int(stamp[2].ljust(9, b"0")) >= at_ns:
            high = middle
        else:
            low = stop
    return low


def _of_text(telling: TellingFrames, text: NDArray[np.uint8], starts: NDArray[np.intp]) -> list[int]:
    """Which of the lines of ``text`` that begin at ``starts``; all where one is no line of candump -L."""
    marks = np.flatnonzero(text == _DATA)
    if marks.size != starts.size or np.any(marks < starts + 4) or np.any(marks[:-1] > starts[1:]):
        return list(range(starts.size))
    digits = _DIGIT[text[marks[:, None] - np.array((3, 2, 1))]]
    standard = (text[marks - 4] == _SPACE) & np.all(digits >= 0, axis=1)
    ids = np.where(standard, digits @ np.array((256, 16, 1)), 0) & STANDARD_ID_MAX
    places: list[int] = telling.of(ids, text[np.minimum(marks + 1, text.size - 1)] == _REMOTE).tolist()
    return places


def _telling(
    log: mmap, begin: int, end: int, number: int, telling: TellingFrames
) -> Generator[tuple[int, bytes], None, int]:
    """Yield number and text of the telling lines from ``begin`` to ``end``, which follow line ``number``;
    return the last number."""
    while begin < end:
        stop = end if end - begin <= _CHUNK else log.find(b"\n", begin + _CHUNK) + 1 or end
        chunk = log[begin:stop]
        text = np.frombuffer(chunk, np.uint8)
        ends = np.append(np.flatnonzero(text[:-1] == _NEWLINE) + 1, text.size)
        starts = np.append(0, ends[:-1])
        for place in _of_text(telling, text, starts):
            yield number + 1 + place, chunk[starts[place] : ends[place]]
        number += starts.size
        begin = stop
    return number
