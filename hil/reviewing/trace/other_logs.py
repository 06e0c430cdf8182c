"""Logs that python-can reads, by the end of their names: Vector's asc and blf, PEAK's trc, csv, db, mf4.

candump's .log is not among them: python-can ends at the first line of it that it does not know.
"""

import gzip
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from servobench.drivers.timebase import NS_PER_US
from servobench.hil.reviewing.trace.log_frame import LogFrame

if TYPE_CHECKING:
    from can import Message

SUFFIXES: Final = (".asc", ".blf", ".csv", ".db", ".mf4", ".trc")
_UNDIRECTED: Final = (".csv", ".db")
"""python-can takes every frame in there for a received one."""
_PACKED: Final = ".gz"


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
    except Exception as error:  # noqa: BLE001 - whatever another library raises on a file of whatever content
        raise BrokenLog(f"frame {number + 1}: {error or type(error).__name__}") from None


@contextmanager
def _opened(path: Path) -> Iterator[Iterable["Message"]]:
    """The file is closed here: a reader that refuses it leaves it open."""
    from can.io.generic import BinaryIOMessageReader, TextIOMessageReader
    from can.io.player import MESSAGE_READERS

    reader: Any = MESSAGE_READERS[kind_of(path)]
    packed = path.suffix.lower() == _PACKED
    if not issubclass(reader, BinaryIOMessageReader | TextIOMessageReader):
        with reader(path) as messages:
            yield messages
        return
    mode = "rt" if issubclass(reader, TextIOMessageReader) else "rb"
    with (gzip.open if packed else open)(path, mode) as file:
        yield reader(file)


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
