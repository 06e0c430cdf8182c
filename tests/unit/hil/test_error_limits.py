"""Where the limit of an error holds, against a plain loop over drawn runs."""

import math

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.reviewing.tracking_error import SpeedErrorMeter, limit_points, speed_stretches
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.metrics import VerdictLimits
from tests.draws import few_of
from tests.unit.hil.row_tools import plain_rows

ACCELERATION, SETTLING = 5_000.0, 30
"""rad/s2, and cycles of 1 ms."""


def drawn_rows(dice: np.random.Generator) -> Rows:
    """References and loads that hold for a while, with steps and ramps of either."""
    count = int(dice.integers(20, 600))
    reference, load = np.zeros(count), np.zeros(count)
    for values, size in ((reference, 200.0), (load, 2.0)):
        for _ in range(int(dice.integers(0, 6))):
            at, value = int(dice.integers(1, count)), float(dice.uniform(-size, size))
            values[at:] = value
            if dice.random() < 0.3:
                values[at:] += 0.01 * size * np.arange(count - at)
    return plain_rows(count, reference, reference, load, fate=dice.choice([0, 0, 0, 1], count))


def plain_limit(rows: Rows, limits: VerdictLimits) -> list[float | None]:
    """The limit of each row, rad/s; None: it is not judged. By a loop that knows all of the run."""
    reference, load = rows["reference_rad_s"].tolist(), rows["load_torque_nm"].tolist()
    largest = max(map(abs, reference))
    found: list[float | None] = []
    stepped_at, reference_changed, load_changed = -math.inf, -1, -1
    for row, (asked, loaded) in enumerate(zip(reference, load, strict=True)):
        before = reference[row - 1] if row else 0.0
        if row and abs(asked - before) > ACCELERATION * 1e-3 * (1 + 1e-9):
            stepped_at = row
        if asked != before:
            reference_changed = row
        if row and loaded != load[row - 1]:
            load_changed = row
        held = []
        if limits.speed_error_peak_percent_max is not None:
            held.append(limits.speed_error_peak_percent_max / 100.0 * largest)
        if limits.after_load_percent_max is not None and load_changed > reference_changed and asked:
            held.append(limits.after_load_percent_max / 100.0 * abs(asked))
        found.append(min(held) if held and row - stepped_at >= SETTLING else None)
    return found


@pytest.mark.parametrize("seed", few_of(range(60), 12))
def test_the_line_of_a_limit_is_the_limit_of_each_row_that_is_judged(seed: int) -> None:
    dice = np.random.default_rng(seed)
    rows = drawn_rows(dice)
    percents = [None if dice.random() < 0.3 else float(dice.uniform(1.0, 20.0)) for _ in range(2)]
    limits = VerdictLimits(speed_error_peak_percent_max=percents[0], after_load_percent_max=percents[1])
    meter = SpeedErrorMeter(AxisPlan("axis1", ACCELERATION), Duration(SETTLING * NS_PER_MS))
    cuts = np.sort(dice.integers(0, rows.size, int(dice.integers(0, 5))))
    for piece in np.split(rows, cuts):
        meter.add(piece)
    end = int(rows["due_at"][-1]) + NS_PER_MS
    stretches = speed_stretches(meter, limits, 0, end)
    expected = plain_limit(rows, limits)
    for row, at in enumerate(rows["due_at"][:-1].tolist()):
        held = [size for begin, stop, size in stretches if begin <= at < stop]
        if expected[row] is None:
            assert held == [], row
        else:
            assert held == [pytest.approx(expected[row])], row
    times, sizes = limit_points(stretches)
    assert (np.diff(times) >= 0).all()
    assert np.isnan(sizes).sum() == max(0, len(stretches) - 1)


def test_more_changes_of_load_than_can_be_seen_are_not_all_kept() -> None:
    """1500 stretches of one cycle: the first thousand are lines, and the last of them is as it was."""
    changes = np.arange(3_000)
    rows = plain_rows(3_000, reference=1.0 + 0.001 * (changes // 2), load=1.0 * (changes % 2))
    meter = SpeedErrorMeter(AxisPlan("axis1", ACCELERATION), Duration(NS_PER_MS))
    for piece in np.split(rows, [700, 2_500]):
        meter.add(piece)
    assert len(meter.loaded) == 1_000
    assert all(end - begin == NS_PER_MS for begin, end, _ in meter.loaded)
