"""A window of a long candump log in order of time: its lines, and of the others those that they rest on.

Those are looked for in arrays of bytes: everything else outside of the window, nearly all of a log, is never
decoded. Recordings up to format 4 have their frames so.
"""

import re
from collections.abc import Generator, Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.wire.identifiers import STANDARD_ID_MAX
from servobench.hil.reviewing.trace.frame_columns import MARGIN_NS, Hold, LogWindow, held_against_nothing
from servobench.hil.rows.frames_index import TellingFrames

_STAMP: Final = re.compile(rb"\((\d{1,12})\.(\d{1,9})\)")
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
        stamp = _STAMP.match(log, middle)
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
