"""A window of a long candump log in order of time: its lines, and of the others those that they rest on.

What a frame means rests on the SDO transfers before it, on whether its node was heard before, and on node
guarding; an SDO transfer of the window may end behind it. Everything else outside of it, nearly all of a log,
is passed over in arrays of bytes and never decoded.
"""

import re
from collections.abc import Generator, Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.canopen.cob_ids import ERROR_CONTROL, NODE_BITS, SDO_ANSWER, SDO_REQUEST
from drivers.timebase import NS_PER_MS, NS_PER_S
from drivers.wire.identifiers import STANDARD_ID_MAX

_STAMP: Final = re.compile(rb"\((\d{1,12})\.(\d{1,9})\)")
_CHUNK: Final = 1 << 22
"""Bytes that are looked through at once; a few arrays of this length are held."""
EVER_NS: Final = 1 << 62
"""Behind every frame of every log."""
_MARGIN_NS: Final = 100 * NS_PER_MS
"""A logger holds frames back until they are in order; one that came later than that stands near its place."""
_SPACE, _NEWLINE, _DATA, _REMOTE = (ord(mark) for mark in " \n#R")
_DIGIT: Final = np.full(256, -1, np.int32)
"""By byte: the hexadecimal digit that it is."""
_DIGIT[[ord(digit) for digit in "0123456789ABCDEF"]] = range(16)
_SDO: Final = np.zeros(STANDARD_ID_MAX + 1, np.bool_)
"""By identifier."""
for _service in (SDO_ANSWER, SDO_REQUEST):
    _SDO[_service + 1 : _service + NODE_BITS + 1] = True


class LogWindow(NamedTuple):
    """As a log counts; both ends belong to it."""

    begin_ns: int
    end_ns: int


def lines_of_window(path: Path, window: LogWindow) -> Iterator[tuple[int, bytes]]:
    """Number, from 1 on, and text of the lines that ``window`` needs, in the order of the log.

    The log is one of candump -L whose times never fall. Behind the window come lines of SDO transfers alone.
    """
    if not path.stat().st_size:
        return
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as log:
        begin = _line_at(log, window.begin_ns - _MARGIN_NS)
        end = max(begin, _line_at(log, window.end_ns + _MARGIN_NS))
        number = yield from _telling(log, 0, begin, 0, TellingFrames(~_SDO))
        while begin < end:
            stop = log.find(b"\n", begin) + 1 or len(log)
            number += 1
            yield number, log[begin:stop]
            begin = stop
        yield from _telling(log, end, len(log), number, TellingFrames(np.zeros_like(_SDO)))


def _line_at(log: mmap, at_ns: int) -> int:
    """Where the first line begins whose time is ``at_ns`` or later; the length of the log if none is."""
    low, high = 0, len(log)
    while low < high:
        middle = log.rfind(b"\n", 0, (low + high) // 2) + 1
        stop = log.find(b"\n", middle) + 1 or len(log)
        stamp = _STAMP.match(log, middle)
        if stamp is not None and int(stamp[1]) * NS_PER_S + int(stamp[2].ljust(9, b"0")) >= at_ns:
            high = middle
        else:
            low = stop
    return low


class TellingFrames:
    """Which frames say what others mean."""

    def __init__(self, first: NDArray[np.bool_]) -> None:
        """``first``: by identifier, whether its first frame does; it tells that there is such a node."""
        self._first = first
        self._always = _SDO.copy()

    def of(self, text: NDArray[np.uint8], starts: NDArray[np.intp]) -> list[int]:
        """Which of the lines of ``text`` that begin at ``starts``; all where one is no line of candump -L."""
        marks = np.flatnonzero(text == _DATA)
        if marks.size != starts.size or np.any(marks < starts + 4) or np.any(marks[:-1] > starts[1:]):
            return list(range(starts.size))
        digits = _DIGIT[text[marks[:, None] - np.array((3, 2, 1))]]
        standard = (text[marks - 4] == _SPACE) & np.all(digits >= 0, axis=1)
        ids = np.where(standard, digits @ np.array((256, 16, 1)), 0) & STANDARD_ID_MAX
        guarded = ids[text[np.minimum(marks + 1, text.size - 1)] == _REMOTE]
        self._always[guarded[(guarded & ~NODE_BITS) == ERROR_CONTROL]] = True
        fresh = np.flatnonzero(self._first[ids])
        fresh = fresh[np.unique(ids[fresh], return_index=True)[1]]
        self._first[ids[fresh]] = False
        telling: list[int] = np.union1d(np.flatnonzero(self._always[ids]), fresh).tolist()
        return telling


def _telling(
    log: mmap, begin: int, end: int, number: int, telling: TellingFrames
) -> Generator[tuple[int, bytes], None, int]:
    """Of the lines from ``begin`` to ``end``, behind line ``number``, those that tell; the last number."""
    while begin < end:
        stop = end if end - begin <= _CHUNK else log.find(b"\n", begin + _CHUNK) + 1 or end
        chunk = log[begin:stop]
        text = np.frombuffer(chunk, np.uint8)
        ends = np.append(np.flatnonzero(text[:-1] == _NEWLINE) + 1, text.size)
        starts = np.append(0, ends[:-1])
        for place in telling.of(text, starts):
            yield number + 1 + place, chunk[starts[place] : ends[place]]
        number += starts.size
        begin = stop
    return number
