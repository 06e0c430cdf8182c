"""A run's folder, read: its bench, its rows, what it came to."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from drivers.bounded_file import NoSuchFile
from drivers.errors import BadInput
from drivers.timebase import duration_s
from hil.configuration.bench_file import load_bench
from hil.configuration.config import BenchConfig
from hil.execution.network_guard import Certificates
from hil.execution.recorded_bench import review_plan
from hil.loop.loop import planned_cycles
from hil.recording.run_metadata import FIRST_CYCLE
from hil.rows.record_columns import FORMAT
from hil.rows.recording_plan import ReviewPlan
from hil.rows.records import Rows
from hil.rows.records_file import RECORDS_FILE, read_metadata, read_records
from hil.rows.run_files import BENCH_FILE, SUMMARY_FILE
from hil.rows.summary_file import read_summary
from hil.verdict.summary import Summary


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """What the files of a run say, but for its rows."""

    folder: Path
    config: BenchConfig
    metadata: Mapping[str, str]
    summary: Summary
    review: ReviewPlan
    """What its figures and its verdict depended on."""

    @property
    def axes(self) -> tuple[str, ...]:
        """By the number of the axis in the rows."""
        return tuple(axis.name for axis in self.review.axes)

    @property
    def cycles_planned(self) -> int:
        """Of each axis."""
        return planned_cycles(duration_s(self.config.bench.duration_s), self.config.loop.period)

    @property
    def first_cycle(self) -> int:
        """On the bench's own clock, ns."""
        return int(self.metadata[FIRST_CYCLE])

    def rows(self) -> Iterator[Rows]:
        """In batches, in run time."""
        return read_records(self.folder / RECORDS_FILE)

    def bench_rows(self) -> Iterator[Rows]:
        """In batches, on the bench's own clock: what the digest is over."""
        return read_records(self.folder / RECORDS_FILE, self.first_cycle)

    def title(self) -> str:
        """Bench and folder."""
        return f"{self.config.bench.name} ({self.folder})"


def open_run(folder: Path, argument: str = "RUN") -> RecordedRun:
    """The run in ``folder``. Raises BadInput for what is none, is not ended, or is of another format."""
    if folder.name in (RECORDS_FILE, SUMMARY_FILE, "run.rrd"):
        folder = folder.parent
    for name in (BENCH_FILE, RECORDS_FILE):
        if not (folder / name).is_file():
            raise BadInput(argument, "", str(folder), f"the folder of a run, with its {name}")
    metadata = read_metadata(folder / RECORDS_FILE)
    told = metadata.get("format", "none")
    if not told.isdigit() or not 1 <= int(told) <= int(FORMAT):
        raise BadInput(argument, "format", told, f"a recording of format 1 to {FORMAT}")
    try:
        summary = read_summary(folder)
    except NoSuchFile:
        raise BadInput(
            argument, "", str(folder), f"a run with its {SUMMARY_FILE}", "hil recover ends it"
        ) from None
    config = load_bench(folder / BENCH_FILE)
    review = review_plan(config, Certificates(config).plans(), real_time=not config.simulated)
    return RecordedRun(folder, config, metadata, summary, review)
