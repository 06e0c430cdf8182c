"""A run's folder, read: its bench, its rows and their signals, what it came to."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NEVER, NS_PER_S, duration_s
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.execution.recorded_bench import review_plan
from servobench.hil.loop.cycle_record import FATE_SAMPLE
from servobench.hil.loop.loop import planned_cycles
from servobench.hil.recording.row_series import READ_SERIES, main_lines_of, position_lines_of
from servobench.hil.recording.run_metadata import read_summary
from servobench.hil.recording.whole_figures import COUNTED_SHARE
from servobench.hil.reviewing.envelope import Envelope, Gaps, Points
from servobench.hil.reviewing.histogram import TimeHistogram
from servobench.hil.reviewing.review import Review
from servobench.hil.reviewing.tracking_error import (
    limit_points,
    position_stretches,
    speed_limits,
    speed_stretches,
)
from servobench.hil.rows.recording_plan import ReviewPlan
from servobench.hil.rows.records import DIGESTED_TO_FORMAT_2, Rows
from servobench.hil.rows.records_file import read_metadata, read_records, refuse_without_end
from servobench.hil.rows.run_files import (
    BENCH_FILE,
    FIRST_CYCLE,
    FORMAT,
    RECORDS_FILE,
    SUMMARY_FILE,
    not_a_recording,
)
from servobench.hil.rows.seal import NOT_CHECKED, SealedFiles, seal_of
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
    sealed: SealedFiles | None = field(default=None, kw_only=True)
    """Whoever reads windows of the frames holds them against it."""

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


def open_run(
    folder: Path, *, unsealed: bool = False, whole: bool = False, windows: bool = False
) -> RecordedRun:
    """The run in ``folder``; ``unsealed``: whether or not its files are as they were recorded; ``whole``: its
    records have to have their end; ``windows``: of its frames only windows are read, and of the large files
    that nobody reads the length is checked alone.

    Raises BadInput for what is none, is not ended, is of another format, or does not fit its seal.
    """
    if folder.name in (RECORDS_FILE, SUMMARY_FILE, "run.rrd"):
        folder = folder.parent
    for name in (BENCH_FILE, RECORDS_FILE):
        if not (folder / name).is_file():
            raise not_a_recording(folder, name)
    if not (folder / SUMMARY_FILE).is_file():
        expected = f"a run with its {SUMMARY_FILE}"
        raise BadInput("RUN", "", str(folder), expected, "hil recover ends it")
    if whole:
        refuse_without_end(folder / RECORDS_FILE)
    sealed = SealedFiles(folder) if windows and not unsealed else None
    if sealed is None:
        seal = seal_of(folder, unsealed=unsealed)
    else:
        seal = sealed.told
        sealed.check_small()
        sealed.check(RECORDS_FILE)
    records = folder / RECORDS_FILE
    metadata = read_metadata(records)
    if not metadata:
        found = f"no head in {records.stat().st_size} bytes"
        raise BadInput(str(records), "", found, "cycle records as they were written: it is damaged")
    written_in = metadata.get("format", "none")
    if not written_in.isdecimal() or not 1 <= int(written_in) <= int(FORMAT):
        raise BadInput("RUN", "format", written_in, f"a recording of format 1 to {FORMAT}")
    summary = read_summary(folder)
    config = load_bench(folder / BENCH_FILE)
    review = review_plan(config, Certificates(config).plans(), real_time=not config.simulated)
    if int(written_in) <= 2:
        review = replace(review, digested=DIGESTED_TO_FORMAT_2)
    return RecordedRun(folder, config, metadata, summary, review, seal=seal, sealed=sealed)


class RunSignals:
    """The rows of a run in bounded memory, as envelopes and as figures; :meth:`add` all of them."""

    def __init__(
        self, plan: ReviewPlan, deadline_ns: int, begin_s: float | None = None, end_s: float | None = None
    ) -> None:
        """``begin_s``, ``end_s``: the run time of which signals are kept; the figures are those of all."""
        self.axes = tuple(axis.name for axis in plan.axes)
        self.by_position = {axis.name for axis in plan.axes if axis.quantity == "position"}
        """Axes that are given positions."""
        self._by_torque = {axis.name for axis in plan.axes if axis.quantity == "torque"}
        self.deadline_ns = deadline_ns
        self.period_ns = plan.period
        self.review = Review(plan)
        self.signals: dict[str, Envelope] = {}
        """By axis and series, as "axis1/speed/measured"; r/min, rad, N m and us over ns of the run time."""
        self.gaps = {name: Gaps() for name in self.axes}
        """In run time."""
        self.last_cycle = 0
        """ns of the run time."""
        self._limits = plan.limits
        self.window_s = begin_s, end_s
        self._begin = -NEVER if begin_s is None else round(begin_s * NS_PER_S)
        self._end = NEVER if end_s is None else round(end_s * NS_PER_S)
        self._first_cycle = 0

    def add(self, rows: Rows, first_cycle: int = 0) -> None:
        """Take in rows; ``first_cycle``: what their instants count it as."""
        self.review.add(rows)
        self._first_cycle = first_cycle
        if rows.size:
            self.last_cycle = max(self.last_cycle, int(rows["due_at"][-1]) - first_cycle)
        for number, name in enumerate(self.axes):
            mine = rows if len(self.axes) == 1 else rows.compress(rows["axis"] == number)
            if self.window_s != (None, None):  # a copy of whole rows
                due_at = mine["due_at"] - first_cycle
                mine = mine[(due_at >= self._begin) & (due_at <= self._end)]
            self.gaps[name].add(mine["due_at"] - first_cycle, mine["fate"] != FATE_SAMPLE)
            positions = position_lines_of(mine) if name in self.by_position else ()
            for path, values in (*main_lines_of(mine, 1.0), *positions):
                signal = self.signals.setdefault(f"{name}/{path}", Envelope())
                signal.add(mine["due_at"] - first_cycle, values)

    def line(self, name: str, path: str) -> Points:
        """Return a signal of an axis; of one that was read a gap where no reading came."""
        points = self.signals[f"{name}/{path}"].points()
        return self.gaps[name].interrupt(points, self.last_cycle) if path in READ_SERIES else points

    def axes_in(self, plot: str) -> list[str]:
        """Return the axes that a plot shows: positions and speed errors those that are given them, speeds
        those that are given no positions, others all."""
        if plot in ("speed", "error"):
            without = self.by_position | (self._by_torque if plot == "error" else set())
            return [name for name in self.axes if name not in without]
        return [name for name in self.axes if name in self.by_position or not plot.startswith("position")]

    @property
    def delays(self) -> dict[str, TimeHistogram]:
        """By axis."""
        return dict(zip(self.axes, self.review.delays, strict=True))

    @property
    def error_limits_rpm(self) -> dict[str, float | None]:
        """How large the speed error may be at most where one limit or the other holds, by axis; None: nobody
        says."""
        limits = {
            name: [size for size in speed_limits(meter, self._limits).values() if size is not None]
            for name, meter in zip(self.axes, self.review.errors, strict=True)
        }
        return {name: RPM_PER_RAD_S * max(sizes) if sizes else None for name, sizes in limits.items()}

    def settling(self, name: str, plot: str) -> list[tuple[int, int]]:
        """Return the stretches of an axis in which the error of ``plot`` is not counted, ns of the run
        time."""
        number, origin = self.axes.index(name), self._first_cycle
        windows = (self.review.errors if plot == "error" else self.review.positions)[number].settling
        settling = [(begin - origin, min(end - origin, self.last_cycle)) for begin, end in windows]
        return [(begin, end) for begin, end in settling if begin <= self._end and end >= self._begin]

    def limit(self, name: str, plot: str) -> Points:
        """Return a line that the error of ``plot`` is held against, where it is: ns of the run time, and
        r/min or rad; empty: nobody says."""
        number, origin = self.axes.index(name), self._first_cycle
        begin, end = origin, origin + self.last_cycle
        if plot == "error":
            held = speed_stretches(self.review.errors[number], self._limits, begin, end)
            times, sizes = limit_points(held, RPM_PER_RAD_S)
        else:
            held = position_stretches(self.review.positions[number], self._limits, begin, end)
            times, sizes = limit_points(held)
        return times - origin, sizes

    def shown_error(self, plot: str) -> dict[str, float]:
        """How far the plot of an error has to reach: as far as what counts of it, in a part of a run as
        far as all of it there; r/min or rad, by axis."""
        if self.window_s == (None, None):
            return self.counted_error(plot)
        shown = {name: self.signals.get(f"{name}/{plot}/error") for name in self.axes_in(plot)}
        return {name: each.largest() or 0.0 for name, each in shown.items() if each is not None}

    def counted_error(self, plot: str = "error") -> dict[str, float]:
        """How large nearly all of the error of ``plot`` is that counts, r/min or rad, by axis."""
        by_position = plot == "position_error"
        counted = (
            [meter.counted for meter in self.review.positions]
            if by_position
            else [meter.counted for meter in self.review.errors]
        )
        scale = 1.0 if by_position else RPM_PER_RAD_S
        return {
            name: scale * (each.largest(COUNTED_SHARE) or 0.0)
            for name, each in zip(self.axes, counted, strict=True)
        }


def signals_of(run: RecordedRun, begin_s: float | None = None, end_s: float | None = None) -> RunSignals:
    """Read the rows once; ``begin_s``, ``end_s``: of which run time, None: all of it."""
    signals = RunSignals(run.review, run.config.loop.deadline, begin_s, end_s)
    for rows in run.rows():
        signals.add(rows)
    return signals
