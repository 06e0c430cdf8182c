"""What a campaign came to, from a table of made-up runs: against sums and sorts by hand."""

import math
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, cell_maps, figures_of, worst_runs
from tests.unit.hil.made_campaigns import GAIN, LOSS, campaign_of, grid, plan_of

LOADS, KINDS = (0.1, 0.2), ("pi", "hinf", "mpc")
POINTS = list(product((0, 1), (0, 1, 2)))
REPLICATES = 4
RUNS = REPLICATES * len(POINTS)


def labels(number: int) -> dict[str, float | str]:
    load, kind = POINTS[number % len(POINTS)]
    return {LOSS: LOADS[load], GAIN: KINDS[kind]}


PEAKS = [
    5.0 + 3.0 * load - controller + 0.1 * (number // 6)
    for number in range(RUNS)
    for load, controller in [POINTS[number % 6]]
]
PASSED = [peak < 6.0 for peak in PEAKS]
COMPLETED = [number not in (3, 20) for number in range(RUNS)]
UNMEASURED = 20


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """Two losses and three controllers; run 3 and 20 were cut short, of 20 no peak is known."""
    plan = plan_of(seeds=5, stop={"confidence": 0.9}, **grid(LOADS, KINDS))
    rows = [
        {
            "passed": PASSED[number],
            "outcome": "passed" if PASSED[number] else "failed",
            "completed": COMPLETED[number],
            "reason": "" if COMPLETED[number] else "cut short",
            PEAK: None if number == UNMEASURED else PEAKS[number],
            "cycles": 1000.0,
        }
        for number in range(RUNS)
    ]
    return campaign_of(tmp_path_factory.mktemp("campaign"), plan, rows)


def test_the_worst_are_those_that_failed_first_of_them_those_cut_short_then_by_error(done: Campaign) -> None:
    def rank(number: int) -> tuple[bool, bool, float]:
        return PASSED[number], COMPLETED[number], -math.inf if number == UNMEASURED else -PEAKS[number]

    expected = sorted(range(RUNS), key=rank)
    worst = worst_runs(done)
    assert [row["run"] for row in worst] == expected[:10]
    assert [row["run"] for row in worst_runs(done, {expected[0], expected[-1]})] == [
        *expected[:10],
        expected[-1],
    ]
    assert next(row for row in worst if row["run"] == 3) == {
        "run": 3,
        "seed": 1,
        **labels(3),
        "outcome": "failed",
        PEAK: PEAKS[3],
        "reason": "cut short",
        "digest": "0003",
    }


def test_a_map_pools_what_is_not_on_its_axes(done: Campaign) -> None:
    rate, peak = cell_maps(done, *done.plan.axes)
    for number, (load, controller) in enumerate(POINTS):
        here = [n for n in range(RUNS) if POINTS[n % 6] == (load, controller)]
        assert rate.values[load, controller] == sum(PASSED[n] for n in here) / REPLICATES
        assert (rate.low[load, controller], rate.high[load, controller]) == done.pass_rate(number)[1:]
        assert peak.values[load, controller] == max(PEAKS[n] for n in here if n != UNMEASURED)
    pooled, _ = cell_maps(done, *[done.plan.axes[0]] * 2)
    assert np.isnan(pooled.low).all(), "points share their seeds: there is no interval over several"


def test_a_map_names_the_guilty_and_no_run_that_passed(done: Campaign) -> None:
    rate, peak = cell_maps(done, *done.plan.axes)
    for load, controller in POINTS:
        here = [n for n in range(RUNS) if POINTS[n % 6] == (load, controller)]
        run = rate.runs[load, controller]
        failed = [n for n in here if not PASSED[n]]
        assert (run in failed) if failed else run == -1
        assert PEAKS[peak.runs[load, controller]] == max(PEAKS[n] for n in here if n != UNMEASURED)


def test_labels_can_be_read_on_every_cell(done: Campaign) -> None:
    """By a contrast of 4.5 to 1 (WCAG 2.2, 1.4.3), whatever the value."""

    def luminance(color: NDArray[np.uint8]) -> float:
        parts = [part / 12.92 if part <= 0.03928 else ((part + 0.055) / 1.055) ** 2.4 for part in color / 255]
        return float(0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2])

    for cells in cell_maps(done, *done.plan.axes):
        drawn = cells._replace(values=np.append(np.linspace(0.0, 1.0, 500), np.nan)[None])
        for color, ink in zip(drawn.colors[0], drawn.inks[0], strict=True):
            light, dark = sorted((luminance(color), luminance(ink)), reverse=True)
            assert (light + 0.05) / (dark + 0.05) >= 4.5


def test_figures_are_counted_and_of_what_was_measured(done: Campaign) -> None:
    figures = figures_of(done)
    assert (figures["name"], figures["folder"], figures["planned"]) == ("made-up", str(done.folder), 30)
    assert (figures["runs"], figures["passed"], figures["confidence"]) == (RUNS, sum(PASSED), 0.9)
    assert figures["outcomes"] == {"passed": sum(PASSED), "failed": RUNS - sum(PASSED)}
    assert (figures["certificate"], figures["found"]) == ({}, {})
    assert "failure" not in figures
    known = [peak for number, peak in enumerate(PEAKS) if number != UNMEASURED]
    assert figures["quantiles"] == {
        PEAK: {
            "unit": "%",
            "runs": RUNS - 1,
            "50 %": pytest.approx(np.quantile(known, 0.5)),
            "95 %": pytest.approx(np.quantile(known, 0.95)),
            "largest": max(known),
        }
    }
    for number, point in enumerate(figures["points"]):
        here = [n for n in range(RUNS) if n % len(POINTS) == number]
        assert (point["point"], point["keys"], point["runs"]) == (
            f"{LOSS} = {LOADS[POINTS[number][0]]:g}, {GAIN} = {KINDS[POINTS[number][1]]}",
            labels(number),
            REPLICATES,
        )
        assert point["passed"] == sum(PASSED[n] for n in here)
        assert point["rate"] == point["passed"] / REPLICATES


def test_choices_are_compared_pair_by_pair(done: Campaign) -> None:
    pairs = figures_of(done)["pairs"]
    assert [(pair["first"], pair["second"]) for pair in pairs] == [("pi", "hinf"), ("pi", "mpc")]
    for place, pair in enumerate(pairs, start=1):
        firsts = [n for n in range(RUNS) if POINTS[n % 6][1] == 0]
        both = [(n, n + place) for n in firsts]
        assert (pair["key"], pair["pairs"]) == (GAIN, len(both))
        assert pair["passed_first_alone"] == sum(PASSED[a] and not PASSED[b] for a, b in both)
        assert pair["passed_second_alone"] == sum(PASSED[b] and not PASSED[a] for a, b in both)
        assert pair["peak_percent_second_less_first"]["mean"] == pytest.approx(-place)


def test_what_the_error_hangs_on_is_told_by_its_share_of_the_variance(done: Campaign) -> None:
    figures = figures_of(done)["sensitivity"]
    known = np.array([n for n in range(RUNS) if n != UNMEASURED])
    peaks = np.array(PEAKS)[known]
    for key in (LOSS, GAIN):
        values = np.array([str(labels(n)[key]) for n in known])
        within = sum(
            ((peaks[values == value] - peaks[values == value].mean()) ** 2).sum() for value in set(values)
        )
        total = ((peaks - peaks.mean()) ** 2).sum()
        assert figures[key][PEAK]["share_of_variance"] == pytest.approx(1.0 - within / total)
    assert figures[GAIN][PEAK]["rank_correlation"] is None, "a text has no order"
    assert figures[LOSS][PEAK]["rank_correlation"] > 0.5
