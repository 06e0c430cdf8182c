"""Ends a recording that its logger could not end.

As a program, ``python -m hil.recording.recovery ROWS FRAMES EVENTS FAULTS``, it is given the descriptors of a
dead logger's rings, which still hold what that had not taken. On standard input comes one line of JSON: the
plan, the outcome of the run, and what ended the logger. Printed is the summary, one line of JSON.
:func:`recover` does the same for ``hil recover``, where no rings are left.
"""

import json
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
from pyarrow import ArrowInvalid

from drivers.timebase import Instant
from hil.recording.append_file import AppendFile
from hil.recording.candump import DIRECTION_BYTES
from hil.recording.faults_file import BLOCK_DTYPE, FaultEntries, FaultsKeeper
from hil.recording.log_files import EventsKeeper, FramesKeeper
from hil.recording.rerun_anew import write_rerun_anew
from hil.recording.ring import RingReader
from hil.recording.run_folder import Reserve, write_summary
from hil.recording.run_metadata import FIRST_CYCLE, run_metadata
from hil.recording.tail import FRAMES_TAIL_FILE, TAIL_FILE, read_tail
from hil.recording.telemetry import RERUN_FILE
from hil.reviewing.network_meter import NetworkKeeper
from hil.reviewing.review import Review
from hil.rows.recording_plan import RecordingPlan
from hil.rows.records import ROW_DTYPE, Rows
from hil.rows.records_file import (
    RECORDS_FILE,
    RecordsWriter,
    finish_records,
    read_metadata,
    read_records,
)
from hil.rows.run_files import DIRECTIONS_FILE, EVENTS_FILE, FRAMES_FILE, LOAD_FILE
from hil.rows.run_zero import RunZero
from hil.rows.side_rows import (
    EVENT_DTYPE,
    FRAME_DTYPE,
    BeginEvent,
    IdentityEvent,
    RunEvent,
    events_of,
)
from hil.verdict.plain_values import from_plain
from hil.verdict.summary import Summary, summarise
from hil.verdict.verdict import RunOutcome
from virtual_bus.faults.fault_log import FAULTS_FILE


class Rings:
    """What a dead logger had not taken."""

    def __init__(self, rows: int, frames: int, events: int, faults: int) -> None:
        """Descriptors."""
        rows_ring, frames_ring = RingReader(rows, ROW_DTYPE), RingReader(frames, FRAME_DTYPE)
        events_ring = RingReader(events, EVENT_DTYPE)
        self.rows_before = rows_ring.released
        """Rows of the run before :attr:`rows`."""
        self.rows, self.frames, self.events = (
            rows_ring.drain(),
            frames_ring.drain(),
            events_of(events_ring.drain()),
        )
        self.fault_blocks = RingReader(faults, BLOCK_DTYPE)
        self.refused = sum(ring.refused for ring in (rows_ring, frames_ring, events_ring, self.fault_blocks))


def recover(
    plan: RecordingPlan,
    outcome: RunOutcome,
    faults: Sequence[str],
    rings: Rings | None = None,
    planned: int | None = None,
) -> Summary:
    """Bring all that is there into the files of ``plan.folder``, and write the summary.

    ``faults``: why the recording is not whole. ``planned``: cycles, if some may be missing at the end.
    Error: OSError; BlockingIOError while a logger still records.
    """
    folder = plan.folder
    assert folder is not None
    reserve = Reserve(folder)
    for name in (FRAMES_FILE, DIRECTIONS_FILE, EVENTS_FILE, LOAD_FILE, FAULTS_FILE):
        if (folder / name).exists():
            AppendFile(folder / name, fresh=False).close()
    _as_many_directions(folder)
    told = [*faults]
    if plan.frames:
        told += _keep_frames(plan, folder, rings)
    told += _keep_events(plan, folder, rings)
    if rings is not None:
        told += _keep_faults(plan, folder, rings)
    told += whole_records(plan, folder, rings)
    review = Review(plan.review)
    network = NetworkKeeper(folder, plan.period_us, len(plan.review.axes)) if plan.period_us else None
    zero = _first_cycle(plan, folder / RECORDS_FILE, rings)
    for rows in read_records(folder / RECORDS_FILE, zero.at):
        review.add(rows)
        if network is not None:
            network.take(rows, np.empty(0, FRAME_DTYPE), [])
    figures = review.figures()
    if planned is not None and figures.cycles < planned:
        told.append(f"{figures.cycles} of {planned} planned cycles are recorded")

    def summed_up() -> Summary:
        return summarise(figures, outcome, plan.review.limits, str(folder), plan.seed, tuple(told))

    reserve.release()
    if network is not None:
        network.finish(summed_up())
    try:
        write_rerun_anew(plan, summed_up(), review)
    except OSError as error:
        told.append(f"{RERUN_FILE} has no verdict and may lack the last seconds: {error}")
    reserve.close()
    write_summary(folder, summed_up())
    return summed_up()


def _keep_events(plan: RecordingPlan, folder: Path, rings: Rings | None) -> list[str]:
    """Events that the logger had not taken, all in run time; why some are missing.

    The logger may have come to know the first cycle later of the events than of the records.
    """
    zero = _first_cycle(plan, folder / RECORDS_FILE, rings)
    counted = zero if _counts_from_the_first_cycle(folder / EVENTS_FILE) else None
    events: list[RunEvent] = [] if rings is None else list(rings.events)
    if zero.told and counted is None and not any(isinstance(event, BeginEvent) for event in events):
        events.insert(0, BeginEvent(zero.at))
    try:
        keeper = EventsKeeper(plan, folder, counted, fresh=False)
        keeper.take(np.empty(0, ROW_DTYPE), np.empty(0, FRAME_DTYPE), events)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:  # a line may be anything
        return [f"{EVENTS_FILE} is not in run time: {error}"]
    return []


def _keep_faults(plan: RecordingPlan, folder: Path, rings: Rings) -> list[str]:
    """What was injected and the logger had not taken; why some of it is missing."""
    told = [f"{rings.refused} rows lost after the logger had ended"] if rings.refused else []
    entries = FaultEntries(rings.fault_blocks, plan.started_at)
    entries.take(_first_cycle(plan, folder / RECORDS_FILE, rings), at_end=True)
    try:
        if plan.faults:
            keeper = FaultsKeeper(folder, entries, fresh=False)
            keeper.take(np.empty(0, ROW_DTYPE), rings.frames, rings.events)
    except OSError as error:
        told.append(f"{FAULTS_FILE} ends before the run: {error.strerror}")
    return told


def _keep_frames(plan: RecordingPlan, folder: Path, rings: Rings | None) -> list[str]:
    """Frames that the logger had not written, and those that it had not taken; why some are missing."""
    tail, frames = folder / FRAMES_TAIL_FILE, folder / FRAMES_FILE
    stored = frames.read_bytes().count(b"\n") if frames.exists() else 0
    held = read_tail(tail, FRAME_DTYPE, stored)
    try:
        keeper = FramesKeeper(plan, folder, _first_cycle(plan, folder / RECORDS_FILE, rings), fresh=False)
        keeper.take(
            np.empty(0, ROW_DTYPE), held if rings is None else np.concatenate((held, rings.frames)), []
        )
        keeper.write_rest()
    except OSError as error:
        return [f"{FRAMES_FILE} ends before the run: {error.strerror}"]
    tail.unlink(missing_ok=True)
    return []


def _as_many_directions(folder: Path) -> None:
    """A frame's direction is written before the frame: what is beyond the last frame goes."""
    frames, directions = folder / FRAMES_FILE, folder / DIRECTIONS_FILE
    if frames.exists() and directions.exists():
        with frames.open("rb") as lines:
            count = sum(1 for _ in lines)
        os.truncate(directions, count * DIRECTION_BYTES)


def _first_cycle(plan: RecordingPlan, records: Path, rings: Rings | None) -> RunZero:
    """By the head of records.arrow, else by the events that nobody has taken."""
    zero = RunZero(plan.started_at)
    metadata = read_metadata(records) if records.exists() else {}
    if metadata:
        zero.at, zero.told = Instant(int(metadata[FIRST_CYCLE])), True
    elif rings is not None:
        zero.look(rings.events)
    return zero


def _counts_from_the_first_cycle(events: Path) -> bool:
    return events.exists() and b'"begin": true' in events.read_bytes()


def whole_records(plan: RecordingPlan, folder: Path, rings: Rings | None = None) -> list[str]:
    """records.arrow with all rows that are anywhere, and with its end; why some are missing."""
    path = folder / RECORDS_FILE
    zero = _first_cycle(plan, path, rings)
    if not path.exists() or not read_metadata(path):  # the logger had not come so far
        identities = [] if rings is None else [one for one in rings.events if isinstance(one, IdentityEvent)]
        writer = RecordsWriter(path)
        writer.begin(run_metadata(plan, zero.at, {one.axis: one.text for one in identities}), zero.at)
        writer.close()
    stored = sum(rows.size for rows in read_records(path))
    more: list[Rows] = [tail for tail in [read_tail(folder / TAIL_FILE, ROW_DTYPE, stored)] if tail.size]
    known = stored + sum(rows.size for rows in more)
    told = []
    if rings is not None and rings.rows.size:
        if rings.rows_before > known:
            told.append(f"{rings.rows_before - known} cycle records lost with the logger")
        more.append(rings.rows[max(0, known - rings.rows_before) :])
    try:
        if more:
            _rewrite(path, more, zero.at)
        else:
            finish_records(path)
    except (OSError, ArrowInvalid) as error:
        with suppress(OSError):
            finish_records(path)
        lacking = sum(rows.size for rows in more)
        return [*told, f"{RECORDS_FILE} lacks {lacking} rows, {TAIL_FILE} may have them: {error}"]
    (folder / TAIL_FILE).unlink(missing_ok=True)
    return told


def _rewrite(path: Path, more: Sequence[Rows], zero: Instant) -> None:
    """``path`` with more rows, on the bench clock, behind those that it has.

    Error: OSError, or ArrowInvalid for rows that cannot be; it is as it was then.
    """
    part = path.with_name(f"{path.name}.part")
    writer = RecordsWriter(part)
    try:
        writer.begin(read_metadata(path), zero)
        for rows in chain(read_records(path, zero), more):
            writer.write(rows)
        writer.close()
        part.replace(path)
    except (OSError, ArrowInvalid):
        writer.drop()  # a file that is open keeps its room on the disk
        part.unlink(missing_ok=True)
        raise


def main() -> int:
    """Entry point of the process."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    wanted = json.loads(sys.stdin.readline())
    plan, outcome = from_plain(RecordingPlan, wanted["plan"]), from_plain(RunOutcome, wanted["outcome"])
    rings = Rings(*(int(argument) for argument in sys.argv[1:5]))
    summary = recover(plan, outcome, [wanted["trouble"]], rings)
    print(json.dumps(summary.as_json()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
