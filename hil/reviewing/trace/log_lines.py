"""Logs as frames: candump's, and those that python-can reads.

candump's log (-L, -l), and what it shows, with each -t, -x, -a, -e and -c:

    (1436509052.249713) can0 123#11223344          (1436509052.249713) can0 123#11223344 T
    (1436509052.249713) can0 123#R                 (1436509052.249713) can0 123##1223344
     (2015-07-10 08:17:32.249713)  can0  TX - -  123   [4]  11 22 33 44   '."3D'
     can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME

python-can reads the first of these alone, and ends at the first line that it does not know. By the end of
their names it reads Vector's asc and blf, PEAK's trc, csv, db and mf4.
"""

import gzip
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from servobench.drivers.lean_can import mf4_reader
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.drivers.wire.identifiers import ERROR_FLAG, EXTENDED_ID_MAX, STANDARD_ID_MAX
from servobench.hil.reviewing.trace.log_frame import CLASSICAL_BYTES_MAX, FD_BYTES_MAX, LogFrame

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


if TYPE_CHECKING:
    from can import Message

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
