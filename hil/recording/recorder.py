"""The writer's side of a recording: what the loop calls, at the price of one row in a ring.

No disk, no log, no telemetry here: another process (:mod:`hil.recording.logger`) drains the rings.
"""

import json
import subprocess
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.errors import BadInput, PeerFault
from drivers.frame_port import FrameTap
from drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from hil.figures.review import Review
from hil.figures.summary import RunOutcome, Summary, summarise
from hil.recording.recording_plan import RecordingPlan, ReviewPlan
from hil.recording.records import ROW, ROW_DTYPE, store_record
from hil.recording.ring import RingWriter, refuse
from hil.recording.row_writer import RowWriter
from hil.recording.side_rows import (
    EVENT,
    FRAME,
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    StateEvent,
    TextEvent,
    event_fields,
)
from hil.samples import CycleRecord
from virtual_bus.child_python import python_command, python_environment
from virtual_bus.fault_injection.fault_log import BLOCK

ROWS_CAPACITY = 1 << 16
FRAMES_CAPACITY = 1 << 19
EVENTS_CAPACITY = 1 << 11
FAULTS_CAPACITY = 1 << 12
"""Rows: a minute of cycles of one axis at 1 kHz, and more of frames. The logger may be that far behind, and
is while it starts: a loop in simulated time has done half a minute by then. A row of faults is a block
of 90."""

_FINISH_MAX_S = 120.0
_POLL_NS = NS_PER_MS // 4
_BENCH_FILE, _LOGGER_LOG = "bench.toml", "logger.log"


@dataclass(eq=False)
class RecordingFailed(PeerFault):
    """The logger process died or does not finish; the run's folder holds what it had written."""


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

    def close(self, outcome: RunOutcome) -> Summary:
        """End the recording and return its summary. Error: RecordingFailed."""
        ...


class MemoryRecorder:
    """Keeps no files and no frames: reviews the records in this process."""

    def __init__(self, plan: ReviewPlan, seed: int = 0) -> None:
        self.events: list[TextEvent | StateEvent | LoadEvent] = []
        self._plan, self._seed = plan, seed
        self._review = Review(plan)
        self._rows = bytearray(1024 * ROW.size)
        self._filled = 0

    def tap(self, segment: int = 0) -> FrameTap:  # noqa: ARG002
        return FrameTap()

    def begin(self, at: Instant) -> None:
        """Nothing depends on it here."""

    def record(self, record: CycleRecord) -> None:
        store_record(self._rows, self._filled, record)
        self._filled += ROW.size
        if self._filled == len(self._rows):
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

    def close(self, outcome: RunOutcome) -> Summary:
        self._review_filled()
        return summarise(self._review.figures(), outcome, self._plan.limits, "", self._seed)

    def _review_filled(self) -> None:
        self._review.add(np.frombuffer(bytes(self._rows[: self._filled]), ROW_DTYPE))
        self._filled = 0


class FolderRecorder:
    """Four rings and the process that drains them into the run's folder."""

    def __init__(self, plan: RecordingPlan) -> None:
        """See :func:`start_recording`."""
        self._folder = plan.folder
        on_full = refuse if plan.real_time else self._wait_for_logger
        self._rows = RingWriter(ROW, ROWS_CAPACITY, on_full)
        self._frames = RingWriter(FRAME, FRAMES_CAPACITY, on_full)
        self._events = RingWriter(EVENT, EVENTS_CAPACITY, on_full)
        self._faults = RingWriter(BLOCK, FAULTS_CAPACITY, on_full)
        self._keep_frames = plan.frames
        writer = RowWriter(self._rows, self._frames, plan.frames)
        self.record: Callable[[CycleRecord], None] = writer.record
        """See :meth:`Recorder.record`."""
        self.frame: Callable[[str, int, bytes, bool, bool, Instant], None] = writer.frame
        """See :meth:`Recorder.frame`."""
        self._logger = self._start_logger(plan)

    def tap(self, segment: int = 0) -> FrameTap:
        return RowWriter(self._rows, self._frames, self._keep_frames, segment)

    def begin(self, at: Instant) -> None:
        self._events.push(*event_fields(BeginEvent(at)))

    def event(self, at: Instant, level: str, text: str) -> None:
        self._events.push(*event_fields(TextEvent(at, level, text)))

    def state(self, at: Instant, track: str, label: str) -> None:
        self._events.push(*event_fields(StateEvent(at, track, label)))

    def identity(self, at: Instant, axis: str, text: str) -> None:
        self._events.push(*event_fields(IdentityEvent(at, axis, text)))

    def load(self, at: Instant, axis: str, torque_nm: float, speed_rad_s: float) -> None:
        self._events.push(*event_fields(LoadEvent(at, axis, torque_nm, speed_rad_s)))

    def fault_block(self, length: int, block: bytes) -> None:
        """A block of entries, of which ``length`` bytes are filled; fits ``FaultLog.send_to``."""
        self._faults.push(length, block)

    @property
    def logger_process_id(self) -> int:
        """Of the process that drains the rings."""
        return self._logger.pid

    def wait_ready(self) -> None:
        """Return when the logger is up and drains; before that the rings fill. Error: RecordingFailed."""
        assert self._logger.stdout is not None
        if not self._logger.stdout.readline():
            self._logger.wait()
            raise self._failure(f"the logger ended with status {self._logger.returncode}")

    def close(self, outcome: RunOutcome) -> Summary:
        answer = self._finish(json.dumps(asdict(outcome)))
        for ring in self._rings:
            ring.close()
        return Summary.from_json(json.loads(answer.splitlines()[-1]))

    def _finish(self, message: str) -> str:
        """Tell the logger how the run ended and wait for the summary that it prints."""
        try:
            answer, _ = self._logger.communicate(message + "\n", timeout=_FINISH_MAX_S)
        except subprocess.TimeoutExpired:
            self._logger.kill()
            self._logger.communicate()
            raise self._failure(f"the logger did not finish within {_FINISH_MAX_S:.0f} s") from None
        if self._logger.returncode != 0 or not answer:
            raise self._failure(f"the logger ended with status {self._logger.returncode}")
        return answer

    def _failure(self, summary: str) -> RecordingFailed:
        log = self._folder / _LOGGER_LOG
        lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
        return RecordingFailed(
            summary,
            evidence=lines[-1] if lines else "",
            remedy=f"{self._folder} holds what was written; rerun rrd optimize mends run.rrd",
        )

    @property
    def _rings(self) -> tuple[RingWriter, ...]:
        return self._rows, self._frames, self._events, self._faults

    def _wait_for_logger(self) -> bool:
        """Policy of a full ring in simulated time: wait as long as there is somebody to wait for."""
        if self._logger.poll() is not None:
            return False
        clock = MonotonicClock()
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
        return True

    def _start_logger(self, plan: RecordingPlan) -> subprocess.Popen[str]:
        descriptors = [ring.descriptor for ring in self._rings]
        with open(plan.folder / _LOGGER_LOG, "w") as log:
            logger = subprocess.Popen(
                python_command("hil.recording.logger", *map(str, descriptors)),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                pass_fds=descriptors,
                # a session of its own: an interrupt from the terminal is for the loop, not for the logger
                start_new_session=True,
                # Rerun's analytics are off wherever CI is set
                env=python_environment(CI="1"),
            )
        assert logger.stdin is not None
        logger.stdin.write(json.dumps(plan.as_json()) + "\n")
        logger.stdin.flush()
        return logger


def start_recording(plan: RecordingPlan) -> FolderRecorder:
    """Make the run's folder and rings and start the logger process.

    Error: BadInput if the folder cannot be made, or already holds something;
    RecordingFailed if the logger does not come up.
    """
    _make_folder(plan.folder)
    (plan.folder / _BENCH_FILE).write_text(plan.bench_toml)
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
        raise BadInput("--record", "", str(folder), "a folder that can be made", str(error)) from error
    if occupied:
        raise BadInput(
            "--record", "", str(folder), "a new or empty folder", "a recording is never overwritten"
        )
