"""Position and following errors at the instants of the readings, against plain loops."""

import math

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.reviewing.tracking_error import PositionErrorMeter, worst
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import NO_POSITIONS, PositionError
from tests.unit.hil.row_tools import plain_rows

PERIOD = Duration(NS_PER_MS)
SETTLING = 10 * NS_PER_MS
AXIS = AxisPlan("axis1", 5_000.0, quantity="position", mode="csp")
READ_AFTER = 130 * NS_PER_US
ACTS_AFTER = 400 * NS_PER_US


def sine_rows(count: int = 400, lag_s: float = 0.0) -> Rows:
    """A shaft that follows 2 sin(20 t) behind by ``lag_s``, and set-points that say where it will be."""
    rows = plain_rows(count)
    time_s = rows["due_at"] / 1e9
    rows["reference_position_rad"] = 2.0 * np.sin(20.0 * time_s)
    rows["reference_rad_s"] = 40.0 * np.cos(20.0 * time_s)
    rows["sampled_at"] = rows["due_at"] + READ_AFTER
    rows["position_rad"] = 2.0 * np.sin(20.0 * (rows["sampled_at"] / 1e9 - lag_s))
    rows["command_handed_at"] = rows["due_at"] + 300 * NS_PER_US
    rows["command_effective_at"] = rows["due_at"] + ACTS_AFTER
    rows["command_position_rad"] = 2.0 * np.sin(20.0 * (rows["command_effective_at"] + PERIOD) / 1e9)
    return rows


def figures(*chunks: Rows, axis: AxisPlan = AXIS) -> PositionError:
    meter = PositionErrorMeter(axis, SETTLING, PERIOD)
    for chunk in chunks:
        meter.add(chunk)
    return meter.figures()


def test_a_shaft_that_is_where_it_should_be_when_it_is_read_has_no_error() -> None:
    found = figures(sine_rows())
    # the reference is carried by its rate, the way between set-points is straight: second order both
    assert found.peak_rad == pytest.approx(0.0, abs=0.5 * 800.0 * (READ_AFTER / 1e9) ** 2 * 1.01)
    assert found.following_peak_rad == pytest.approx(0.0, abs=800.0 / 8.0 * 1e-6 * 1.01)


def test_a_lag_is_the_error_that_it_makes() -> None:
    found = figures(sine_rows(lag_s=0.01))
    assert found.peak_rad == pytest.approx(2.0 * 2.0 * math.sin(0.1), rel=1e-3)
    assert found.rms_rad == pytest.approx(2.0 * 2.0 * math.sin(0.1) / math.sqrt(2.0), rel=2e-2)
    assert found.following_peak_rad == pytest.approx(2.0 * 2.0 * math.sin(0.1), rel=1e-3)


@pytest.mark.parametrize("size", [1, 3, 64])
def test_any_division_into_chunks_gives_the_same(size: int) -> None:
    rows = sine_rows(lag_s=0.004)
    rows["reference_position_rad"][200:] += 1.0
    rows["fate"][[17, 18, 19, 60]] = 1
    rows["command_handed_at"][[40, 41, 42]] = NOTHING
    chunks = [rows[first : first + size] for first in range(0, rows.size, size)]
    assert figures(*chunks) == figures(rows)


def test_a_step_is_not_counted_until_it_has_settled_but_followed_it_must_be() -> None:
    rows = sine_rows()
    rows["reference_position_rad"][200:] += 1.0
    rows["position_rad"][210:] += 1.0
    rows["command_position_rad"][200:] += 1.0
    found = figures(rows)
    assert found.peak_rad is not None
    assert found.peak_rad < 1e-4
    assert found.following_peak_rad == pytest.approx(1.0, abs=0.02)
    later = rows.copy()
    later["position_rad"][210] -= 1.0
    assert figures(later).peak_rad == pytest.approx(1.0, abs=1e-3)


def test_a_jump_of_speed_beyond_the_motor_is_a_step_too() -> None:
    rows = plain_rows(60)
    rows["sampled_at"] = rows["due_at"]
    rows["reference_rad_s"][20:] = 6.0
    rows["reference_position_rad"][20:] = 0.006 * np.arange(40)
    assert figures(rows[:30]).peak_rad == 0.0
    rows["reference_rad_s"][20:] = 4.0
    assert figures(rows[:30]).peak_rad == pytest.approx(0.006 * 9)


def test_where_they_do_not_apply_nothing_is_told() -> None:
    assert figures(sine_rows(), axis=AxisPlan("axis1", 5_000.0)) == NO_POSITIONS
    csv = figures(sine_rows(), axis=AxisPlan("axis1", 5_000.0, quantity="position", mode="csv"))
    assert csv.following_peak_rad is None
    assert csv.peak_rad is not None
    assert worst(PositionError, [NO_POSITIONS, csv]) == csv
