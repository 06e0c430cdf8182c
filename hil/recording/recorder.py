"""The writer's side of a recording: what the loop calls, at the price of one row in a ring.

No disk, no log, no telemetry here: another process (:mod:`servobench.hil.recording.logger`) drains the rings.
"""

import errno
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.loop.cycle_record import ROW
from servobench.hil.recording.logger_process import LoggerProcess, RecordingFailed, salvage
from servobench.hil.recording.ring import RingWriter, refuse
from servobench.hil.recording.row_writer import RowWriter
from servobench.hil.recording.run_recorder import MemoryRecorder, RunRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import BENCH_FILE
from servobench.hil.rows.side_rows import EVENT, FRAME, RunEvent, event_row
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import RunOutcome
from servobench.virtual_bus.faults.fault_log import BLOCK

ROWS_CAPACITY = 1 << 16
FRAMES_CAPACITY = 1 << 19
EVENTS_CAPACITY = 1 << 11
FAULTS_CAPACITY = 1 << 12
"""Rows: a minute of cycles of one axis at 1 kHz, and more of frames. The logger may be that far behind, and
is while it starts: a loop in simulated time has done half a minute by then. A row of faults is a block
of 60."""
_POLL_NS = NS_PER_MS // 4
_STALL_MAX_NS = 60 * NS_PER_S
"""A logger that takes nothing for so long takes nothing any more; a slow disk holds it up for seconds."""
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)


class Recorder(RunRecorder):
    """A loop's access to its recording: four rings, and the process that drains them into files.

    No call waits in real time, except ``close``.
    """

    def __init__(self, plan: RecordingPlan) -> None:
        """See :func:`start_recording`."""
        self._plan = plan
        self._taken, self._taken_at = -1, Instant(0)
        """Rows that the logger had taken when it was last seen to take any, and when that was."""
        on_full = refuse if plan.real_time else self._wait_for_logger
        try:
            self._rows = RingWriter(ROW, ROWS_CAPACITY, on_full)
            self._frames = RingWriter(FRAME, FRAMES_CAPACITY, on_full)
            self._events = RingWriter(EVENT, EVENTS_CAPACITY, on_full)
            self._faults = RingWriter(BLOCK, FAULTS_CAPACITY, on_full)
        except OSError as error:
            reason = f"no memory for its rings: {error.strerror}"
            # a limit on files (ulimit -f) counts for files in memory, too
            advice = "; raise the limit of ulimit -f" if error.errno == errno.EFBIG else ""
            raise RecordingFailed(reason + advice) from error
        self._keep_frames = plan.frames and plan.folder is not None
        self.record = self.tap().record
        self._logger = LoggerProcess(plan, [ring.descriptor for ring in self._rings])

    def tap(self, segment: int = 0) -> RowWriter:
        """See :class:`RunRecorder`, as of the methods below; ``direction`` of a frame: "tx" or "rx"."""
        return RowWriter(self._rows, self._frames, self._keep_frames, segment)

    def tell(self, event: RunEvent) -> None:
        """A row."""
        self._events.push(event_row(event))

    def fault_block(self, length: int, block: bytes) -> None:
        """A row."""
        self._faults.push(BLOCK.pack(length, block))

    @property
    def logger_process_id(self) -> int:
        """Process id of the logger, which drains the rings."""
        return self._logger.process_id

    def wait_ready(self) -> None:
        """Return when the logger is up and drains; before that the rings fill. Error: RecordingFailed."""
        self._logger.wait_ready()

    def confirm(self, wait: Callable[[], None]) -> None:
        """The logger says so."""
        self._logger.confirm(wait)

    def trouble(self) -> str:
        """By the logger, or by the rings."""
        refused = sum(ring.refused for ring in self._rings)
        told = self._logger.trouble()
        if told or not refused:
            return told
        return f"{refused} rows lost, the logger was too slow"

    def close(self, outcome: RunOutcome) -> Summary:
        """By the logger, or by a process that does what it did not live to do."""
        summary = self._logger.finish(outcome)
        try:
            if summary is None:
                trouble = self._logger.trouble()
                if self._plan.folder is None:
                    raise RecordingFailed(trouble)
                summary = salvage(self._plan, [ring.descriptor for ring in self._rings], outcome, trouble)
        finally:
            for ring in self._rings:
                ring.close()
        return summary

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


def recorder_of(plan: RecordingPlan) -> RunRecorder:
    """Files are another process's business, and in real time the figures, too, which the loop would feel."""
    if plan.folder is None and not plan.view and not plan.real_time:
        return MemoryRecorder(plan)
    return start_recording(plan)


def start_recording(plan: RecordingPlan) -> Recorder:
    """Make the run's folder and rings and start the logger process.

    Error: BadInput if the folder cannot be made, or already holds something;
    RecordingFailed if the disk is full or the logger does not come up.
    """
    if plan.folder is not None:
        _make_folder(plan.folder)
        try:
            (plan.folder / BENCH_FILE).write_text(plan.bench_toml, encoding="utf-8")
        except OSError as error:
            raise RecordingFailed(f"{plan.folder / BENCH_FILE}: {error.strerror}") from error
    recorder = Recorder(plan)
    if plan.real_time:
        # its start costs a second of a core, which a real-time loop would feel
        recorder.wait_ready()
    return recorder


def new_folder(path: Path) -> Path:
    """Make the folder ``path``, or one with a number behind its name where that is taken, and return it.

    Errors: as of :func:`start_recording`.
    """
    folder = path
    for number in itertools.count(2):
        with suppress(FileExistsError), _making(folder):
            folder.mkdir(parents=True)
            break
        folder = path.with_name(f"{path.name}-{number}")
    return folder


@contextmanager
def _making(folder: Path) -> Iterator[None]:
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        if error.errno in _DISK_ERRORS:
            raise RecordingFailed(f"{folder}: {error.strerror}") from error
        raise BadInput("--record", "", str(folder), "a folder that can be made", str(error)) from error


def _make_folder(folder: Path) -> None:
    try:
        with _making(folder):
            folder.mkdir(parents=True, exist_ok=True)
            occupied = any(folder.iterdir())
    except FileExistsError as error:
        raise BadInput("--record", "", str(folder), "a folder that can be made", str(error)) from error
    if occupied:
        raise BadInput(
            "--record", "", str(folder), "a new or empty folder", "a recording is never overwritten"
        )
