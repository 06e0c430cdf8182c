"""A window of a long candump log in order of time: its lines, and of the others those that they rest on.

Those are told by the index beside a recording's log (:mod:`servobench.hil.rows.frames_index`). Without one
they are looked for in arrays of bytes: everything else outside of the window, nearly all of a log, is never
decoded.
"""

import re
from collections.abc import Callable, Generator, Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.drivers.wire.identifiers import STANDARD_ID_MAX
from servobench.hil.rows.frames_index import (
    BORDER,
    INDEX_DTYPE,
    TellingFrames,
    needed_before,
    needed_behind,
    read_index,
)
from servobench.hil.rows.run_files import FRAMES_FILE

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


Hold = Callable[[str, int, int], None]
"""Told of a file's bytes, from the first to behind the last, before they are believed."""


class LogWindow(NamedTuple):
    """Window of a log's times; both ends belong to it."""

    begin_ns: int
    end_ns: int


def lines_of_window(
    path: Path, window: LogWindow, hold: Hold = lambda _file, _begin, _end: None
) -> Iterator[tuple[int, bytes]]:
    """Number, from 1 on, and text of the lines that ``window`` needs, in the order of the log.

    The log is one of candump -L whose times never fall. Behind the window come lines of SDO transfers alone.
    Where they stand, the index beside the log tells, as far as it goes.
    """
    size = path.stat().st_size
    if not size:
        return
    index = read_index(path.parent, size)
    covered = index[-1:] if index.size else np.array([(0, 1, BORDER, 0)], INDEX_DTYPE)
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as log:
        begin = _line_at(log, window.begin_ns - _MARGIN_NS)
        end = max(begin, _line_at(log, window.end_ns + _MARGIN_NS))
        known_to, number = int(covered["begin"][0]), int(covered["line"][0]) - 1
        yield from _indexed(log, needed_before(index, begin), hold)
        if known_to < begin:
            hold(FRAMES_FILE, known_to, begin)
            number = yield from _telling(log, known_to, begin, number, TellingFrames(first=True))
        else:
            number = _lines_before(log, begin, index, hold)
        hold(FRAMES_FILE, max(begin - 1, 0), min(end + 1, size))  # with the lines that say: no further
        place = begin
        while place < end:
            stop = log.find(b"\n", place) + 1 or size
            number += 1
            yield number, log[place:stop]
            place = stop
        yield from _indexed(log, needed_behind(index, end), hold)
        if end < known_to:
            end, number = known_to, int(covered["line"][0]) - 1
        hold(FRAMES_FILE, end, size)
        yield from _telling(log, end, size, number, TellingFrames(first=False))


def _indexed(log: mmap, rows: NDArray[np.void], hold: Hold) -> Iterator[tuple[int, bytes]]:
    for begin, number in zip(rows["begin"].tolist(), rows["line"].tolist(), strict=True):
        stop = log.find(b"\n", begin) + 1 or len(log)
        hold(FRAMES_FILE, begin, stop)
        yield number, log[begin:stop]


def _lines_before(log: mmap, begin: int, index: NDArray[np.void], hold: Hold) -> int:
    """The number of the line before byte ``begin``, counted from the last one that the index tells."""
    place = int(np.searchsorted(index["begin"], begin, side="right")) - 1
    told, number = (int(index["begin"][place]), int(index["line"][place])) if place >= 0 else (0, 1)
    hold(FRAMES_FILE, told, begin)
    return number - 1 + log[told:begin].count(b"\n")


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
