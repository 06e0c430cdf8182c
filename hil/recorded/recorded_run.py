"""A run's folder, read: its bench, its rows and their signals, what it came to."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import duration_s
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.execution.recorded_bench import review_plan
from servobench.hil.loop.loop import planned_cycles
from servobench.hil.recording.lanes import error_limit_rpm
from servobench.hil.recording.row_series import main_lines_of
from servobench.hil.recording.run_folder import read_summary
from servobench.hil.recording.whole_figures import COUNTED_SHARE
from servobench.hil.reviewing.envelope import Envelope
from servobench.hil.reviewing.histogram import TimeHistogram
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import ReviewPlan
from servobench.hil.rows.records import DIGESTED_TO_FORMAT_2, Rows
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.run_files import BENCH_FILE, FIRST_CYCLE, FORMAT, RECORDS_FILE, SUMMARY_FILE
from servobench.hil.rows.seal import NOT_CHECKED, seal_of
from servobench.hil.verdict.summary import Summary


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Contents of a run's files, except for its rows."""

    folder: Path
    config: BenchConfig
    metadata: Mapping[str, str]
    summary: Summary
    review: ReviewPlan
    """Settings on which its figures and its verdict depended."""
    seal: str = field(default=NOT_CHECKED, kw_only=True)
    """Result of checking the files against the seal."""

    @property
    def axes(self) -> tuple[str, ...]:
        """By the number of the axis in the rows."""
        return tuple(axis.name for axis in self.review.axes)

    @property
    def cycles_planned(self) -> int:
        """Planned cycles of each axis."""
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


def open_run(folder: Path, *, unsealed: bool = False) -> RecordedRun:
    """The run in ``folder``; ``unsealed``: whether or not its files are as they were recorded.

    Raises BadInput for what is none, is not ended, is of another format, or does not fit its seal.
    """
    if folder.name in (RECORDS_FILE, SUMMARY_FILE, "run.rrd"):
        folder = folder.parent
    for name in (BENCH_FILE, RECORDS_FILE):
        if not (folder / name).is_file():
            raise BadInput("RUN", "", str(folder), f"the folder of a run, with its {name}")
    if not (folder / SUMMARY_FILE).is_file():
        expected = f"a run with its {SUMMARY_FILE}"
        raise BadInput("RUN", "", str(folder), expected, "hil recover ends it")
    seal = seal_of(folder, unsealed=unsealed)
    metadata = read_metadata(folder / RECORDS_FILE)
    written_in = metadata.get("format", "none")
    if not written_in.isdecimal() or not 1 <= int(written_in) <= int(FORMAT):
        raise BadInput("RUN", "format", written_in, f"a recording of format 1 to {FORMAT}")
    summary = read_summary(folder)
    config = load_bench(folder / BENCH_FILE)
    review = review_plan(config, Certificates(config).plans(), real_time=not config.simulated)
    if int(written_in) <= 2:
        review = replace(review, digested=DIGESTED_TO_FORMAT_2)
    return RecordedRun(folder, config, metadata, summary, review, seal=seal)


class RunSignals:
    """The rows of a run in bounded memory, as envelopes and as figures; :meth:`add` all of them."""

    def __init__(self, run: RecordedRun) -> None:
        self.axes = run.axes
        self.deadline_ns = run.config.loop.deadline
        self.review = Review(run.review)
        self.signals: dict[str, Envelope] = {}
        """By axis and series, as "axis1/speed/measured"; r/min, N m and us over ns of the run time."""
        self._limits = run.review.limits

    def add(self, rows: Rows, first_cycle: int = 0) -> None:
        """Take in rows; ``first_cycle``: what their instants count it as."""
        self.review.add(rows)
        for number, name in enumerate(self.axes):
            mine = rows if len(self.axes) == 1 else rows[rows["axis"] == number]
            for path, times, values in main_lines_of(mine, 1.0):
                self.signals.setdefault(f"{name}/{path}", Envelope()).add(times - first_cycle, values)

    @property
    def delays(self) -> dict[str, TimeHistogram]:
        """By axis."""
        return dict(zip(self.axes, self.review.delays, strict=True))

    @property
    def error_limits_rpm(self) -> dict[str, float | None]:
        """How large the speed error may be, by axis; None: nobody says."""
        meters = zip(self.axes, self.review.errors, strict=True)
        return {name: error_limit_rpm(meter, self._limits) for name, meter in meters}

    @property
    def counted_error_rpm(self) -> dict[str, float]:
        """How large nearly all of the speed error is that counts, by axis."""
        meters = zip(self.axes, self.review.errors, strict=True)
        return {name: (meter.counted.largest(COUNTED_SHARE) or 0.0) * RPM_PER_RAD_S for name, meter in meters}


def signals_of(run: RecordedRun) -> RunSignals:
    """Read the rows once."""
    signals = RunSignals(run)
    for rows in run.rows():
        signals.add(rows)
    return signals
