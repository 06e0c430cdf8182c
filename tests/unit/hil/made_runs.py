"""Recorded runs of rows that a test makes up: the bench of the example, and no files."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.recorded.recorded_run import RecordedRun
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.metrics import VerdictLimits
from tests.unit.hil.test_report import summary

BENCH: BenchConfig = load_bench(Path(__file__).parents[3] / "examples" / "ling2012.toml")
CERTIFIED_NM = 1.27
"""Rated torque of the axes."""


@dataclass(frozen=True, slots=True)
class MadeRun(RecordedRun):
    """Its rows are where it is."""

    batches: tuple[Rows, ...]

    def rows(self) -> Iterator[Rows]:
        return iter(self.batches)

    def bench_rows(self) -> Iterator[Rows]:
        for rows in self.batches:
            moved = rows.copy()
            moved["due_at"] += self.first_cycle
            yield moved


def made_run(
    rows: Rows,
    axes: Sequence[str] = ("axis1",),
    *,
    batch: int = 10_000,
    folder: str = "one",
    limits: VerdictLimits | None = None,
    period_us: int = 1_000,
    first_cycle: int = 0,
) -> MadeRun:
    """Of ``rows`` in batches of so many, whose axes are those of ``axes`` by their numbers."""
    loop = BENCH.loop.model_copy(update={"period_us": period_us})
    return MadeRun(
        Path(folder),
        BENCH.model_copy(update={"loop": loop}),
        {"first_cycle_bench_ns": str(first_cycle), "time": "simulated", "bench": "ling2012"},
        summary(),
        ReviewPlan(tuple(AxisPlan(name, 6_250.0, CERTIFIED_NM) for name in axes), limits or VerdictLimits()),
        tuple(rows[start : start + batch] for start in range(0, rows.size, batch)),
    )
