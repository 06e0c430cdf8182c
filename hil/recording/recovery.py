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
from itertools import chain
from pathlib import Path

import numpy as np

from hil.figures.review import Review
from hil.figures.summary import Summary, summarise
from hil.recording.append_file import AppendFile
from hil.recording.faults_file import BLOCK_DTYPE, FaultsKeeper
from hil.recording.log_files import EventsKeeper, FramesKeeper, Keeper
from hil.recording.network_meter import NetworkKeeper
from hil.recording.recording_plan import RecordingPlan
from hil.recording.records import ROW_DTYPE, Rows
from hil.recording.records_file import RECORDS_FILE, RecordsWriter, finish_records, read_records
from hil.recording.ring import RingReader
from hil.recording.run_folder import EVENTS_FILE, FRAMES_FILE, LOAD_FILE, Reserve, write_summary
from hil.recording.side_rows import EVENT_DTYPE, FRAME_DTYPE, events_of
from hil.recording.tail import TAIL_FILE, read_tail
from hil.recording.telemetry import RERUN_FILE
from hil.verdict import RunOutcome
from virtual_bus.fault_injection.fault_log import FAULTS_FILE

_UNFINISHED_RERUN = f"{RERUN_FILE} has no verdict and may lack the last seconds: rerun rrd optimize mends it"


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
    for name in (FRAMES_FILE, EVENTS_FILE, LOAD_FILE, FAULTS_FILE):
        if (folder / name).exists():
            AppendFile(folder / name, fresh=False).close()
    told = [*faults, _UNFINISHED_RERUN]
    if rings is not None:
        told += _keep_the_rest(plan, folder, rings)
    told += whole_records(folder, rings)
    review = Review(plan.review)
    network = NetworkKeeper(folder, plan.period_us, len(plan.review.axes)) if plan.period_us else None
    for rows in read_records(folder / RECORDS_FILE):
        review.add(rows)
        if network is not None:
            network.take(rows, np.empty(0, FRAME_DTYPE), [])
    figures = review.figures()
    if planned is not None and figures.cycles < planned:
        told.append(f"{figures.cycles} of {planned} planned cycles are recorded")
    summary = summarise(figures, outcome, plan.review.limits, str(folder), plan.seed, tuple(told))
    reserve.release()
    if network is not None:
        network.finish(summary)
    reserve.close()
    write_summary(folder, summary)
    return summary


def _keep_the_rest(plan: RecordingPlan, folder: Path, rings: Rings) -> list[str]:
    """Frames, events and faults that the logger had not taken; why some are missing."""
    told = [f"{rings.refused} rows lost after the logger had ended"] if rings.refused else []
    keepers: list[Keeper] = []
    try:
        keepers.append(EventsKeeper(folder, fresh=False))
        if plan.frames:
            keepers.append(FramesKeeper(plan, folder, fresh=False))
        if plan.faults:
            keepers.append(FaultsKeeper(folder, rings.fault_blocks, fresh=False))
        for keeper in keepers:
            keeper.take(np.empty(0, ROW_DTYPE), rings.frames, rings.events)
    except OSError as error:
        told.append(f"frames and events end before the run: {error.strerror}")
    return told


def whole_records(folder: Path, rings: Rings | None = None) -> list[str]:
    """records.arrow with all rows that are anywhere, and with its end; why some are missing."""
    path = folder / RECORDS_FILE
    if not path.exists():  # the logger had not come so far
        RecordsWriter(path).close()
    stored = sum(rows.size for rows in read_records(path))
    more: list[Rows] = [tail for tail in [read_tail(folder, stored)] if tail.size]
    known = stored + sum(rows.size for rows in more)
    told = []
    if rings is not None and rings.rows.size:
        if rings.rows_before > known:
            told.append(f"{rings.rows_before - known} cycle records lost with the logger")
        more.append(rings.rows[max(0, known - rings.rows_before) :])
    try:
        if more:
            _rewrite(path, more)
        else:
            finish_records(path)
    except OSError as error:
        finish_records(path)
        lacking = sum(rows.size for rows in more)
        return [*told, f"{RECORDS_FILE} lacks {lacking} rows, {TAIL_FILE} may have them: {error.strerror}"]
    (folder / TAIL_FILE).unlink(missing_ok=True)
    return told


def _rewrite(path: Path, more: Sequence[Rows]) -> None:
    """``path`` with more rows behind those that it has. Error: OSError; it is as it was then."""
    part = path.with_name(f"{path.name}.part")
    try:
        writer = RecordsWriter(part)
        for rows in chain(read_records(path), more):
            writer.write(rows)
        writer.close()
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def main() -> int:
    """Entry point of the process."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    wanted = json.loads(sys.stdin.readline())
    plan, outcome = RecordingPlan.from_json(wanted["plan"]), RunOutcome(**wanted["outcome"])
    rings = Rings(*(int(argument) for argument in sys.argv[1:5]))
    summary = recover(plan, outcome, [wanted["trouble"]], rings)
    print(json.dumps(summary.as_json()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
