"""Keepers of a run's parts: the files of its folder."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import Duration
from servobench.hil.configuration.network_file import NETWORK_FILE, network_text
from servobench.hil.recording.append_file import (
    FAULTS_TAIL_FILE,
    FRAMES_TAIL_FILE,
    TAIL_FILE,
    AppendFile,
    Tail,
)
from servobench.hil.recording.frame_files import FrameFiles, FrameOrder
from servobench.hil.recording.run_metadata import run_metadata
from servobench.hil.reviewing.network_meter import clocks_of
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import ENTRY_DTYPE, FaultEntries, RunZero, event_json
from servobench.hil.rows.faults_file import BATCH_ENTRIES, FaultsWriter
from servobench.hil.rows.frames_file import BATCH_FRAMES
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.rows.run_files import EVENTS_FILE, FAULTS_FILE, FRAMES_FILE, LOAD_FILE, RECORDS_FILE
from servobench.hil.rows.side_rows import (
    FRAME_DTYPE,
    BeginEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
    drives_of,
)
from servobench.hil.verdict.summary import Summary

BLOCK_ROWS = 8_192
"""Rows of a block, at 30 bytes each. Half as many take 52 bytes a row; twice as many take 17, and are written
in 27 ms, not 18. In real time the flush of each second comes first."""
LIVE_VIEW = "live view"


class Keeper:
    """Takes what was drained. Every method may raise OSError; it is not called again then."""

    name: str
    stored = 0
    """Cycle records that are in its file."""

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:
        """Take what came since the last call: rows (n,) of ROW_DTYPE, frames (m,) of FRAME_DTYPE, and the
        events."""
        raise NotImplementedError

    def flush(self) -> None:
        """Bring it to the disk, or to the viewer; about once a second. Most hold nothing back."""

    def finish(self, summary: Summary) -> None:
        """The end of the run."""
        raise NotImplementedError

    def abandon(self) -> None:
        """Take no more room on the disk, after it could not be written; most write nothing by themselves."""


class RowBlocks:
    """Collects drained rows into fewer, larger blocks; small ones cost more room than their content."""

    def __init__(self, size: int = BLOCK_ROWS) -> None:
        self._size = size
        self._parts: list[Rows] = []
        self._count = 0

    def add(self, rows: Rows) -> bool:
        """True if there is enough for a block."""
        if rows.size:
            self._parts.append(rows)
            self._count += rows.size
        return self._count >= self._size

    def take(self) -> Rows | None:
        """All collected rows; None if there are none."""
        if not self._parts:
            return None
        block = np.concatenate(self._parts)
        self._parts, self._count = [], 0
        return block


class RecordsKeeper(Keeper):
    """records.arrow, and what is not yet in it.

    Its head is written with the first cycle, when all that it says of the run is known.
    """

    name = RECORDS_FILE

    def __init__(self, plan: RecordingPlan, folder: Path) -> None:
        self._plan = plan
        self._writer = RecordsWriter(folder / RECORDS_FILE)
        self._blocks = RowBlocks()
        self._tail = Tail(folder / TAIL_FILE, ROW_DTYPE)
        self._zero = RunZero(plan.started_at)
        self._drives: dict[str, str] = {}
        self._begun = False

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        self._drives |= drives_of(events)
        if self._zero.look(events):
            self._begin()
        if not self._blocks.add(rows):
            self._tail.append(rows)
            return
        try:
            self.flush()
        except OSError:
            self._tail.append(rows)  # a row takes less room there than its whole block
            raise

    def flush(self) -> None:
        block = self._blocks.take()
        if block is not None:
            self._begin()
            self._writer.write(block)
            self.stored += block.size
            self._tail.restart(self.stored)

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        self.flush()
        self._begin()
        self._writer.close()
        self._tail.remove()

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            self._writer.begin(run_metadata(self._plan, self._zero.at, self._drives), self._zero.at)


class FramesKeeper(Keeper):
    """frames.arrow and its index, and what is not yet in them.

    In simulated time the stamps count from the first cycle, so the frames before it wait until that is known.
    """

    name = FRAMES_FILE

    def __init__(self, plan: RecordingPlan, folder: Path) -> None:
        self._plan = plan
        self._files = FrameFiles(folder, plan.interfaces)
        self._tail = Tail(folder / FRAMES_TAIL_FILE, FRAME_DTYPE)
        self._order = FrameOrder(len(plan.interfaces))
        self._zero = RunZero(plan.started_at)
        self._waiting = np.empty(0, FRAME_DTYPE)
        """In order, for a batch or for the first cycle."""

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        self._zero.look(events)
        if not frames.size:
            return
        self._waiting = np.concatenate((self._waiting, self._order.take(frames)))
        self._tail.restart(self._files.written, np.concatenate((self._waiting, self._order.held)))
        if self._waiting.size >= BATCH_FRAMES:
            self.flush()

    def flush(self) -> None:
        if self._plan.wall_offset is not None or self._zero.told:
            self._write()

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        self._waiting = np.concatenate((self._waiting, self._order.rest()))
        self._write()
        self._files.close()
        self._tail.remove()
        if self._order.late:
            raise OSError(f"{self._order.late} frames came too late to be put in their place of time")

    def _write(self) -> None:
        self._files.write(self._waiting, self._plan.stamp_offset(self._zero.at))
        self._waiting = self._waiting[:0]


class EventsKeeper(Keeper):
    """events.jsonl: one JSON object a line, with the instant in ns since the first cycle."""

    name = EVENTS_FILE

    def __init__(
        self, plan: RecordingPlan, folder: Path, zero: RunZero | None = None, *, fresh: bool = True
    ) -> None:
        """``zero``: the first cycle, if the file counts from it; not ``fresh``: behind what the file has."""
        self._path = folder / EVENTS_FILE
        self._file = AppendFile(self._path, fresh=fresh)
        self._zero = zero or RunZero(plan.started_at)

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        shown = [event for event in events if isinstance(event, TextEvent | StateEvent | BeginEvent)]
        before = self._zero.at
        if self._zero.look(events):
            self._recount(Duration(before - self._zero.at))
        lines = [json.dumps(event_json(event, self._zero.at)) + "\n" for event in shown]
        self._file.write("".join(lines).encode())

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        self._file.close()

    def _recount(self, moved: Duration) -> None:
        """The first cycle is known: what the file has counted from the start of the bench until now."""
        entries = [json.loads(line) for line in self._path.read_bytes().splitlines()]
        lines = [json.dumps({**entry, "at_ns": entry["at_ns"] + moved}) + "\n" for entry in entries]
        self._file.restart("".join(lines).encode())


class LoadKeeper(Keeper):
    """load.csv, if there is a load machine that measures; it does from the first cycle on."""

    name = LOAD_FILE

    def __init__(self, plan: RecordingPlan, folder: Path) -> None:
        self._path = folder / LOAD_FILE
        self._file: AppendFile | None = None
        self._zero = RunZero(plan.started_at)

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        self._zero.look(events)
        for event in events:
            if isinstance(event, LoadEvent):
                if self._file is None:
                    self._file = AppendFile(self._path)
                    self._file.write(b"at_ns,axis,torque_nm,speed_rad_s\n")
                at = event.at - self._zero.at
                line = f"{at},{event.axis},{event.torque_nm:.6g},{event.speed_rad_s:.6g}\n"
                self._file.write(line.encode())

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        if self._file is not None:
            self._file.close()


class NetworkKeeper(Keeper):
    """network.toml."""

    name = NETWORK_FILE

    def __init__(self, folder: Path, review: Review) -> None:
        self._path = folder / NETWORK_FILE
        self._review = review

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:
        """The review takes the rows."""

    def finish(self, summary: Summary) -> None:
        network = self._review.network.network()
        if network is not None:
            told = network.model_copy(update={"clocks": clocks_of(summary)})
            self._path.write_text(network_text(told), encoding="utf-8")


class FaultsKeeper(Keeper):
    """faults.arrow: what :class:`FaultEntries` took last, whenever the others get their rows; and what is not
    yet in it."""

    name = FAULTS_FILE

    def __init__(self, folder: Path, entries: FaultEntries) -> None:
        self._writer = FaultsWriter(folder / FAULTS_FILE)
        self._tail = Tail(folder / FAULTS_TAIL_FILE, ENTRY_DTYPE)
        self._entries = entries
        self._waiting = np.empty(0, ENTRY_DTYPE)
        self._written = 0

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        fresh = self._entries.fresh
        self._waiting = np.concatenate((self._waiting, fresh))
        if self._waiting.size < BATCH_ENTRIES:
            self._tail.append(fresh)
            return
        try:
            self._write(self._waiting.size // BATCH_ENTRIES * BATCH_ENTRIES)
        except OSError:
            self._tail.append(fresh)  # an entry takes less room there than its whole batch
            raise
        self._tail.restart(self._written, self._waiting)

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        self._write(self._waiting.size)
        self._writer.close()
        self._tail.remove()

    def _write(self, count: int) -> None:
        """Put the first ``count`` of those that wait into the file."""
        while count:
            batch = self._waiting[: min(count, BATCH_ENTRIES)]
            self._writer.write(batch)
            self._waiting = self._waiting[batch.size :]
            self._written += batch.size
            count -= batch.size
