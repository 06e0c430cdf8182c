"""The writer's side of a recording: what the loop calls, at the price of one row in a ring.

No disk, no log, no telemetry here: another process (:mod:`hil.recording.logger`) drains the rings.
"""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.errors import BadInput
from drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from drivers.wire.frame_port import FrameTap
from hil.loop.samples import CycleRecord
from hil.recording.logger_process import LoggerProcess, RecordingFailed, salvage
from hil.recording.ring import RingWriter, refuse
from hil.recording.row_writer import RowWriter
from hil.recording.run_folder import BENCH_FILE
from hil.reviewing.review import Review
from hil.rows.recording_plan import RecordingPlan, ReviewPlan
from hil.rows.records import ROW, ROW_DTYPE, row_of
from hil.rows.side_rows import (
    EVENT,
    FRAME,
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    StateEvent,
    TextEvent,
    event_row,
)
from hil.verdict.summary import Summary, summarise
from hil.verdict.verdict import RunOutcome
from virtual_bus.faults.fault_log import BLOCK

ROWS_CAPACITY = 1 << 16
FRAMES_CAPACITY = 1 << 19
EVENTS_CAPACITY = 1 << 11
FAULTS_CAPACITY = 1 << 12
"""Rows: a minute of cycles of one axis at 1 kHz, and more of frames. The logger may be that far behind, and
is while it starts: a loop in simulated time has done half a minute by then. A row of faults is a block
of 60."""
_REVIEWED_BYTES = 1024 * ROW.size
"""What is reviewed at a time without a logger."""

_POLL_NS = NS_PER_MS // 4
_STALL_MAX_NS = 60 * NS_PER_S
"""A logger that takes nothing for so long takes nothing any more; a slow disk holds it up for seconds."""
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)


class Recorder(Protocol):
    """What a loop may do with a recording. No call waits in real time, except ``close``."""

    def tap(self, segment: int = 0) -> FrameTap:
        """What takes the raw frames of the link to a segment, the first or another one."""
        ...

    def begin(self, at: Instant) -> None:
        """The run's time zero: the instant of the first cycle. Events before it get negative times."""
        ...

    def record(self, record: CycleRecord) -> None:
        """One complete cycle of one axis; each axis in order of sequence."""
        ...

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """One raw frame as the bench's link saw it; fits ``BusLink.tap``. ``direction``: "tx" or "rx"."""
        ...

    def event(self, at: Instant, level: str, text: str) -> None:
        """Something worth reading. ``level``: "INFO", "WARN", "ERROR" or "CRITICAL"."""
        ...

    def state(self, at: Instant, track: str, label: str) -> None:
        """``track`` (e.g. "phase") is in state ``label`` from ``at`` on.

        The tracks "AXIS drive" and "AXIS link" follow from the records by themselves while the
        loop runs; before and after it they are the caller's.
        """
        ...

    def identity(self, at: Instant, axis: str, text: str) -> None:
        """Who the drive of an axis is, as it told."""
        ...

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        """What the load machine of an axis measured; a few dozen times a second at most."""
        ...

    def confirm(self, wait: Callable[[], None]) -> None:
        """Return when all that was recorded until now is stored; ``wait`` lets a little time pass.

        Error: RecordingFailed.
        """
        ...

    def trouble(self) -> str:
        """Why the run is not wholly recorded, as far as is known; empty if it is. Does not wait."""
        ...

    def close(self, outcome: RunOutcome) -> Summary:
        """End the recording and return its summary. Error: RecordingFailed if there is none."""
        ...


class MemoryRecorder:
    """Keeps no files and no frames: reviews the records in this process."""

    def __init__(self, plan: ReviewPlan, seed: int = 0) -> None:
        self.events: list[TextEvent | StateEvent | LoadEvent] = []
        self._plan, self._seed = plan, seed
        self._review = Review(plan)
        self._rows = bytearray()

    def tap(self, segment: int = 0) -> FrameTap:  # noqa: ARG002
        return FrameTap()

    def begin(self, at: Instant) -> None:
        """Nothing depends on it here."""

    def record(self, record: CycleRecord) -> None:
        self._rows += row_of(record)
        if len(self._rows) == _REVIEWED_BYTES:
            self._review_filled()

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Dropped."""

    def event(self, at: Instant, level: str, text: str) -> None:
        self.events.append(TextEvent(at, level, text))

    def state(self, at: Instant, track: str, label: str) -> None:
        self.events.append(StateEvent(at, track, label))

    def identity(self, at: Instant, axis: str, text: str) -> None:
        """Nobody reads it here."""

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        self.events.append(LoadEvent(at, axis, torque_nm, speed_rad_s))

    def confirm(self, wait: Callable[[], None]) -> None:
        """Memory holds it."""

    def trouble(self) -> str:
        return ""

    def close(self, outcome: RunOutcome) -> Summary:
        self._review_filled()
        return summarise(self._review.figures(), outcome, self._plan.limits, "", self._seed)

    def _review_filled(self) -> None:
        self._review.add(np.frombuffer(bytes(self._rows), ROW_DTYPE))
        self.events += self._review.take_events()
        self._rows.clear()


class FolderRecorder:
    """Four rings and the process that drains them into the run's folder."""

    def __init__(self, plan: RecordingPlan) -> None:
        """See :func:`start_recording`."""
        self._plan = plan
        self._taken, self._taken_at = -1, Instant(0)
        """Rows that the logger had taken when it was last seen to take any, and when that was."""
        on_full = refuse if plan.real_time else self._wait_for_logger
        self._rows = RingWriter(ROW, ROWS_CAPACITY, on_full)
        self._frames = RingWriter(FRAME, FRAMES_CAPACITY, on_full)
        self._events = RingWriter(EVENT, EVENTS_CAPACITY, on_full)
        self._faults = RingWriter(BLOCK, FAULTS_CAPACITY, on_full)
        self._keep_frames = plan.frames and plan.folder is not None
        writer = RowWriter(self._rows, self._frames, self._keep_frames)
        self.record: Callable[[CycleRecord], None] = writer.record
        """See :meth:`Recorder.record`."""
        self.frame: Callable[[str, int, bytes, bool, bool, Instant], None] = writer.frame
        """See :meth:`Recorder.frame`."""
        self._logger = LoggerProcess(plan, [ring.descriptor for ring in self._rings])

    def tap(self, segment: int = 0) -> FrameTap:
        return RowWriter(self._rows, self._frames, self._keep_frames, segment)

    def begin(self, at: Instant) -> None:
        self._events.push(event_row(BeginEvent(at)))

    def event(self, at: Instant, level: str, text: str) -> None:
        self._events.push(event_row(TextEvent(at, level, text)))

    def state(self, at: Instant, track: str, label: str) -> None:
        self._events.push(event_row(StateEvent(at, track, label)))

    def identity(self, at: Instant, axis: str, text: str) -> None:
        self._events.push(event_row(IdentityEvent(at, axis, text)))

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        self._events.push(event_row(LoadEvent(at, axis, torque_nm, speed_rad_s)))

    def fault_block(self, length: int, block: bytes) -> None:
        """A block of entries, of which ``length`` bytes are filled; fits ``FaultLog.send_to``."""
        self._faults.push(BLOCK.pack(length, block))

    @property
    def logger_process_id(self) -> int:
        """Of the process that drains the rings."""
        return self._logger.process_id

    def wait_ready(self) -> None:
        """Return when the logger is up and drains; before that the rings fill. Error: RecordingFailed."""
        self._logger.wait_ready()

    def confirm(self, wait: Callable[[], None]) -> None:
        self._logger.confirm(wait)

    def trouble(self) -> str:
        refused = sum(ring.refused for ring in self._rings)
        told = self._logger.trouble()
        if told or not refused:
            return told
        return f"{refused} rows lost, the logger was too slow"

    def close(self, outcome: RunOutcome) -> Summary:
        summary = self._logger.finish(outcome)
        try:
            if summary is None:
                summary = self._salvaged(outcome)
        finally:
            for ring in self._rings:
                ring.close()
        return summary

    def _salvaged(self, outcome: RunOutcome) -> Summary:
        trouble = self._logger.trouble()
        if self._plan.folder is None:
            raise RecordingFailed(trouble)
        descriptors = [ring.descriptor for ring in self._rings]
        return Summary.from_json(salvage(self._plan, descriptors, outcome, trouble))

    @property
    def _rings(self) -> tuple[RingWriter, ...]:
        return self._rows, self._frames, self._events, self._faults

    def _wait_for_logger(self) -> bool:
        """Policy of a full ring in simulated time: wait as long as there is somebody to wait for."""
        clock = MonotonicClock()
        now = clock.now()
        taken = sum(ring.taken for ring in self._rings)
        if taken != self._taken:
            self._taken, self._taken_at = taken, now
        if self._logger.gone or now - self._taken_at > _STALL_MAX_NS:
            return False
        clock.sleep_until(Instant(now + _POLL_NS))
        return True


def start_recording(plan: RecordingPlan) -> FolderRecorder:
    """Make the run's folder and rings and start the logger process.

    Error: BadInput if the folder cannot be made, or already holds something;
    RecordingFailed if the disk is full or the logger does not come up.
    """
    if plan.folder is not None:
        _make_folder(plan.folder)
        try:
            (plan.folder / BENCH_FILE).write_text(plan.bench_toml)
        except OSError as error:
            raise RecordingFailed(f"{plan.folder / BENCH_FILE}: {error.strerror}") from error
    recorder = FolderRecorder(plan)
    if plan.real_time:
        # its start costs a second of a core, which a real-time loop would feel
        recorder.wait_ready()
    return recorder


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
    except OSError as error:
        if error.errno in _DISK_ERRORS:
            raise RecordingFailed(f"{folder}: {error.strerror}") from error
        raise BadInput("--record", "", str(folder), "a folder that can be made", str(error)) from error
    if occupied:
        raise BadInput(
            "--record", "", str(folder), "a new or empty folder", "a recording is never overwritten"
        )
