"""Ends a recording that its logger could not end.

As a program, ``python -m servobench.hil.recording.recovery ROWS FRAMES EVENTS FAULTS``, it is given the
descriptors of a dead logger's rings, which still hold what that had not taken. On standard input comes one
line of JSON: the plan, the outcome of the run, and what ended the logger. Printed is the summary, one line of
JSON. :func:`recover` does the same for ``hil recover``, where no rings are left.
"""

import json
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from servobench.drivers.errors import BadInput
from servobench.hil.machine.extras import is_installed
from servobench.hil.recording.append_file import FRAMES_TAIL_FILE, AppendFile, read_tail
from servobench.hil.recording.frame_files import FrameOrder, append_frames
from servobench.hil.recording.log_files import EventsKeeper, FaultsKeeper, NetworkKeeper
from servobench.hil.recording.run_folder import Reserve, write_summary
from servobench.hil.recording.sealer import Sealer
from servobench.hil.recording.whole_records import Rings, first_cycle, whole_records
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import FaultEntries
from servobench.hil.rows.frames_file import read_batches
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.run_files import (
    EVENTS_FILE,
    FRAMES_FILE,
    FRAMES_LOG,
    LOAD_FILE,
    RECORDS_FILE,
    RERUN_FILE,
    SEAL_FILE,
)
from servobench.hil.rows.seal import RECOVERED, has_seal
from servobench.hil.rows.side_rows import FRAME_DTYPE, BeginEvent, RunEvent
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary, summarise
from servobench.hil.verdict.verdict import RunOutcome
from servobench.virtual_bus.faults.fault_log import FAULTS_FILE

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
    for name in (EVENTS_FILE, LOAD_FILE, FAULTS_FILE):
        if (folder / name).exists():
            AppendFile(folder / name, fresh=False).close()
    told = [*faults]
    if plan.frames:
        told += _keep_frames(plan, folder, rings)
    told += _keep_events(plan, folder, rings)
    if rings is not None:
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


def _keep_faults(plan: RecordingPlan, folder: Path, rings: Rings) -> list[str]:
    """Keep the injected faults that the logger had not taken; return the reasons for missing ones."""
    told = [f"{rings.refused} rows lost after the logger had ended"] if rings.refused else []
    entries = FaultEntries(plan.started_at)
    entries.take(rings.fault_blocks, first_cycle(plan, folder / RECORDS_FILE, rings), at_end=True)
    try:
        if plan.faults:
            keeper = FaultsKeeper(folder, entries, fresh=False)
            keeper.take(np.empty(0, ROW_DTYPE), rings.frames, rings.events)
    except OSError as error:
        told.append(f"{FAULTS_FILE} ends before the run: {error.strerror}")
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
