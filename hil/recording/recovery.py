"""Ends a recording that its logger could not end.

As a program, ``python -m servobench.hil.recording.recovery ROWS FRAMES EVENTS FAULTS``, it is given the
descriptors of a dead logger's rings, which still hold what that had not taken. On standard input comes one
line of JSON: the plan, the outcome of the run, and what ended the logger. Printed is the summary, one line of
JSON. :func:`recover` does the same for ``hil recover``, where no rings are left.

records.arrow made whole: with the rows that its logger could not write, and with its end.
"""

import json
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from pyarrow import ArrowInvalid

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.machine.extras import is_installed
from servobench.hil.recording.append_file import (
    FAULTS_TAIL_FILE,
    FRAMES_TAIL_FILE,
    TAIL_FILE,
    AppendFile,
    read_tail,
)
from servobench.hil.recording.frame_files import FrameOrder, append_frames
from servobench.hil.recording.log_files import EventsKeeper, NetworkKeeper
from servobench.hil.recording.ring import RingReader
from servobench.hil.recording.run_metadata import Reserve, run_metadata, write_summary
from servobench.hil.recording.sealer import Sealer
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import BLOCK_DTYPE, ENTRY_DTYPE, FaultEntries, RunZero
from servobench.hil.rows.faults_file import append_faults, read_entries
from servobench.hil.rows.frames_file import read_batches
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import RecordsWriter, finish_records, read_metadata, read_records
from servobench.hil.rows.run_files import (
    EVENTS_FILE,
    FAULTS_FILE,
    FAULTS_LOG,
    FIRST_CYCLE,
    FRAMES_FILE,
    FRAMES_LOG,
    LOAD_FILE,
    RECORDS_FILE,
    RERUN_FILE,
    SEAL_FILE,
)
from servobench.hil.rows.seal import RECOVERED, has_seal
from servobench.hil.rows.side_rows import EVENT_DTYPE, FRAME_DTYPE, BeginEvent, RunEvent, drives_of, events_of
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary, summarise
from servobench.hil.verdict.verdict import RunOutcome


class Rings:
    """Rings' contents that a dead logger had not taken."""

    def __init__(self, rows: int, frames: int, events: int, faults: int) -> None:
        """Descriptors."""
        rows_ring, frames_ring = RingReader(rows, ROW_DTYPE), RingReader(frames, FRAME_DTYPE)
        events_ring, faults_ring = RingReader(events, EVENT_DTYPE), RingReader(faults, BLOCK_DTYPE)
        self.rows_before = rows_ring.released
        """Rows of the run before :attr:`rows`."""
        self.rows, self.frames = rows_ring.drain(), frames_ring.drain()
        self.events = events_of(events_ring.drain())
        self.fault_blocks = faults_ring.drain()
        self.refused = sum(ring.refused for ring in (rows_ring, frames_ring, events_ring, faults_ring))


def first_cycle(plan: RecordingPlan, records: Path, rings: Rings | None) -> RunZero:
    """By the head of records.arrow, else by the events that nobody has taken."""
    zero = RunZero(plan.started_at)
    metadata = read_metadata(records) if records.exists() else {}
    if metadata:
        zero.at, zero.told = Instant(int(metadata[FIRST_CYCLE])), True
    elif rings is not None:
        zero.look(rings.events)
    return zero


def whole_records(plan: RecordingPlan, folder: Path, rings: Rings | None = None) -> list[str]:
    """records.arrow with all rows that are anywhere, and with its end; why some are missing."""
    path = folder / RECORDS_FILE
    zero = first_cycle(plan, path, rings)
    if not path.exists() or not read_metadata(path):  # the logger had not come so far
        writer = RecordsWriter(path)
        writer.begin(run_metadata(plan, zero.at, drives_of(rings.events if rings else ())), zero.at)
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
        writer.begin(read_metadata(path), zero, path)
        writer.copy(path)  # as its seal has it
        for rows in more:
            writer.write(rows)
        writer.close()
        part.replace(path)
    except (OSError, ArrowInvalid):
        writer.drop()  # a file that is open keeps its room on the disk
        part.unlink(missing_ok=True)
        raise


_NO_SEAL: Final = "it has no seal: whether its files are as they were recorded is not known"


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
    for name in (EVENTS_FILE, LOAD_FILE, FAULTS_LOG):
        if (folder / name).exists():
            AppendFile(folder / name, fresh=False).close()
    told = [*faults]
    if plan.frames:
        told += _keep_frames(plan, folder, rings)
    told += _keep_events(plan, folder, rings)
    told += _keep_faults(plan, folder, rings)
    told += whole_records(plan, folder, rings)
    review = Review(plan.review)
    network = NetworkKeeper(folder, review) if plan.period_us else None
    zero = first_cycle(plan, folder / RECORDS_FILE, rings)
    for rows in read_records(folder / RECORDS_FILE, zero.at):
        review.add(rows)
    figures = review.figures()
    if planned is not None and figures.cycles < planned:
        told.append(f"{figures.cycles} of {planned} planned cycles are recorded")

    def summed_up() -> Summary:
        return summarise(figures, outcome, plan.review.limits, str(folder), plan.seed, tuple(told))

    if not (folder / SEAL_FILE).exists() and has_seal(read_metadata(folder / RECORDS_FILE)):
        told.append(_NO_SEAL)
    reserve.release()
    if network is not None:
        network.finish(summed_up())
    try:
        if is_installed("rerun"):
            from servobench.hil.recording.rerun_anew import write_rerun_anew

            write_rerun_anew(plan, summed_up(), review)
    except OSError as error:
        told.append(f"{RERUN_FILE} has no verdict and may lack the last seconds: {error}")
    reserve.close()
    write_summary(folder, summed_up())
    _seal(folder, figures.cycles * len(plan.review.axes), recovered=rings is None)
    return summed_up()


def _seal(folder: Path, rows: int, *, recovered: bool) -> None:
    """The rest; ``recovered``: by a process that has not seen it recorded, which the seal then says.

    A damaged seal stays as it is, to be told, and where there is none, none is made: what was altered would
    be sealed with the rest. Error: OSError.
    """
    if (folder / SEAL_FILE).exists():
        with suppress(BadInput):
            sealer = Sealer(folder, fresh=False)
            if recovered:
                sealer.mark(RECOVERED)
            sealer.finish(rows)


def _keep_events(plan: RecordingPlan, folder: Path, rings: Rings | None) -> list[str]:
    """Events that the logger had not taken, all in run time; why some are missing.

    The logger may have come to know the first cycle later of the events than of the records.
    """
    zero = first_cycle(plan, folder / RECORDS_FILE, rings)
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


def _keep_faults(plan: RecordingPlan, folder: Path, rings: Rings | None) -> list[str]:
    """Injected faults that the logger had not written, and those that it had not taken; why some are
    missing."""
    refused = 0 if rings is None else rings.refused
    told = [f"{refused} rows lost after the logger had ended"] if refused else []
    path, tail = folder / FAULTS_FILE, folder / FAULTS_TAIL_FILE
    if not plan.faults or ((folder / FAULTS_LOG).exists() and not path.exists()):
        return told  # of an earlier format the lines are whole
    entries = FaultEntries(plan.started_at)
    if rings is not None:
        entries.take(rings.fault_blocks, first_cycle(plan, folder / RECORDS_FILE, rings), at_end=True)
    try:
        stored = sum(batch.size for batch in read_entries(path)) if path.exists() else 0
        append_faults(path, np.concatenate((read_tail(tail, ENTRY_DTYPE, stored), entries.fresh)))
    except OSError as error:
        return [*told, f"{FAULTS_FILE} ends before the run: {error.strerror}"]
    tail.unlink(missing_ok=True)
    return told


def _keep_frames(plan: RecordingPlan, folder: Path, rings: Rings | None) -> list[str]:
    """Frames that the logger had not written, and those that it had not taken; why some are missing."""
    path, tail = folder / FRAMES_FILE, folder / FRAMES_TAIL_FILE
    if (folder / FRAMES_LOG).exists() and not path.exists():
        return []  # of an earlier format, whose lines are whole
    zero = first_cycle(plan, folder / RECORDS_FILE, rings)
    try:
        stored = sum(batch.frames.size for batch in read_batches(path)) if path.exists() else 0
        held = read_tail(tail, FRAME_DTYPE, stored)
        more = held if rings is None else np.concatenate((held, rings.frames))
        order = FrameOrder(len(plan.interfaces))
        ready = np.concatenate((order.take(more), order.rest()))
        append_frames(path, plan.interfaces, ready, plan.stamp_offset(zero.at))
    except OSError as error:
        return [f"{FRAMES_FILE} ends before the run: {error.strerror}"]
    tail.unlink(missing_ok=True)
    return []


def _counts_from_the_first_cycle(events: Path) -> bool:
    return events.exists() and b'"begin": true' in events.read_bytes()


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
