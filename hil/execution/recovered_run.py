"""Ends the recording of an interrupted run, from its own bench file.

Apart from :mod:`servobench.hil.execution.recorded_bench`, which whatever reads a recording imports: this one
brings the logger's modules with it.
"""

from dataclasses import replace
from pathlib import Path

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Duration, Instant, duration_s
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.execution.recorded_bench import recording_plan
from servobench.hil.loop.loop import planned_cycles
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.recording.recovery import recover
from servobench.hil.recording.run_metadata import read_summary
from servobench.hil.rows.records_file import read_metadata
from servobench.hil.rows.run_files import (
    BENCH_FILE,
    BENCH_START,
    EVENTS_FILE,
    FIRST_CYCLE,
    FIRST_CYCLE_EPOCH,
    FRAMES_FILE,
    LOGGER_LOG,
    RECORDS_FILE,
    RERUN_FILE,
    RESERVE_FILE,
    SEAL_FILE,
    not_a_recording,
)
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import RunOutcome

_OF_A_LOGGER = (RECORDS_FILE, EVENTS_FILE, FRAMES_FILE, LOGGER_LOG, RERUN_FILE, SEAL_FILE, RESERVE_FILE)
"""One that is killed before the first cycle leaves some of these beside the bench file."""
_UNKNOWN_END = "the end of the run is not known: whoever recorded it was ended before it"


def refuse_whole(folder: Path) -> None:
    """Raise BadInput unless ``folder`` holds a recording without a summary."""
    if not (folder / BENCH_FILE).is_file():
        raise not_a_recording(folder, BENCH_FILE)
    if not any((folder / name).exists() for name in _OF_A_LOGGER):
        raise not_a_recording(folder, RECORDS_FILE)
    try:
        read_summary(folder)
    except BadInput:
        return
    raise BadInput("RUN", "", str(folder), "a recording without a summary", "this one is whole")


def _times(records: Path) -> tuple[Instant, Duration | None]:
    """Return from the head of the records the recording's start on the bench clock, and the offset of the
    stamps of frames; 0 and None if missing."""
    metadata = read_metadata(records) if records.exists() else {}
    if not metadata:
        return Instant(0), None
    start, first, epoch = (int(metadata[key]) for key in (BENCH_START, FIRST_CYCLE, FIRST_CYCLE_EPOCH))
    return Instant(start + first), Duration(epoch - first)


def recover_run(config: BenchConfig, folder: Path) -> Summary:
    """End the recording of a run of ``config``. Raises BadInput while it is being recorded,
    RecordingFailed."""
    started_at, wall_offset = _times(folder / RECORDS_FILE)
    plan = replace(
        recording_plan(config, folder, {}, Certificates(config).plans(), real_time=not config.simulated),
        started_at=started_at,
        wall_offset=wall_offset,
    )
    planned = planned_cycles(duration_s(config.bench.duration_s), config.loop.period)
    outcome = RunOutcome(completed=False, reason=_UNKNOWN_END, cycles_planned=planned)
    try:
        return recover(plan, outcome, [_UNKNOWN_END], planned=planned)
    except BlockingIOError:
        raise BadInput("RUN", "", str(folder), "a run that has ended", "its logger still writes") from None
    except OSError as error:
        raise RecordingFailed(str(error)) from error
