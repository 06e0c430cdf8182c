"""Drains a run's rings into its folder: ``python -m servobench.hil.recording.logger ROWS FRAMES EVENTS
FAULTS``.

The arguments are the descriptors of the four rings. On standard input come lines: the recording plan at once
(JSON), "confirm" any number of times, the outcome when the run ends (JSON). If the input ends without an
outcome, the writer died; the rings still hold what it had stored, and the recording is finished with a
verdict that says so. Printed are the line "ready" when the logger drains, "stored" when what was there at a
"confirm" is in the files, "failed" and why as soon as a file cannot be written, and at the end the summary,
one line of JSON.

Keepers of a run, as its plan asks for them.
"""

import json
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.machine.extras import is_installed
from servobench.hil.recording.log_files import (
    LIVE_VIEW,
    EventsKeeper,
    FaultsKeeper,
    FramesKeeper,
    Keeper,
    LoadKeeper,
    NetworkKeeper,
    RecordsKeeper,
)
from servobench.hil.recording.logger_process import CONFIRM, FAILED, READY, STORED, LineReader
from servobench.hil.recording.recovery import whole_records
from servobench.hil.recording.ring import RingReader
from servobench.hil.recording.run_metadata import Reserve, write_summary
from servobench.hil.recording.sealer import Sealer
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import BLOCK_DTYPE, FaultEntries, InjectedFaults, RunZero
from servobench.hil.rows.faults_file import finish_faults
from servobench.hil.rows.frames_file import finish_frames
from servobench.hil.rows.recording_plan import RecordingPlan, SetPointTeller
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.run_files import (
    BENCH_FILE,
    EVENTS_FILE,
    FAULTS_FILE,
    FRAMES_FILE,
    INDEX_FILE,
    LOAD_FILE,
    RECORDS_FILE,
    SEAL_FILE,
    SUMMARY_FILE,
)
from servobench.hil.rows.side_rows import EVENT_DTYPE, FRAME_DTYPE, RunEvent, events_of
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary, summarise
from servobench.hil.verdict.verdict import RunOutcome


def open_keepers(plan: RecordingPlan, review: Review, entries: FaultEntries) -> list[Keeper]:
    """Everything that the plan asks for; nothing without a folder.

    ``review``: of the run, for its pages; ``entries``: of its fault log.
    """
    if plan.folder is None:
        return []
    keepers: list[Keeper] = [
        RecordsKeeper(plan, plan.folder),
        EventsKeeper(plan, plan.folder),
        LoadKeeper(plan, plan.folder),
    ]
    if plan.frames:
        keepers.append(FramesKeeper(plan, plan.folder))
    if plan.faults:
        keepers.append(FaultsKeeper(plan.folder, entries))
    if plan.period_us:
        keepers.append(NetworkKeeper(plan.folder, review))
    # last, so that on a full disk what is kept for the end is not Rerun's
    if is_installed("rerun"):
        from servobench.hil.recording.page_keepers import open_pages

        keepers += open_pages(plan, plan.folder, review)
    return keepers


_MOVING_S, _KEPT_S, _UNKEPT_S = 0.1, 0.2, 1.0
"""Time between two drains; one costs some milliseconds of a processor however few the rows. So often a live
view moves, and rings are emptied that simulated time fills fast. In real time so much is missing in the files
if all processes of a run are killed, and nothing where none are kept; the ring of rows holds two seconds of
three axes at 10 kHz."""
_FLUSH_PERIOD_NS = NS_PER_S
_BUSY_ROWS = 2_000
"""A drain that finds more than this is followed by the next one at once: simulated time is fast."""
_GROWING = (
    BENCH_FILE, RECORDS_FILE, EVENTS_FILE, FRAMES_FILE, INDEX_FILE, FAULTS_FILE, LOAD_FILE,
)  # fmt: skip
"""Files that are sealed while they grow; the others are written at the end."""
_ENDS: Final[dict[str, Callable[[Path], None]]] = {FRAMES_FILE: finish_frames, FAULTS_FILE: finish_faults}
"""What gives a file its end, beside that of the records."""
_WRITER_DIED = RunOutcome(completed=False, reason="the process of the loop died")


def drain_period_s(plan: RecordingPlan) -> float:
    """Time between two drains of the rings."""
    if not plan.real_time or plan.view or plan.served is not None:
        return _MOVING_S
    return _UNKEPT_S if plan.folder is None else _KEPT_S


class Logger:
    """Owns the readers' ends of the rings, the review, and everything that keeps something."""

    def __init__(
        self,
        plan: RecordingPlan,
        rows: int,
        frames: int,
        events: int,
        faults: int,
        *,
        tell: Callable[[str], None] = lambda line: None,
    ) -> None:
        """``rows``, ``frames``, ``events``, ``faults``: descriptors of the rings; ``tell``: to the writer.

        Error: OSError if the files cannot be opened, or there is no room for their end.
        """
        self._plan = plan
        self._tell = tell
        self._rows = RingReader(rows, ROW_DTYPE)
        self._frames = RingReader(frames, FRAME_DTYPE)
        self._events = RingReader(events, EVENT_DTYPE)
        self._review = Review(plan.review)
        self._faults: list[str] = []
        self._reserve = None if plan.folder is None else Reserve(plan.folder)
        self._sealer = None if plan.folder is None else Sealer(plan.folder)
        self._fault_entries = FaultEntries(plan.started_at)
        self._keepers: list[Keeper] = open_keepers(plan, self._review, self._fault_entries)
        self._given_up: list[Keeper] = []
        """Kept alive: a stream of Rerun's whose file cannot be written waits for ever when it is let go."""
        self._ending = False
        """What is kept for the end is given back."""
        self._zero = RunZero(plan.started_at)
        self._set_points = SetPointTeller(plan.set_points)
        self._injected = InjectedFaults()
        self._until = plan.started_at
        """End of the known past, on the bench's clock."""
        self._fault_blocks = RingReader(faults, BLOCK_DTYPE)
        self._clock = MonotonicClock()
        self._flushed_at = self._clock.now()

    def run(self, source: LineReader) -> Summary:
        """Drain until the outcome comes, or the writer is gone; then finish."""
        outcome: RunOutcome | None = None
        period_s = drain_period_s(self._plan)
        wait_s = period_s
        while outcome is None and not source.ended:
            line = source.line(wait_s)
            if line == CONFIRM:
                self._confirm()
            elif line is not None:
                outcome = from_plain(RunOutcome, json.loads(line))
            wait_s = 0.0 if self._drain() > _BUSY_ROWS else period_s
            if self._clock.now() - self._flushed_at >= _FLUSH_PERIOD_NS:
                self._flush()
        self._drain(at_end=True)
        return self._finish(outcome or _WRITER_DIED)

    def _confirm(self) -> None:
        self._drain()
        self._flush()
        if not self._faults:
            self._tell(STORED)

    def _drain(self, at_end: bool = False) -> int:
        """Take all that is there; the number of cycle rows."""
        rows, frames, events = self._rows.look(), self._frames.drain(), events_of(self._events.drain())
        self._zero.look(events)
        self._review.add(rows)
        instants = [event.at for event in events] + rows["due_at"][-1:].tolist()
        self._until = max([self._until, *instants])
        told = [*events, *self._told_by(rows, at_end), *self._review.take_events()]
        events = sorted(told, key=lambda event: event.at)
        self._for_each(lambda keeper: keeper.take(rows, frames, events))
        self._rows.release()
        return rows.size

    def _told_by(self, rows: Rows, at_end: bool) -> list[RunEvent]:
        """Return the events that only the rows of the cycles and the entries of the fault log show."""
        told: list[RunEvent] = [*self._set_points.take(rows, self._zero.at)]
        entries = self._fault_entries.take(self._fault_blocks.drain(), self._zero, at_end)
        told += self._injected.take(entries, self._zero.at)
        told += self._injected.ended(self._until)
        if at_end:
            told += self._injected.finish()
        return told

    def _flush(self) -> None:
        self._flushed_at = self._clock.now()
        self._for_each(lambda keeper: keeper.flush())
        left_out = {keeper.name for keeper in self._given_up}
        if not self._zero.told:
            left_out.add(EVENTS_FILE)  # which is written anew with the first cycle
        self._seal(
            lambda sealer: sealer.grow([name for name in _GROWING if name not in left_out], self._stored)
        )

    @property
    def _stored(self) -> int:
        return max((keeper.stored for keeper in [*self._keepers, *self._given_up]), default=0)

    def _seal(self, act: Callable[[Sealer], None]) -> None:
        """Without a folder there is nothing to seal, and a seal that failed is given up."""
        try:
            if self._sealer is not None:
                act(self._sealer)
        except OSError as error:
            self._sealer = None
            self._note(f"{SEAL_FILE} is incomplete: {error}")

    def _finish(self, outcome: RunOutcome) -> Summary:
        for one, more, ring in (
            ("cycle record", "cycle records", self._rows),
            ("frame", "frames", self._frames),
            ("event", "events", self._events),
            ("block of injected faults", "blocks of injected faults", self._fault_blocks),
        ):
            if count := ring.refused:
                self._note(f"{count} {more if count > 1 else one} lost, the logger was too slow")
        self._flush()  # who waits for room on a full disk must not take what is kept for the end
        self._release()
        self._for_each(lambda keeper: keeper.finish(self._summary(outcome)))
        if self._plan.folder is not None:
            self._end_summary(self._plan.folder, outcome)
        return self._summary(outcome)

    def _release(self) -> None:
        """Give back what is kept for the end: first of all for the ends of files that were given up."""
        self._ending = True
        if self._reserve is not None:
            self._reserve.release()
        for keeper in self._given_up:
            self._end_file_of(keeper)

    def _end_file_of(self, keeper: Keeper) -> None:
        """Make a file whole that could not be written to its end."""
        folder = self._plan.folder
        with suppress(OSError):  # that it is incomplete is told already
            if folder is None:
                return
            if keeper.name == RECORDS_FILE:
                for fault in whole_records(self._plan, folder):
                    self._note(fault)
            elif keeper.name in _ENDS:
                _ENDS[keeper.name](folder / keeper.name)

    def _end_summary(self, folder: Path, outcome: RunOutcome) -> None:
        if self._reserve is not None:
            self._reserve.close()
        try:
            write_summary(folder, self._summary(outcome))
        except OSError as error:
            self._note(f"{SUMMARY_FILE}: {error.strerror}")
        self._seal(lambda sealer: sealer.finish(self._stored))

    def _summary(self, outcome: RunOutcome) -> Summary:
        return summarise(
            self._review.figures(),
            outcome,
            self._plan.review.limits,
            str(self._plan.folder or ""),
            self._plan.seed,
            tuple(self._faults),
        )

    def _for_each(self, act: Callable[[Keeper], None]) -> None:
        """One file that cannot be written does not end the others; its keeper is given up."""
        for keeper in list(self._keepers):
            try:
                act(keeper)
            except OSError as error:
                self._keepers.remove(keeper)
                self._given_up.append(keeper)
                keeper.abandon()
                if keeper.name != LIVE_VIEW:
                    self._note(f"{keeper.name} is incomplete: {error}")
                if self._ending:
                    self._end_file_of(keeper)

    def _note(self, fault: str) -> None:
        self._faults.append(fault)
        self._tell(FAILED + " ".join(fault.split()))


def main() -> int:
    """Entry point of the process; the status of one that could not begin."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # The writer says when to end; if it is ended itself, the input ends too.
        signal.signal(number, signal.SIG_IGN)
    sys.meta_path.insert(0, _WithoutPandas())
    # Started by a real-time loop, it must not compete with it
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    descriptors = [int(argument) for argument in sys.argv[1:5]]
    source = LineReader(sys.stdin.fileno())
    line = None
    while line is None and not source.ended:
        line = source.line(_MOVING_S)
    if line is None:
        return 1
    try:
        logger = Logger(from_plain(RecordingPlan, json.loads(line)), *descriptors, tell=_tell)
    except OSError as error:
        _tell(f"{FAILED}{error}")
        return 1
    _tell(READY)
    summary = logger.run(source)
    _tell(json.dumps(summary.as_json()))
    # not by the interpreter's end, which lets go of all that Rerun holds: see Logger._given_up
    os._exit(0)


class _WithoutPandas(MetaPathFinder):
    """pyarrow imports an installed pandas to know its objects: a third of a second in each run, for none."""

    def find_spec(self, fullname: str, *_: object) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError("the logger does without it", name=fullname)


def _tell(line: str) -> None:
    try:
        print(line, flush=True)
    except BrokenPipeError:
        """The writer died; what was recorded is finished all the same."""


if __name__ == "__main__":
    sys.exit(main())
