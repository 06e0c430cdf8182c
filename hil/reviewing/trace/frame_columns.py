"""frames.arrow of a recording as a stream of frames as a log has them: all, or a window with what that rests
on."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_ID_MAX, REMOTE_FLAG
from servobench.hil.rows.arrow_file import is_whole
from servobench.hil.rows.frames_file import (
    BATCH,
    INDEX_DTYPE,
    FrameBatch,
    FramesIndex,
    indexed_batches,
    needed_before,
    needed_behind,
    read_batches,
    read_index,
    read_interfaces,
)
from servobench.hil.rows.run_files import FRAMES_FILE

CLASSICAL_BYTES_MAX: Final = 8
FD_BYTES_MAX: Final = 64


class LogFrame(NamedTuple):
    """One frame of a log or of a live bus."""

    number: int
    """Line or packet of the log, from 1 on."""
    at_ns: int | None
    """Time as the log counts; None where it has no times."""
    channel: str
    """Name of the interface; empty if the log does not tell it."""
    can_id: int
    """11 or 29 bits, without flags; of an error frame its class bits (linux/can/error.h)."""
    data: bytes
    extended: bool = False
    remote: bool = False
    error: bool = False
    fd: bool = False
    sent: str = ""
    """T: sent by who wrote the log, R: received by it; empty if it does not tell."""


EVER_NS: Final = 1 << 62
"""Behind every frame of every log."""
MARGIN_NS: Final = 100 * NS_PER_MS
"""A logger holds frames back until they are in order; one that came later than that stands near its place."""
Hold = Callable[[str, int, int], None]
"""Told of a file's bytes, from the first to behind the last, before they are believed."""


class LogWindow(NamedTuple):
    """Window of a log's times; both ends belong to it."""

    begin_ns: int
    end_ns: int


def held_against_nothing(file: str, begin: int, end: int) -> None:
    """A Hold that believes all."""


class FrameColumns:
    """Frames of a recording, their stamps ns since 1970. Iterating raises BadInput for what is no frame."""

    def __init__(
        self, folder: Path, window: LogWindow | None = None, hold: Hold = held_against_nothing
    ) -> None:
        """``window``: only the frames in there, and what they rest on; ``hold``: told of the bytes before
        they are read."""
        self._folder, self._path = folder, folder / FRAMES_FILE
        self._window, self._hold = window, hold
        self.interfaces = read_interfaces(self._path)
        """Names by segment."""
        self.frames = 0
        """Read so far."""

    def __iter__(self) -> Iterator[LogFrame]:
        for frames, numbers in self.parts():
            self.frames += frames.size
            yield from self.log_frames(frames, numbers)

    def notes(self) -> list[str]:
        """Return remarks for the reader of the frames: that they have lost their end, or still grow."""
        return [] if is_whole(self._path) else [f"{FRAMES_FILE} has no end; told as far as it goes"]

    def parts(self) -> Iterator[tuple[NDArray[np.void], NDArray[np.int64]]]:
        """Yield frames, (n,) of FRAME_DTYPE, with their numbers, (n,)."""
        if self._window is not None:
            yield from self._of_window(self._window)
            return
        count = 0
        for batch in read_batches(self._path):
            yield batch.frames, np.arange(count + 1, count + 1 + batch.frames.size)
            count += batch.frames.size

    def _of_window(self, window: LogWindow) -> Iterator[tuple[NDArray[np.void], NDArray[np.int64]]]:
        index = self._index()
        lying = indexed_batches(index)
        if not lying.size:
            return
        stamps = np.maximum.accumulate(lying["at"])
        low, high = window.begin_ns - MARGIN_NS, window.end_ns + MARGIN_NS
        first = max(0, int(np.searchsorted(stamps, low, side="right")) - 1)
        behind = max(first + 1, int(np.searchsorted(stamps, high, side="right")))
        end = int(lying["begin"][behind]) if behind < lying.size else self._path.stat().st_size
        self._hold(FRAMES_FILE, int(lying["begin"][first]), end)
        number, begun = int(lying["number"][first]), False
        for batch in self._batches(int(lying["begin"][first]), end):
            place = 0 if begun else int(np.searchsorted(batch.frames["at"], low))
            if not begun:
                before = needed_before(index, number + place)
                yield before, before["number"]
                begun = True
            last = batch.end >= end
            until = (
                int(np.searchsorted(batch.frames["at"], high, side="right")) if last else batch.frames.size
            )
            until = max(until, place)
            yield batch.frames[place:until], np.arange(number + place, number + until)
            if last:
                after = needed_behind(index, number + until)
                yield after, after["number"]
            number += batch.frames.size

    def _batches(self, begin: int, end: int) -> Iterator[FrameBatch]:
        """Yield those from byte ``begin`` to ``end``; the last one is the one that ends there or is the last
        of the file."""
        held: FrameBatch | None = None
        for batch in read_batches(self._path, begin):
            if held is not None:
                yield held
            if batch.begin >= end:
                return
            held = batch
            if batch.end >= end:
                break
        if held is not None:
            yield held._replace(end=max(end, held.end))

    def _index(self) -> NDArray[np.void]:
        """The index beside the frames but for its last batch, of which rows may be missing, and what it lacks
        of them."""
        size = self._path.stat().st_size
        index = read_index(self._folder)
        lying = np.flatnonzero(index["can_id"] == BATCH)
        begin, making = 0, FramesIndex(max(1, len(self.interfaces)))
        if lying.size and index["begin"][-1] < size:
            begin, count = int(index["begin"][lying[-1]]), int(index["number"][lying[-1]]) - 1
            index = index[: lying[-1]]
            making.know(index, count)
        else:
            index = index[:0]
        self._hold(FRAMES_FILE, begin, size)
        parts = [making.rows(batch.frames, batch.begin) for batch in read_batches(self._path, begin)]
        parts.insert(0, index)
        return np.concatenate([np.empty(0, INDEX_DTYPE), *parts])

    def name_of(self, segment: int) -> str:
        """Return the name of an interface."""
        return self.interfaces[segment] if segment < len(self.interfaces) else str(segment)

    def log_frames(self, frames: NDArray[np.void], numbers: NDArray[np.int64]) -> Iterator[LogFrame]:
        """Yield (n,) of FRAME_DTYPE with their numbers, (n,), one by one."""
        data = np.ascontiguousarray(frames["data"]).tobytes()
        columns = (numbers, frames["at"], frames["can_id"], frames["sent"], frames["length"])
        for place, (number, at_ns, flagged, sent, length) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        ):
            segment, error, remote = sent >> 1, bool(flagged & ERROR_FLAG), bool(flagged & REMOTE_FLAG)
            yield LogFrame(
                number,
                at_ns,
                self.name_of(segment),
                flagged & EXTENDED_ID_MAX,
                b"" if remote else data[place * 8 : place * 8 + length],
                bool(flagged & EXTENDED_FLAG) and not error,
                remote,
                error,
                False,
                "T" if sent & 1 else "R",
            )
