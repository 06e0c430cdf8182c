"""Runs held against the first of them: against brute force over their rows, cycle by cycle."""

import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import BadInputs
from servobench.hil.loop.cycle_record import NAMES
from servobench.hil.recorded.comparison import (
    Against,
    Difference,
    Divergence,
    Tolerances,
    compare_runs,
    comparison_json,
    comparison_lines,
    load_tolerances,
)
from servobench.hil.recorded.recorded_run import RecordedRun
from servobench.hil.rows.records import Rows
from tests.unit.hil.made_runs import made_run
from tests.unit.hil.row_tools import plain_rows

SIGNALS = ("velocity_rad_s", "torque_nm", "command_torque_nm", "reference_rad_s", "load_torque_nm")
CYCLES = 60


def random_rows(seed: int, axes: int) -> Rows:
    """Of so many axes in turn, with dropouts, and without a command now and then."""
    random = np.random.default_rng(seed)
    rows = plain_rows(CYCLES * axes)
    rows["axis"] = np.arange(rows.size) % axes
    rows["sequence"] = 1 + np.arange(rows.size) // axes
    rows["due_at"] = rows["woke_at"] = 1_000_000 * (rows["sequence"] - 1) + 10 * rows["axis"]
    for name in SIGNALS:
        rows[name] = random.normal(size=rows.size)
    rows["command_torque_nm"][random.random(rows.size) < 0.1] = math.nan
    rows["fate"] = np.where(random.random(rows.size) < 0.2, 1, 0)
    rows["delay_ns"] = random.integers(300_000, 900_000, rows.size)
    return rows


def without(rows: Rows, share: float, seed: int) -> Rows:
    """Some of its rows are missing."""
    return rows[np.random.default_rng(seed).random(rows.size) >= share]


def by_cycle(run: RecordedRun) -> dict[tuple[str, int], Any]:
    return {
        (run.axes[row["axis"]], int(row["sequence"])): row
        for row in np.concatenate(list(run.rows()))
        if row["axis"] < len(run.axes)
    }


def beside(base: RecordedRun, other: RecordedRun) -> Against:
    first, second = compare_runs([base, other])
    assert (first.run, second.run) == (base, other)
    assert (first.differences, first.divergence, first.cycles_of_both) == ({}, None, 0)
    return second


@pytest.mark.parametrize(("batch", "other_batch"), [(1, 1), (7, 50), (50, 7), (10_000, 10_000), (3, 10_000)])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_differences_are_those_of_the_cycles_that_both_have(
    batch: int, other_batch: int, share: float
) -> None:
    base = made_run(without(random_rows(1, 3), share, 3), ("a", "b", "c"), batch=batch)
    other = made_run(without(random_rows(2, 2), share, 4), ("b", "a"), batch=other_batch, folder="two")
    ones, others = by_cycle(base), by_cycle(other)
    both = sorted(set(ones) & set(others))
    found = beside(base, other)
    assert found.cycles_of_both == len(both)
    assert set(found.differences) == {"a", "b"}
    for axis, signal in product("ab", SIGNALS):
        pairs = [(ones[key], others[key]) for key in both if key[0] == axis]
        if signal in ("velocity_rad_s", "torque_nm"):
            pairs = [(one, two) for one, two in pairs if one["fate"] == 0 and two["fate"] == 0]
        apart = [(abs(two[signal] - one[signal]), two["due_at"]) for one, two in pairs]
        apart = [each for each in apart if not math.isnan(each[0])]
        largest, at = max(apart, key=lambda each: each[0])
        difference = found.differences[axis][signal]
        assert (difference.largest.value, difference.largest.at) == (largest, at)
        assert difference.rms == pytest.approx(math.sqrt(sum(each**2 for each, _ in apart) / len(apart)))


def changed(changes: dict[tuple[int, str], Any], axes: int = 1) -> Rows:
    """Other rows than those of seed 1, by place and column."""
    rows = random_rows(1, axes)
    for (place, name), value in changes.items():
        rows[name][place] = value
    return rows


@pytest.mark.parametrize("batch", [1, 25, 10_000])
def test_the_first_divergence_names_every_column_of_its_cycle(batch: int) -> None:
    other = changed({(40, "load_torque_nm"): 9.0, (40, "delay_ns"): 5, (41, "torque_nm"): 9.0})
    found = beside(made_run(random_rows(1, 1), batch=batch), made_run(other, batch=30))
    assert found.divergence == Divergence("axis1", 41, 40_000_000, ("delay_ns", "load_torque_nm"))
    assert found.cycles_of_both == CYCLES


@pytest.mark.parametrize("batch", [1, 25, 10_000])
def test_of_several_axes_the_divergence_is_the_earliest_in_time(batch: int) -> None:
    for later, earlier, axis, at in ((31, 20, "a", 10_000_000), (30, 21, "b", 10_000_010)):
        other = changed({(later, "torque_nm"): 9.0, (earlier, "torque_nm"): 9.0}, axes=2)
        runs = [made_run(rows, ("a", "b"), batch=batch) for rows in (random_rows(1, 2), other)]
        assert beside(*runs).divergence == Divergence(axis, 11, at, ("torque_nm",))


@pytest.mark.parametrize("name", ["clock_offset_ns", "device_time_ns", "compute_ns", "channel_0"])
def test_what_is_not_compared_is_no_divergence(name: str) -> None:
    """A drive's clock begins where it was switched on; behind the digest lies what differs by host."""
    other = changed({(place, name): 77 for place in range(CYCLES)})
    assert beside(made_run(random_rows(1, 1)), made_run(other)).divergence is None


@pytest.mark.parametrize("name", [name for name in NAMES[: NAMES.index("compute_ns")] if name != "sequence"])
def test_every_other_column_of_the_digest_is_compared(name: str) -> None:
    if name in ("axis", "clock_offset_ns", "device_time_ns", "fate", "command_fate"):
        return
    other = changed({(CYCLES - 1, name): 77})
    found = beside(made_run(random_rows(1, 1)), made_run(other)).divergence
    assert found is not None
    assert (found.cycle, found.columns) == (CYCLES, (name,))


def test_another_number_of_the_axis_is_no_difference() -> None:
    rows = random_rows(1, 2)
    turned = rows.copy()
    turned["axis"] = 1 - rows["axis"]
    found = beside(made_run(rows, ("a", "b")), made_run(turned, ("b", "a")))
    assert (found.divergence, found.cycles_of_both) == (None, 2 * CYCLES)
    assert all(
        each.largest.value == 0.0 for signals in found.differences.values() for each in signals.values()
    )


@pytest.mark.parametrize(("first", "second"), [(50, CYCLES), (CYCLES, 50), (0, CYCLES), (CYCLES, 0)])
def test_runs_are_compared_as_far_as_both_go(first: int, second: int) -> None:
    rows = random_rows(1, 1)
    found = beside(made_run(rows[:first], batch=20), made_run(rows[:second], batch=33))
    assert (found.cycles_of_both, found.divergence) == (min(first, second), None)
    if not min(first, second):
        assert found.differences["axis1"]["torque_nm"].rms is None


def test_runs_that_share_no_axis_are_not_compared() -> None:
    rows = random_rows(1, 1)
    with pytest.raises(BadInput) as caught:
        compare_runs([made_run(rows, ("a", "b")), made_run(rows, ("b",)), made_run(rows, ("c", "d"))])
    assert str(caught.value) == "RUN: axes: found 'c, d', expected one of a, b, as in one"


def test_runs_of_another_period_are_not_compared() -> None:
    rows = random_rows(1, 1)
    with pytest.raises(BadInput) as caught:
        compare_runs([made_run(rows), made_run(rows, folder="two", period_us=2_000)])
    assert str(caught.value) == "two: loop.period_us: found 2000, expected 1000, as in one"


def test_a_difference_keeps_the_first_of_the_largest() -> None:
    found = Difference()
    assert (found.rms, found.largest.value, found.largest.at) == (None, None, None)
    found.add(np.array([1, 2]), np.array([math.nan, math.nan]))
    assert (found.rms, found.largest.at) == (None, None)
    found.add(np.array([3]), np.array([0.0]))
    assert (found.rms, found.largest.value, found.largest.at) == (0.0, 0.0, 3)
    found.add(np.array([4, 5, 6]), np.array([-2.0, 2.0, math.nan]))
    assert (found.largest.value, found.largest.at) == (2.0, 4)
    found.add(np.array([7]), np.array([2.0]))
    assert found.largest.at == 4
    found.add(np.array([8]), np.array([-2.5]))
    assert (found.largest.value, found.largest.at) == (2.5, 8)
    assert found.rms == pytest.approx(math.sqrt((4 + 4 + 4 + 6.25) / 5))


STEP_AT = 30


def stepping(error: float, delay_ns: int = 400_000, lost: int = 0) -> Rows:
    """A steady speed of 100 rad/s with an error, and readings lost one after the other."""
    rows = plain_rows(CYCLES, reference=100.0, velocity=100.0 - error)
    rows["delay_ns"] = delay_ns
    rows["fate"][STEP_AT : STEP_AT + lost] = 1
    return rows


def judged(base: Rows, other: Rows, **tolerances: float) -> dict[str, tuple[Any, ...]]:
    found = compare_runs([made_run(base), made_run(other)], Tolerances(**tolerances))
    assert found[0].regressions == []
    return {one.name: (one.baseline, one.value, one.tolerance, one.kept) for one in found[1].regressions}


@pytest.mark.parametrize(("tolerance", "kept"), [(2.0, True), (1.0, True), (0.99, False), (0.0, False)])
def test_a_figure_may_be_worse_by_its_tolerance(tolerance: float, kept: bool) -> None:
    base, other = stepping(0.0, lost=1), stepping(0.0, lost=2)
    assert judged(base, other, reading_losses_in_a_row=tolerance) == {
        "reading_losses_in_a_row": (1.0, 2.0, tolerance, kept)
    }
    assert judged(other, base, reading_losses_in_a_row=0.0) == {
        "reading_losses_in_a_row": (2.0, 1.0, 0.0, True)
    }


def test_speeds_apart_are_held_against_nothing() -> None:
    found = judged(
        stepping(0.0), stepping(-1.5), speed_difference_rms_rad_s=1.5, speed_difference_max_rad_s=1.25
    )
    assert found == {
        "speed_difference_rms_rad_s": (0.0, pytest.approx(1.5), 1.5, True),
        "speed_difference_max_rad_s": (0.0, 1.5, 1.25, False),
    }


def test_of_several_axes_the_worst_speed_counts() -> None:
    rows = np.concatenate([stepping(0.0), stepping(0.0)])
    rows["axis"][CYCLES:] = 1
    other = rows.copy()
    other["velocity_rad_s"][5] += 3.0
    other["velocity_rad_s"][CYCLES:] += 1.0
    runs = [made_run(each, ("a", "b")) for each in (rows, other)]
    tolerances = Tolerances(speed_difference_rms_rad_s=0.0, speed_difference_max_rad_s=0.0)
    rms, most = compare_runs(runs, tolerances)[1].regressions
    assert rms.value == pytest.approx(1.0)
    assert most.value == 3.0


def test_what_neither_run_has_is_kept_and_what_one_has_is_not_known() -> None:
    nothing = stepping(0.0)
    nothing["fate"] = 1
    nothing["delay_ns"] = -(2**63)
    both = judged(nothing, nothing, reading_delay_p99_us=0.0, speed_difference_max_rad_s=1.0)
    assert both["reading_delay_p99_us"] == (None, None, 0.0, True)
    assert both["speed_difference_max_rad_s"] == (0.0, None, 1.0, None)
    assert judged(stepping(0.0), nothing, reading_delay_p99_us=0.0)["reading_delay_p99_us"] == (
        400.0,
        None,
        0.0,
        None,
    )
    assert judged(nothing, stepping(0.0), reading_delay_p99_us=0.0)["reading_delay_p99_us"] == (
        None,
        400.0,
        0.0,
        None,
    )


def test_the_figures_are_those_of_a_review() -> None:
    (alone,) = compare_runs([made_run(stepping(2.0, 400_000, lost=3))])
    assert alone.figures | {"overshoot_percent": None} == {
        "speed_error_rms_rad_s": alone.signals.review.figures().speed_error.rms_rad_s,
        "speed_error_peak_percent": alone.signals.review.figures().speed_error.peak_percent,
        "after_load_percent": None,
        "settling_time_ms": 0.0,
        "overshoot_percent": None,
        "recovery_time_ms": None,
        "torque_rms_nm": None,
        "dropouts_percent": 100.0 * 3 / CYCLES,
        "reading_losses_in_a_row": 3.0,
        "command_losses_in_a_row": None,
        "reading_delay_p99_us": 400.0,
        "action_delay_p99_us": None,
        "lateness_p99_us": 0.0,
    }


def test_tolerances_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "tolerances.toml"
    path.write_text("reading_losses_in_a_row = 2\nreading_delay_p99_us = 0.0\n")
    found = load_tolerances(path)
    assert {name: value for name, value in found.model_dump().items() if value is not None} == {
        "reading_losses_in_a_row": 2.0,
        "reading_delay_p99_us": 0.0,
    }
    path.write_text("reading_losses_in_a_row = -1.0\nno_figure = 1.0\n")
    with pytest.raises(BadInputs) as caught:
        load_tolerances(path)
    assert [(error.source, error.key, error.value) for error in caught.value.errors] == [
        (str(path), "reading_losses_in_a_row", -1.0),
        (str(path), "no_figure", 1.0),
    ]
    with pytest.raises(BadInput) as missing:
        load_tolerances(tmp_path / "none.toml")
    assert (missing.value.source, missing.value.key) == ("--tolerances", "")


def three() -> list[Against]:
    """The first, one that differs in one cycle, and one that differs nowhere."""
    base = stepping(0.0)
    other = base.copy()
    other["velocity_rad_s"][50] += 0.25
    other["torque_nm"][50] = 1.0
    runs = [made_run(rows, folder=name) for rows, name in ((base, "one"), (other, "two"), (base, "three"))]
    return compare_runs(
        runs, Tolerances.model_validate({"speed_difference_max_rad_s": 0.125, "reading_losses_in_a_row": 1.0})
    )


def test_a_comparison_is_told_in_lines() -> None:
    lines = comparison_lines(three())
    unsealed = "; unsealed: requested by --unsealed"
    titles = [f"{n}  ling2012 ({name}){unsealed}" for n, name in enumerate(("one", "two", "three"))]
    assert lines[:5] == [*titles, "", lines[4]]
    assert lines[4] == " " * 28 + "           0           1           2"
    assert [line[:28].strip() for line in lines[5:18]] == list(three()[0].figures)
    assert lines[8] == "dropouts_percent" + " " * 12 + "           0           0           0"
    assert lines[9] == "reading_delay_p99_us" + " " * 8 + "         400         400         400"
    assert lines[10].split() == ["torque_rms_nm", "-", "-", "-"]
    assert lines[18:] == [
        "",
        "1 beside 0: 60 cycles of both",
        "  first divergence: axis1, cycle 51 at 0.050000 s, in velocity_rad_s, torque_nm",
        "  axis1 velocity_rad_s       rms    0.03227  largest       0.25 at 0.050 s",
        "  axis1 torque_nm            rms     0.1291  largest          1 at 0.050 s",
        "  reading_losses_in_a_row               0, baseline          0 + 1: within",
        "  speed_difference_max_rad_s         0.25, baseline          0 + 0.125: EXCEEDED",
        "",
        "2 beside 0: 60 cycles of both",
        "  every cycle of both is the same",
        "  reading_losses_in_a_row               0, baseline          0 + 1: within",
        "  speed_difference_max_rad_s            0, baseline          0 + 0.125: within",
    ]


@pytest.mark.parametrize(("count", "told"), [(8, ""), (9, " and 1 more"), (12, " and 4 more")])
def test_more_than_eight_columns_are_counted(count: int, told: str) -> None:
    names = [name for name in NAMES[2:20] if name not in ("fate", "device_time_ns")][:count]
    other = changed({(10, name): 99 for name in names})
    lines = comparison_lines(compare_runs([made_run(random_rows(1, 1)), made_run(other)]))
    line = next(line for line in lines if "first divergence" in line)
    assert line.split(", in ")[1] == ", ".join(names[:8]) + told


def test_what_was_not_measured_in_both_says_so() -> None:
    nothing = stepping(0.0)
    nothing["fate"] = 1
    runs = [made_run(stepping(0.0)), made_run(nothing)]
    lines = comparison_lines(compare_runs(runs, Tolerances(speed_difference_rms_rad_s=0.5)))
    assert (
        lines[-1]
        == "  speed_difference_rms_rad_s            -, baseline          0 + 0.5: not measured in both"
    )


def test_a_comparison_is_plain_values() -> None:
    compared = three()
    told = comparison_json(compared)
    assert told["baseline"] == "one"
    assert [each["run"] for each in told["runs"]] == ["one", "two", "three"]
    first, second, third = told["runs"]
    assert first == {
        "run": "one",
        "seal": "unsealed: requested by --unsealed",
        "figures": compared[0].figures,
        "cycles_of_both": 0,
        "differences": {},
        "first_divergence": None,
        "regressions": [],
    }
    assert second["first_divergence"] == {
        "axis": "axis1",
        "cycle": 51,
        "at_ns": 50_000_000,
        "columns": ("velocity_rad_s", "torque_nm"),
    }
    assert second["differences"]["axis1"]["torque_nm"] == {
        "rms": pytest.approx(math.sqrt(1.0 / CYCLES)),
        "max": 1.0,
        "at_ns": 50_000_000,
    }
    assert second["regressions"][1] == {
        "name": "speed_difference_max_rad_s",
        "baseline": 0.0,
        "value": 0.25,
        "tolerance": 0.125,
        "kept": False,
    }
    assert third["cycles_of_both"] == CYCLES
    empty = comparison_json(compare_runs([made_run(stepping(0.0)), made_run(stepping(0.0)[:0])]))
    nothing = {"rms": None, "max": None, "at_ns": None}
    assert empty["runs"][1]["differences"]["axis1"] == dict.fromkeys(SIGNALS, nothing)
