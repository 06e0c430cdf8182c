"""run.rrd of a recording whose logger did not live to end it, made anew from the other files."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final
from uuid import uuid4

import rerun as rr

from drivers.bounded_file import parse_json
from drivers.errors import BadInput
from drivers.printable import printable
from drivers.timebase import Instant
from hil.recording.telemetry import RERUN_FILE, Telemetry
from hil.reviewing.review import Review
from hil.reviewing.trace.run_trace import RecordedBus
from hil.rows.recording_plan import RecordingPlan
from hil.rows.records import ROW
from hil.rows.records_file import RECORDS_FILE, read_metadata, read_records
from hil.rows.run_files import EVENTS_FILE, LOAD_FILE
from hil.rows.side_rows import BeginEvent, LoadEvent, RunEvent, StateEvent, TextEvent
from hil.verdict.summary import Summary

ROOM_BYTES: Final = 4 << 20
"""For layout, verdict and events; rows take less than they do in memory."""

INSTANT_MAX: Final = 1 << 62


def write_rerun_anew(plan: RecordingPlan, summary: Summary, review: Review) -> None:
    """Put it in the place of the one that is there; all files beside it are whole.

    It is not begun on a disk that it could fill: Rerun would wait there for ever. Error: OSError.
    """
    folder = plan.folder
    assert folder is not None
    needed = ROOM_BYTES + ROW.size * summary.cycles * len(plan.review.axes)
    if shutil.disk_usage(folder).free < needed:
        raise OSError(f"less than {needed >> 20} MB are free")
    part = folder / f"{RERUN_FILE}.part"
    try:
        _write(plan, folder, Telemetry(plan, uuid4().hex, rr.FileSink(part)), summary, review)
        part.replace(folder / RERUN_FILE)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _write(plan: RecordingPlan, folder: Path, telemetry: Telemetry, summary: Summary, review: Review) -> None:
    """As a logger sends it: what was before the first cycle, the cycles, what came after."""
    telemetry.metadata = read_metadata(folder / RECORDS_FILE)
    told = [*_told(folder / EVENTS_FILE, _event), *_told(folder / LOAD_FILE, _load)]
    telemetry.take_events([event for event in told if event.at <= 0])
    if plan.observed and plan.frames:
        for frames in RecordedBus(folder).arrays(plan.segments):
            telemetry.observed.take(frames)
    for rows in read_records(folder / RECORDS_FILE):
        telemetry.take_rows(rows)
    telemetry.take_events([event for event in told if event.at > 0])
    telemetry.finish(summary, review)


def _told(path: Path, event_of: Callable[[str], RunEvent]) -> Iterator[RunEvent]:
    """The events in the lines of a file; a line that is none, such as a head, is passed over."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else ():
        with suppress(BadInput, ValueError, KeyError, TypeError):
            yield event_of(line)


def _event(line: str) -> RunEvent:
    fields = parse_json(line, EVENTS_FILE, "an event")
    at = _instant(fields["at_ns"])
    if "begin" in fields:
        return BeginEvent(at)
    if "track" in fields:
        return StateEvent(at, printable(str(fields["track"])), printable(str(fields["state"])))
    return TextEvent(at, printable(str(fields["level"])), printable(str(fields["text"])))


def _load(line: str) -> RunEvent:
    at, axis, torque_nm, speed_rad_s = line.split(",")
    return LoadEvent(_instant(int(at)), printable(axis), float(torque_nm), float(speed_rad_s))


def _instant(value: int) -> Instant:
    """Raises ValueError for what no clock shows."""
    if not isinstance(value, int) or abs(value) > INSTANT_MAX:
        raise ValueError(value)
    return Instant(value)
