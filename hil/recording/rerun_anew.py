"""Writes run.rrd of a run that was recorded, from the files beside it."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final
from uuid import uuid4

import rerun as rr

from servobench.drivers.errors import printable
from servobench.drivers.timebase import Instant
from servobench.hil.loop.cycle_record import ROW
from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.reviewing.review import Review
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.rows.events import read_events
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.run_files import EVENTS_FILE, LOAD_FILE, RECORDS_FILE, RERUN_FILE
from servobench.hil.rows.side_rows import BeginEvent, LoadEvent, RunEvent, StateEvent, TextEvent
from servobench.hil.verdict.summary import Summary

ROOM_BYTES: Final = 4 << 20
"""On the disk, for layout, verdict and events of run.rrd; rows take less than they do in memory."""

_INSTANT_MAX: Final = 1 << 62
"""146 years in ns: the time between two instants of a run still has 64 bits."""


def write_rerun_anew(plan: RecordingPlan, summary: Summary, review: Review) -> None:
    """run.rrd in the place of the one that is there; all files beside it are whole.

    It is not begun on a disk that it could fill: Rerun would wait there for ever. Error: OSError.
    """
    folder = plan.folder
    assert folder is not None
    needed = ROOM_BYTES + ROW.size * summary.cycles * len(plan.review.axes)
    if shutil.disk_usage(folder).free < needed:
        raise OSError(f"less than {needed >> 20} MB are free")
    part = folder / f"{RERUN_FILE}.part"
    try:
        _send(plan, folder, Telemetry(plan, uuid4().hex, rr.FileSink(part)), summary, review)
        part.replace(folder / RERUN_FILE)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _send(plan: RecordingPlan, folder: Path, telemetry: Telemetry, summary: Summary, review: Review) -> None:
    """Send in a logger's order: what precedes the first cycle, the cycles, what follows them."""
    telemetry.metadata = read_metadata(folder / RECORDS_FILE)
    told = [*_events(folder / EVENTS_FILE), *_loads(folder / LOAD_FILE)]
    telemetry.take_events([event for event in told if event.at <= 0])
    if plan.observed and plan.frames:
        for frames in RecordedBus(folder).arrays(plan.segments):
            telemetry.observed.take(frames)
    for rows in read_records(folder / RECORDS_FILE):
        telemetry.take_rows(rows)
    telemetry.take_events([event for event in told if event.at > 0])
    telemetry.finish(summary, review)


def _events(path: Path) -> Iterator[RunEvent]:
    """The entries of events.jsonl; what is none is passed over."""
    for fields in read_events(path):
        with suppress(ValueError, KeyError):
            at = _instant(fields["at_ns"])
            if "begin" in fields:
                yield BeginEvent(at)
            elif "track" in fields:
                yield StateEvent(at, printable(str(fields["track"])), printable(str(fields["state"])))
            else:
                yield TextEvent(at, printable(str(fields["level"])), printable(str(fields["text"])))


def _loads(path: Path) -> Iterator[RunEvent]:
    """The lines of load.csv; one that is none, such as its head, is passed over."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else ():
        with suppress(ValueError):
            at, axis, torque_nm, speed_rad_s = line.split(",")
            yield LoadEvent(_instant(int(at)), printable(axis), float(torque_nm), float(speed_rad_s))


def _instant(value: int) -> Instant:
    """Raises ValueError for what no clock shows."""
    if abs(value) > _INSTANT_MAX:
        raise ValueError(value)
    return Instant(value)
