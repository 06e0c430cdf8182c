"""Figures and digest of whole runs."""

from dataclasses import replace
from hashlib import blake2b

import numpy as np
import pytest

from servobench.drivers.record import replaced
from servobench.drivers.timebase import Instant
from servobench.hil.loop.cycle_record import NAMES, NOTHING, CycleRecord, row_of
from servobench.hil.loop.samples import Dropout
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import DIGESTED as PLACES
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import DropoutCounts, Figures
from tests.unit.hil.row_tools import plain_rows, rows_of
from tests.unit.hil.synthetic_run import synthetic_records

PLAN = ReviewPlan((AxisPlan("axis1", 6_250.0),))
CYCLES = 2_000


@pytest.fixture(scope="module")
def records() -> list[CycleRecord]:
    return list(synthetic_records(CYCLES))


def figures_of(*chunks: Rows, plan: ReviewPlan = PLAN) -> Figures:
    review = Review(plan)
    for chunk in chunks:
        review.add(chunk)
    return review.figures()


def test_counts_and_delays_against_the_records(records: list[CycleRecord]) -> None:
    found = figures_of(rows_of(records))
    causes = [r.observation.cause.value for r in records if isinstance(r.observation, Dropout)]
    assert found.cycles == found.rows == CYCLES
    assert found.dropouts == DropoutCounts(
        causes.count("lost"), causes.count("late"), causes.count("stale"), 0
    )
    assert found.dropouts.lost > 0
    assert found.dropouts.late > 0
    delays = [r.delay / 1_000 for r in records if r.delay is not None]
    assert found.reading_delay_us.p50 == pytest.approx(
        np.quantile(delays, 0.5, method="inverted_cdf"), rel=1e-3
    )
    assert found.reading_delay_us.p99 == pytest.approx(
        np.quantile(delays, 0.99, method="inverted_cdf"), rel=1e-3
    )
    assert found.reading_delay_us.max == max(delays)


@pytest.mark.parametrize(
    ("numbers", "dense"),
    [([1, 2, 3, 4], 4), ([1, 2, 2, 4], 2), ([1, 2, 4, 5], 2), ([2, 3, 4, 5], 0), ([1, 3, 2, 4], 1)],
)
@pytest.mark.parametrize("chunks", [1, 3])
def test_rows_are_dense_up_to_the_first_that_is_missing_or_double(
    numbers: list[int], dense: int, chunks: int
) -> None:
    rows = plain_rows(4)
    rows["sequence"] = numbers
    assert figures_of(*np.array_split(rows, chunks)).dense == dense


def test_of_several_axes_the_least_dense_counts() -> None:
    plan = ReviewPlan((AxisPlan("axis1", 1.0), AxisPlan("axis2", 1.0)))
    first, second = plain_rows(5), plain_rows(4)
    second["axis"] = 1
    assert figures_of(first, second, plan=plan).dense == 4
    assert figures_of(first, plan=plan).dense == 0


def test_lateness_is_of_every_cycle() -> None:
    rows = plain_rows(100)
    rows["woke_at"] += np.arange(100) * 1_000
    assert figures_of(rows).lateness_us.max == 99.0


def test_the_digest_is_that_of_the_packed_rows(records: list[CycleRecord]) -> None:
    rows = [row_of(record) for record in records]
    packed = b"".join(row[8 * place : 8 * place + 8] for row in rows for place in PLACES)
    assert figures_of(rows_of(records)).digest == blake2b(packed, digest_size=16).hexdigest()


def test_chunks_do_not_matter(records: list[CycleRecord]) -> None:
    rows = rows_of(records)
    assert figures_of(*np.array_split(rows, 7)) == figures_of(rows)


DIGESTED = [NAMES[place] for place in PLACES]


def test_what_the_host_took_and_what_a_controller_tells_is_in_no_digest(records: list[CycleRecord]) -> None:
    rows = rows_of(records[:10])
    changed = rows.copy()
    for name in [name for name in NAMES if name not in DIGESTED]:
        changed[name][4] += 1
    assert figures_of(changed).digest == figures_of(rows).digest


def test_the_computing_time_has_its_percentiles(records: list[CycleRecord]) -> None:
    rows = rows_of(records[:1000]).copy()
    rows["compute_ns"] = 30_000
    rows["compute_ns"][500] = 20_700_000
    found = figures_of(rows).compute_us
    assert found.p50 == pytest.approx(30.0, rel=1e-3)
    assert found.max == 20_700.0
    rows["compute_ns"] = NOTHING
    assert figures_of(rows).compute_us.max is None


@pytest.mark.parametrize("name", DIGESTED)
def test_every_other_field_enters_the_digest(records: list[CycleRecord], name: str) -> None:
    rows = rows_of(records[:10])
    changed = rows.copy()
    changed[name][4] = np.nan_to_num(changed[name][4]) + 1 if name != "fate" else 3
    if name != "axis":
        assert figures_of(changed).digest != figures_of(rows).digest
    else:
        plan = ReviewPlan((*PLAN.axes, AxisPlan("axis2", 1.0)))
        assert figures_of(changed, plan=plan).digest != figures_of(rows, plan=plan).digest


def test_two_axes_give_the_worst_error_and_all_dropouts(records: list[CycleRecord]) -> None:
    plan = ReviewPlan((AxisPlan("axis1", 6_250.0), AxisPlan("axis2", 6_250.0)))
    other = list(synthetic_records(CYCLES, seed=2, axis=1))
    mixed = rows_of([record for pair in zip(records, other, strict=True) for record in pair])
    alone = [figures_of(rows_of(records)), figures_of(rows_of([replaced(r, axis=0) for r in other]))]
    found = figures_of(mixed, plan=plan)
    assert (found.cycles, found.rows) == (CYCLES, 2 * CYCLES)
    assert found.dropouts.total == sum(figures.dropouts.total for figures in alone)
    assert found.speed_error.rms_rad_s == max(figures.speed_error.rms_rad_s or 0.0 for figures in alone)


def test_a_run_without_records_has_no_figures() -> None:
    found = figures_of()
    assert (found.cycles, found.rows, found.reading_delay_us.p50) == (0, 0, None)


def test_rows_of_another_layout_are_refused() -> None:
    with pytest.raises(TypeError, match="ROW_DTYPE"):
        Review(PLAN).add(np.zeros(3, [("sequence", "<i8")]))


def test_an_instant_moves_the_digest_but_not_the_figures(records: list[CycleRecord]) -> None:
    moved = [replaced(record, sync_handed_at=Instant(record.due_at + 1)) for record in records]
    first, second = figures_of(rows_of(records)), figures_of(rows_of(moved))
    assert first.digest != second.digest
    assert replace(first, digest="") == replace(second, digest="")
