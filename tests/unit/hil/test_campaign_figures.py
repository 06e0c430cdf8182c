"""What a campaign came to, from a table of made-up runs: against sums and sorts by hand."""

import math
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, cell_maps, figures_of, worst_runs
from servobench.hil.campaign.plan import GridAxis
from servobench.hil.campaign.worker import FIGURES

LOAD = GridAxis("load.nm", (), ("0.1", "0.2"), (0.1, 0.2))
CONTROLLER = GridAxis("drive.a.controller", (), ("pi", "hinf", "mpc"), None)
POINTS = list(product((0, 1), (0, 1, 2)))
REPLICATES = 4
RUNS = REPLICATES * len(POINTS)


def labels(number: int) -> dict[str, Any]:
    load, controller = POINTS[number % len(POINTS)]
    return {LOAD.title: (0.1, 0.2)[load], CONTROLLER.title: CONTROLLER.labels[controller]}


PEAKS = [
    5.0 + 3.0 * load - controller + 0.1 * (number // 6)
    for number in range(RUNS)
    for load, controller in [POINTS[number % 6]]
]
PASSED = [peak < 6.0 for peak in PEAKS]
COMPLETED = [number not in (3, 20) for number in range(RUNS)]
UNMEASURED = 20


@pytest.fixture
def done() -> Campaign:
    """Two loads and three controllers; run 3 and 20 were cut short, of 20 no peak is known."""
    stop = SimpleNamespace(confidence=0.9, rate_width=None)
    plan: Any = SimpleNamespace(
        axes=(LOAD, CONTROLLER),
        points=len(POINTS),
        count=30,
        sweep=SimpleNamespace(stop=stop, adaptive=None, campaign=SimpleNamespace(name="made up")),
        own=SimpleNamespace(checks=False),
        point_title=lambda point: f"point {point}",
        run=lambda number: SimpleNamespace(labels=labels(number)),
    )
    made = Campaign(Path("somewhere"), plan)
    figures = {name: [math.nan] * RUNS for name in FIGURES}
    figures[PEAK] = [math.nan if number == UNMEASURED else peak for number, peak in enumerate(PEAKS)]
    figures["cycles"] = [1000.0] * RUNS
    made.__dict__["table"] = pa.table(
        {
            "run": list(range(RUNS)),
            "seed": [100 + number for number in range(RUNS)],
            "replicate": [number // len(POINTS) for number in range(RUNS)],
            "point": [number % len(POINTS) for number in range(RUNS)],
            LOAD.title: [labels(number)[LOAD.title] for number in range(RUNS)],
            CONTROLLER.title: [labels(number)[CONTROLLER.title] for number in range(RUNS)],
            "passed": PASSED,
            "completed": COMPLETED,
            "outcome": ["passed" if passed else "failed" for passed in PASSED],
            "reason": ["" if completed else "cut short" for completed in COMPLETED],
            "digest": [f"{number:04x}" for number in range(RUNS)],
            "certificate": [""] * RUNS,
            "findings": [[] for _ in range(RUNS)],
            **figures,
        }
    )
    return made


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
        "seed": 103,
        **labels(3),
        "outcome": "failed",
        PEAK: PEAKS[3],
        "reason": "cut short",
        "digest": "0003",
    }


def test_a_map_pools_what_is_not_on_its_axes(done: Campaign) -> None:
    rate, peak = cell_maps(done, LOAD, CONTROLLER)
    for number, (load, controller) in enumerate(POINTS):
        here = [n for n in range(RUNS) if POINTS[n % 6] == (load, controller)]
        assert rate.values[load, controller] == sum(PASSED[n] for n in here) / REPLICATES
        assert (rate.low[load, controller], rate.high[load, controller]) == done.pass_rate(number)[1:]
        assert peak.values[load, controller] == max(PEAKS[n] for n in here if n != UNMEASURED)
    pooled, _ = cell_maps(done, LOAD, LOAD)
    assert np.isnan(pooled.low).all(), "points share their seeds: there is no interval over several"


def test_a_map_names_the_guilty_and_no_run_that_passed(done: Campaign) -> None:
    rate, peak = cell_maps(done, LOAD, CONTROLLER)
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

    for cells in cell_maps(done, LOAD, CONTROLLER):
        drawn = cells._replace(values=np.append(np.linspace(0.0, 1.0, 500), np.nan)[None])
        for color, ink in zip(drawn.colors[0], drawn.inks[0], strict=True):
            light, dark = sorted((luminance(color), luminance(ink)), reverse=True)
            assert (light + 0.05) / (dark + 0.05) >= 4.5


def test_figures_are_counted_and_of_what_was_measured(done: Campaign) -> None:
    figures = figures_of(done)
    assert (figures["name"], figures["folder"], figures["planned"]) == ("made up", "somewhere", 30)
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
            f"point {number}",
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
        assert (pair["key"], pair["pairs"]) == (CONTROLLER.title, len(both))
        assert pair["passed_first_alone"] == sum(PASSED[a] and not PASSED[b] for a, b in both)
        assert pair["passed_second_alone"] == sum(PASSED[b] and not PASSED[a] for a, b in both)
        assert pair["peak_percent_second_less_first"]["mean"] == pytest.approx(-place)


def test_what_the_error_hangs_on_is_told_by_its_share_of_the_variance(done: Campaign) -> None:
    figures = figures_of(done)["sensitivity"]
    known = np.array([n for n in range(RUNS) if n != UNMEASURED])
    peaks = np.array(PEAKS)[known]
    for key in (LOAD.title, CONTROLLER.title):
        values = np.array([str(labels(n)[key]) for n in known])
        within = sum(
            ((peaks[values == value] - peaks[values == value].mean()) ** 2).sum() for value in set(values)
        )
        total = ((peaks - peaks.mean()) ** 2).sum()
        assert figures[key][PEAK]["share_of_variance"] == pytest.approx(1.0 - within / total)
    assert figures[CONTROLLER.title][PEAK]["rank_correlation"] is None, "a text has no order"
    assert figures[LOAD.title][PEAK]["rank_correlation"] > 0.5
