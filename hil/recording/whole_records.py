"""records.arrow made whole: with the rows that its logger could not write, and with its end."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pyarrow import ArrowInvalid

from servobench.drivers.timebase import Instant
from servobench.hil.recording.append_file import TAIL_FILE, read_tail
from servobench.hil.recording.ring import RingReader
from servobench.hil.recording.run_metadata import run_metadata
from servobench.hil.rows.events import BLOCK_DTYPE, RunZero
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import RecordsWriter, finish_records, read_metadata, read_records
from servobench.hil.rows.run_files import FIRST_CYCLE, RECORDS_FILE
from servobench.hil.rows.side_rows import EVENT_DTYPE, FRAME_DTYPE, drives_of, events_of


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
        writer.begin(read_metadata(path), zero)
        writer.copy(path)  # as its seal has it
        for rows in more:
            writer.write(rows)
        writer.close()
        part.replace(path)
    except (OSError, ArrowInvalid):
        writer.drop()  # a file that is open keeps its room on the disk
        part.unlink(missing_ok=True)
        raise
