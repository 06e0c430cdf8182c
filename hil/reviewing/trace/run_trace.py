"""The bus of a recording: its frames with who sent them, and what its bench file says of the drives."""

from collections.abc import Iterator, Sequence
from itertools import chain, islice
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.errors import BadInput, BenchError
from servobench.drivers.timebase import Instant
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.frame_columns import (
    FrameColumns,
    Hold,
    LogFrame,
    LogWindow,
    held_against_nothing,
)
from servobench.hil.reviewing.trace.node_objects import KnownNodes, NodeKey, SheetFile
from servobench.hil.rows.records_file import read_metadata, refuse_later_format
from servobench.hil.rows.run_files import (
    BENCH_FILE,
    DIRECTION_BYTES,
    DIRECTIONS_FILE,
    FIRST_CYCLE_EPOCH,
    FRAMES_FILE,
    FRAMES_LOG,
    INDEX_FILE,
    RECORDS_FILE,
)
from servobench.hil.rows.seal import SealedFiles
from servobench.hil.rows.side_rows import FRAME_DTYPE, frame_row

_CHUNK: Final = 1 << 16
"""Lines of which are held at once what is asked for."""


class RecordedBus:
    """The frames of a run, in run time."""

    def __init__(self, folder: Path) -> None:
        """Raises BadInput if there are no frames, or if a later version has written them."""
        self._folder = folder
        self._is_text = not (folder / FRAMES_FILE).exists()
        if self._is_text and not (folder / FRAMES_LOG).exists():
            expected = f"a recording with {FRAMES_FILE} (recording.frames of its bench)"
            raise BadInput(str(folder), "", "no frames", expected)
        records = folder / RECORDS_FILE
        metadata = read_metadata(records) if records.exists() else {}
        refuse_later_format(metadata, records)
        self.log = self._opened()
        self.notes: list[str] = []
        """Remarks on what the bench file lacks, and why."""
        self._interface = metadata.get("bus", "").rpartition(":")[2]
        self.zero_ns = int(metadata[FIRST_CYCLE_EPOCH]) if FIRST_CYCLE_EPOCH in metadata else None
        """The first cycle as the stamps count; None if the run never came to one."""

    def __iter__(self) -> Iterator[LogFrame]:
        """Each frame with T or R."""
        return self._told(self.log)

    def of_window(self, window: LogWindow, sealed: SealedFiles | None = None) -> Iterator[LogFrame]:
        """The same of the frames in a window of stamps, and of those that say what they mean.

        ``sealed``: what is read is held against the seal first, which raises BadInput.
        """
        hold: Hold = held_against_nothing
        if sealed is not None:
            sealed.check(INDEX_FILE)
            hold = sealed.check
        self.log = self._opened(window, hold)
        return self._told(self.log, hold)

    def _opened(
        self, window: LogWindow | None = None, hold: Hold = held_against_nothing
    ) -> BusLog | FrameColumns:
        if self._is_text:
            return BusLog(self._folder / FRAMES_LOG, window=window, hold=hold)
        return FrameColumns(self._folder, window, hold)

    def _told(self, log: BusLog | FrameColumns, hold: Hold = held_against_nothing) -> Iterator[LogFrame]:
        path = self._folder / DIRECTIONS_FILE
        if not self._is_text or not path.exists() or not path.stat().st_size:
            yield from log
            return
        with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as letters:
            for frame in log:
                place = (frame.number - 1) * DIRECTION_BYTES
                hold(DIRECTIONS_FILE, place, place + 1)
                yield frame._replace(sent=letters[place : place + 1].decode("latin-1"))

    def arrays(self, segments: Sequence[str]) -> Iterator[NDArray[np.void]]:
        """The frames in blocks of FRAME_DTYPE, (n,), without error frames; ``segments``: names of the further
        ones, by number."""
        numbers = {name: number for number, name in enumerate(segments, start=1)}
        zero_ns = self.zero_ns or 0
        frames = iter(self.log)
        while block := list(islice(frames, _CHUNK)):
            rows = [
                frame_row(
                    Instant(frame.at_ns - zero_ns),
                    frame.can_id,
                    numbers.get(frame.channel, 0) << 1,
                    frame.data,
                )
                for frame in block
                if frame.at_ns is not None and not frame.error and len(frame.data) <= 8
            ]
            yield np.frombuffer(b"".join(rows), FRAME_DTYPE)

    def known(self, sheets: list[SheetFile]) -> KnownNodes:
        """``sheets``, those of the bench, and the factors of its commissioned drives.

        Raises BadInput for one of ``sheets`` that cannot be read.
        """
        try:
            bench = load_bench(self._folder / BENCH_FILE)
        except BenchError as error:
            self.notes.append(f"the bench file tells nothing of the drives: {error}")
            return KnownNodes(sheets)
        overrides: dict[NodeKey, ScaleOverride] = {}
        own: list[SheetFile] = []
        for drive in bench.drive.values():
            channel = drive.segment or self._interface
            if drive.commissioned is not None:
                overrides[channel, drive.node] = drive.commissioned.override
            if drive.eds is not None:
                own.append(SheetFile(Path(drive.eds), drive.node, channel))
        readable = [sheet for sheet in own if self._is_readable(sheet)]
        return KnownNodes(list(chain(sheets, readable)), overrides)

    def _is_readable(self, sheet: SheetFile) -> bool:
        try:
            KnownNodes([sheet])
        except BenchError as error:
            self.notes.append(f"{error}; --eds {sheet.node}=FILE gives it")
            return False
        return True
