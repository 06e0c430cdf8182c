"""Which cycles count for the speed error, on hand-made runs and against a plain loop."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.reviewing.tracking_error import SpeedErrorMeter, worst
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import SpeedError
from tests.draws import examples_of
from tests.unit.hil.row_tools import plain_rows, rows_of
from tests.unit.hil.synthetic_run import synthetic_records

ACCELERATION = 5_000.0
SETTLING = Duration(10 * NS_PER_MS)


def figures_of(*chunks: Rows) -> SpeedError:
    meter = SpeedErrorMeter(AxisPlan("axis1", ACCELERATION), SETTLING)
    for chunk in chunks:
        meter.add(chunk)
    return meter.figures()


def test_a_constant_error_at_rest() -> None:
    assert figures_of(plain_rows(5, velocity=0.5)) == SpeedError(0.5, None, 0.5, None)


def test_nothing_counted_gives_no_figure() -> None:
    assert figures_of(plain_rows(5, fate=1, velocity=math.nan)) == SpeedError(None, None, None, None)


def test_the_error_within_the_settling_window_is_not_counted() -> None:
    reference = [0.0] * 5 + [100.0] * 20
    velocity = [0.0] * 5 + [0.0] * 10 + [99.0] * 10
    found = figures_of(plain_rows(25, reference, velocity))
    assert found.peak_rad_s == 1.0
    assert found.peak_percent == 1.0
    assert found.rms_rad_s == pytest.approx(math.sqrt(10 / 15))


def test_the_last_instant_of_the_window_is_outside_it() -> None:
    reference = [0.0] + [100.0] * 11
    velocity = [0.0] * 11 + [70.0]
    assert figures_of(plain_rows(12, reference, velocity)).peak_rad_s == 30.0


def test_a_ramp_that_the_axis_can_follow_is_counted() -> None:
    reference = [5.0 * place for place in range(10)]
    assert figures_of(plain_rows(10, reference)).peak_rad_s == 45.0
    steeper = [5.1 * place for place in range(10)]
    assert figures_of(plain_rows(10, steeper)).peak_rad_s == 0.0


def test_a_reference_that_is_there_from_the_first_cycle_is_a_step() -> None:
    assert figures_of(plain_rows(5, reference=100.0)).peak_rad_s is None


def test_after_load_runs_from_the_load_step_to_the_next_change_of_reference() -> None:
    reference = [50.0] * 40 + [52.0] * 10
    load = [0.0] * 20 + [0.6] * 30
    velocity = np.array(reference)
    velocity[15], velocity[25], velocity[45] = 40.0, 48.0, 45.0
    found = figures_of(plain_rows(50, reference, velocity.tolist(), load))
    assert found.after_load_percent == pytest.approx(4.0)
    assert found.peak_rad_s == 10.0


def test_a_load_that_is_there_from_the_start_is_no_step() -> None:
    assert figures_of(plain_rows(30, reference=50.0, velocity=40.0, load=0.6)).after_load_percent is None


def test_dropouts_do_not_count() -> None:
    velocity = [0.0, math.nan, math.nan, 0.25]
    assert figures_of(plain_rows(4, velocity=velocity, fate=[0, 1, 2, 0])).peak_rad_s == 0.25


levels = st.sampled_from([0.0, 3.0, 50.0, -80.0])
cells = st.tuples(levels, st.floats(-100, 100), st.sampled_from([0.0, 0.6]), st.sampled_from([0, 0, 0, 1]))


def by_the_definition(rows: Rows) -> SpeedError:
    """The same figures, row by row."""
    reference_before, load_before, due_before = 0.0, float(rows["load_torque_nm"][0]), int(rows["due_at"][0])
    step_at, after_load = -(10**18), False
    errors, shares, peak_reference = [], [], 0.0
    for row in rows:
        reference, load, due_at = (
            float(row["reference_rad_s"]),
            float(row["load_torque_nm"]),
            int(row["due_at"]),
        )
        if abs(reference - reference_before) > ACCELERATION * (due_at - due_before) * 1e-9 * (1 + 1e-9):
            step_at = due_at
        if load != load_before:
            after_load = True
        if reference != reference_before:
            after_load = False
        peak_reference = max(peak_reference, abs(reference))
        if int(row["fate"]) == 0 and due_at - step_at >= SETTLING:
            errors.append(abs(reference - float(row["velocity_rad_s"])))
            if after_load and reference:
                shares.append(errors[-1] / abs(reference))
        reference_before, load_before, due_before = reference, load, due_at
    if not errors:
        return SpeedError(None, None, None, None)
    return SpeedError(
        max(errors),
        100 * max(errors) / peak_reference if peak_reference else None,
        math.sqrt(sum(error * error for error in errors) / len(errors)),
        100 * max(shares) if shares else None,
    )


@pytest.mark.long
@examples_of(200)
@given(st.lists(st.tuples(cells, st.integers(1, 15)), min_size=1, max_size=12))
def test_any_run_agrees_with_the_definition(parts: list[tuple[tuple[float, float, float, int], int]]) -> None:
    columns = list(zip(*[cell for cell, times in parts for _ in range(times)], strict=True))
    rows = plain_rows(len(columns[0]), *columns)
    found, expected = figures_of(rows), by_the_definition(rows)
    assert found.peak_rad_s == expected.peak_rad_s
    assert found.peak_percent == pytest.approx(expected.peak_percent)
    assert found.rms_rad_s == pytest.approx(expected.rms_rad_s)
    assert found.after_load_percent == pytest.approx(expected.after_load_percent)


@pytest.mark.long
@examples_of(100)
@given(st.lists(st.integers(0, 1500), max_size=8))
def test_division_into_chunks_changes_no_bit(cuts: list[int]) -> None:
    rows = rows_of(synthetic_records(1500))
    assert figures_of(*np.split(rows, sorted(cuts))) == figures_of(rows)


def test_the_worst_of_the_axes() -> None:
    a = SpeedError(1.0, None, 3.0, None)
    b = SpeedError(2.0, 5.0, 1.0, None)
    assert worst(SpeedError, [a, b]) == SpeedError(2.0, 5.0, 3.0, None)
