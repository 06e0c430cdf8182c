"""Drains a run's rings into its folder: ``python -m hil.recording.logger ROWS FRAMES EVENTS FAULTS``.

The arguments are the descriptors of the four rings. On standard input come two lines of
JSON: the recording plan at once, the outcome when the run ends. If the input ends without an
outcome, the writer died; the rings still hold what it had stored, and the recording is
finished with a verdict that says so. Printed are the line "ready" when the logger drains, and at
the end the summary, one line of JSON.
"""

import json
import os
import select
import signal
import sys
from dataclasses import replace

import rerun as rr

from drivers.timebase import NS_PER_S, MonotonicClock
from hil.figures.review import Review
from hil.figures.summary import RunOutcome, Summary, summarise
from hil.recording.faults_file import BLOCK_DTYPE, FaultEntries, FaultsKeeper
from hil.recording.injected_faults import InjectedFaults
from hil.recording.log_files import Keeper, open_keepers
from hil.recording.recording_plan import RecordingPlan
from hil.recording.records import ROW_DTYPE, Rows
from hil.recording.ring import RingReader
from hil.recording.run_zero import RunZero
from hil.recording.set_points import SetPointTeller
from hil.recording.side_rows import EVENT_DTYPE, FRAME_DTYPE, RunEvent, events_of

_DRAIN_PERIOD_S = 0.1
_FLUSH_PERIOD_NS = NS_PER_S
_BUSY_ROWS = 2_000
"""A drain that finds more than this is followed by the next one at once: simulated time is fast."""
_WRITER_DIED = RunOutcome(
    bus_load_percent=0.0, realtime_factor=0.0, completed=False, reason="the process of the loop died"
)
SUMMARY_FILE = "summary.json"
READY = "ready"


class Input:
    """Standard input by lines, without waiting; the interpreter's own buffer would hide what has come."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._held = b""
        self.ended = False

    def line(self, timeout_s: float) -> str | None:
        """The next whole line; None if it has not come in time, or never will."""
        if (
            b"\n" not in self._held
            and not self.ended
            and select.select([self._descriptor], [], [], timeout_s)[0]
        ):
            found = os.read(self._descriptor, 1 << 16)
            self.ended = not found
            self._held += found
        line, separator, rest = self._held.partition(b"\n")
        if not separator:
            return None
        self._held = rest
        return line.decode()


class Logger:
    """Owns the readers' ends of the rings, the review, and everything that keeps something."""

    def __init__(
        self, plan: RecordingPlan, rows: int, frames: int, events: int, faults: int | None = None
    ) -> None:
        """``rows``, ``frames``, ``events``, ``faults``: descriptors of the rings."""
        self._plan = plan
        self._rows = RingReader(rows, ROW_DTYPE)
        self._frames = RingReader(frames, FRAME_DTYPE)
        self._events = RingReader(events, EVENT_DTYPE)
        self._review = Review(plan.review)
        self._faults: list[str] = []
        self._keepers: list[Keeper] = open_keepers(plan, self._review.delay)
        self._zero = RunZero(plan.started_at)
        self._set_points = SetPointTeller(plan.set_points)
        self._injected = InjectedFaults()
        self._fault_entries: FaultEntries | None = None
        self._fault_blocks: RingReader | None = None
        if faults is not None:
            self._fault_blocks = RingReader(faults, BLOCK_DTYPE)
            self._fault_entries = FaultEntries(self._fault_blocks, plan.started_at)
            if plan.faults:
                self._keepers.append(FaultsKeeper(plan, self._fault_entries))
        self._clock = MonotonicClock()
        self._flushed_at = self._clock.now()

    def run(self, source: Input) -> Summary:
        """Drain until the outcome comes, or the writer is gone; then finish."""
        outcome: RunOutcome | None = None
        wait_s = _DRAIN_PERIOD_S
        while outcome is None and not source.ended:
            line = source.line(wait_s)
            if line is not None:
                outcome = RunOutcome(**json.loads(line))
            wait_s = 0.0 if self._drain() > _BUSY_ROWS else _DRAIN_PERIOD_S
            if self._clock.now() - self._flushed_at >= _FLUSH_PERIOD_NS:
                self._flush()
        self._drain(at_end=True)
        return self._finish(outcome or _WRITER_DIED)

    def _drain(self, at_end: bool = False) -> int:
        """Take all that is there; the number of cycle rows."""
        rows, frames, events = self._rows.drain(), self._frames.drain(), events_of(self._events.drain())
        self._zero.look(events)
        events = sorted([*events, *self._told_by(rows, at_end)], key=lambda event: event.at)
        self._review.add(rows)
        for keeper in list(self._keepers):
            try:
                keeper.take(rows, frames, events)
            except OSError as error:
                self._give_up(keeper, error)
        return rows.size

    def _told_by(self, rows: Rows, at_end: bool) -> list[RunEvent]:
        """What nobody says, but the rows of the cycles and the entries of the fault log show."""
        told: list[RunEvent] = [*self._set_points.take(rows, self._zero.at)]
        if self._fault_entries is not None:
            told += self._injected.take(self._fault_entries.take(self._zero, at_end), self._zero.at)
        if at_end:
            told += self._injected.finish()
        return told

    def _flush(self) -> None:
        self._flushed_at = self._clock.now()
        for keeper in list(self._keepers):
            try:
                keeper.flush()
            except OSError as error:
                self._give_up(keeper, error)

    def _finish(self, outcome: RunOutcome) -> Summary:
        self._note_refused("cycle record", self._rows.refused)
        self._note_refused("frame", self._frames.refused)
        self._note_refused("event", self._events.refused)
        if self._fault_blocks is not None:
            self._note_refused("block of injected faults", self._fault_blocks.refused)
        if self._rows.refused and outcome.completed:
            # the figures would rest on less than the run
            outcome = replace(outcome, completed=False, reason="cycle records were lost")
        summary = self._summary(outcome)
        for keeper in list(self._keepers):
            try:
                keeper.finish(summary)
            except OSError as error:
                self._give_up(keeper, error)
        summary = self._summary(outcome)
        try:
            text = json.dumps(summary.as_json(), indent=2) + "\n"
            (self._plan.folder / SUMMARY_FILE).write_text(text)
        except OSError as error:
            self._faults.append(f"{SUMMARY_FILE}: {error}")
        return self._summary(outcome)

    def _summary(self, outcome: RunOutcome) -> Summary:
        return summarise(
            self._review.figures(),
            outcome,
            self._plan.review.limits,
            str(self._plan.folder),
            self._plan.seed,
            tuple(self._faults),
        )

    def _note_refused(self, what: str, count: int) -> None:
        if count:
            self._faults.append(f"{count} {what}{'s' if count > 1 else ''} lost, the logger was too slow")

    def _give_up(self, keeper: Keeper, error: OSError) -> None:
        """One file that cannot be written does not end the others, nor the run."""
        self._keepers.remove(keeper)
        self._faults.append(f"{keeper.name} is incomplete: {error}")


def main() -> int:
    """Entry point of the process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # The writer says when to end; if it is ended itself, the input ends too.
        signal.signal(number, signal.SIG_IGN)
    # Started by a real-time loop, it must not compete with it
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    rr.set_strict_mode(True)
    descriptors = [int(argument) for argument in sys.argv[1:5]]
    source = Input(sys.stdin.fileno())
    line = None
    while line is None and not source.ended:
        line = source.line(_DRAIN_PERIOD_S)
    if line is None:
        return 1
    try:
        logger = Logger(RecordingPlan.from_json(json.loads(line)), *descriptors)
    except OSError as error:
        print(error, file=sys.stderr)
        return 1
    print(READY, flush=True)
    summary = logger.run(source)
    print(json.dumps(summary.as_json()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
