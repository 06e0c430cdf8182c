"""A run as a figure for print: which lines stand in which plot, in which unit, and within which limits."""

import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.recorded.paper import histogram_figure, paper_figure, save_figure, svg_text
from servobench.hil.recorded.recorded_run import RunSignals, signals_of
from servobench.hil.reviewing.html_page import html_page
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.metrics import VerdictLimits
from tests.colour_sight import apart
from tests.draws import few_of
from tests.unit.hil.made_runs import made_run
from tests.unit.hil.row_tools import plain_rows

CYCLES = 600
GREY, RED, FIRST, SECOND = "#8e9094", "#b92308", "#1f5fa8", "#fcaa00"
THIRD, FOURTH = "#543afa", "#000000"


def rows(axes: int = 1) -> Rows:
    made = plain_rows(CYCLES * axes, reference=100.0, load=0.25)
    made["axis"] = np.arange(made.size) % axes
    made["sequence"] = 1 + np.arange(made.size) // axes
    made["due_at"] = 1_000_000 * (made["sequence"] - 1)
    made["velocity_rad_s"] = 98.0 - made["axis"]
    made["torque_nm"] = 0.5
    made["delay_ns"] = 100_000 * (1 + made["sequence"] % 5)
    return made


def signals(axes: int = 1, percent: float | None = None, of: Rows | None = None) -> RunSignals:
    names = [f"axis{number}" for number in range(1, axes + 1)]
    limits = VerdictLimits(speed_error_peak_percent_max=percent)
    return signals_of(made_run(rows(axes) if of is None else of, names, limits=limits))


def lines(ax: Any) -> list[tuple[str, str, str, float, float, str]]:
    """Label, colour, kind of dashes, width, largest value, and how points are joined."""
    return [
        (
            "" if str(line.get_label()).startswith("_") else str(line.get_label()),
            to_hex(line.get_color()),
            line.get_linestyle(),
            line.get_linewidth(),
            round(float(np.max(line.get_ydata())), 6),
            line.get_drawstyle(),
        )
        for line in ax.lines
    ]


def test_one_axis_has_four_plots_of_what_was_asked_and_what_was() -> None:
    figure: Any = paper_figure(signals_of(made_run(rows()), 0.1, 0.4))
    speed, error, torque, delay = figure.axes
    assert tuple(figure.get_size_inches()) == pytest.approx((7.2, 6.4))
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "Speed [r/min]",
        "Speed error [r/min]",
        "Torque [N m]",
        "Delay [us]",
    ]
    assert delay.get_xlabel() == "time since the first cycle [s]"
    rpm = [round(value * RPM_PER_RAD_S, 6) for value in (100.0, 98.0, 2.0)]
    assert lines(speed) == [
        ("reference", GREY, "-", 0.9, rpm[0], "steps-post"),
        ("measured", FIRST, "-", 0.8, rpm[1], "default"),
    ]
    assert lines(error) == [("error", FIRST, "-", 0.8, rpm[2], "default")]
    assert lines(torque) == [
        ("load", GREY, "-", 0.9, 0.25, "steps-post"),
        ("measured", FIRST, "-", 0.8, 0.5, "default"),
    ]
    assert lines(delay) == [
        ("delay", FIRST, "-", 0.8, 500.0, "default"),
        ("deadline", RED, "--", 0.8, 2000.0, "default"),
    ]
    assert [ax.get_xlim() for ax in figure.axes] == [(0.1, 0.4)] * 4
    assert delay.get_ylim()[0] == 0.0
    times = speed.lines[0].get_xdata()
    assert (times[0], times[-1]) == pytest.approx((0.1, 0.4))
    told = [[text.get_text() for text in ax.get_legend().get_texts()] for ax in figure.axes]
    assert told == [
        ["reference", "measured"],
        ["error", "not counted"],
        ["load", "measured"],
        ["delay", "deadline"],
    ]
    heights = [ax.get_subplotspec().get_gridspec().get_height_ratios() for ax in figure.axes]
    assert heights == [[2, 1.3, 1.5, 1.2]] * 4
    assert all(not ax.spines[side].get_visible() for ax in figure.axes for side in ("top", "right"))


def test_several_axes_are_told_apart_and_what_was_asked_is_named_once() -> None:
    speed: Any
    speed, error, *_ = paper_figure(signals(2)).axes
    assert [line[:2] for line in lines(speed)] == [
        ("reference", GREY),
        ("axis1: measured", FIRST),
        ("", GREY),
        ("axis2: measured", SECOND),
    ]
    assert [text.get_text() for text in speed.get_legend().get_texts()] == [
        "reference",
        "axis1: measured",
        "axis2: measured",
    ]
    assert [line[:2] for line in lines(error)] == [("axis1: error", FIRST), ("axis2: error", SECOND)]


def test_a_fifth_axis_has_the_colour_of_the_first() -> None:
    _, error, *_ = paper_figure(signals(5)).axes
    assert [line[1] for line in lines(error)] == [FIRST, SECOND, THIRD, FOURTH, FIRST]


def test_its_colours_are_told_apart_by_the_colour_blind() -> None:
    """So are the verdict and the limits of a page."""
    colors = [as_rgb(each) for each in (GREY, RED, FIRST, SECOND, THIRD, FOURTH)]
    assert min(apart(one, other) for one, other in combinations(colors, 2)) >= 40
    page = html_page("", [])
    for good, bad in zip(*(re.findall(rf"--{name}:(#\w+)", page) for name in ("good", "bad")), strict=True):
        assert apart(as_rgb(good), as_rgb(bad)) >= 40


def as_rgb(color: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(color[1:]))


@pytest.mark.parametrize(("percent", "most"), [(None, 3.0), (1.0, 3.0), (3.0, 3.0), (5.0, 5.0)])
def test_the_error_is_drawn_as_far_as_its_limit_or_what_counts(percent: float | None, most: float) -> None:
    """The largest reference is 100 rad/s, the largest error that counts 3 rad/s."""
    _, error, *_ = paper_figure(signals(2, percent)).axes
    reach = 1.4 * most * RPM_PER_RAD_S
    assert error.get_ylim() == pytest.approx((-reach, reach), rel=1e-3)
    limits = [line for line in lines(error) if line[2] == "--"]
    if percent is None:
        assert limits == []
        return
    limit = round(percent * RPM_PER_RAD_S, 6)
    assert limits == [
        ("limits", FIRST, "--", 0.8, limit, "default"),
        ("", FIRST, "--", 0.8, -limit, "default"),
        ("", SECOND, "--", 0.8, limit, "default"),
        ("", SECOND, "--", 0.8, -limit, "default"),
    ]


def with_dropouts(*dropped: int) -> Rows:
    """The rows of one axis, without a reading in the cycles ``dropped``, from 0."""
    made = rows()
    for column in ("velocity_rad_s", "torque_nm"):
        made[column][list(dropped)] = np.nan
    made["fate"][list(dropped)] = 1
    made["delay_ns"][list(dropped)] = NOTHING
    return made


def marked(ax: Any, label: str) -> list[tuple[float, float]]:
    """Begin and end of what is marked over time, s."""
    spans = [each for each in ax.collections if each.get_label() == label]
    ends = [path.get_extents() for each in spans for path in each.get_paths()]
    return [(round(box.x0, 6), round(box.x1, 6)) for box in ends]


def drawn_cycles(line: Any) -> list[int]:
    """In ms; -1: no number, so that nothing is drawn across."""
    pairs = zip(line.get_xdata(), line.get_ydata(), strict=True)
    return [-1 if np.isnan(value) else round(1e3 * at) for at, value in pairs]


def test_a_line_is_interrupted_where_no_reading_came_and_each_dropout_is_marked() -> None:
    dropped = [50, *range(100, 120), CYCLES - 1]
    figure: Any = paper_figure(signals(of=with_dropouts(*dropped)))
    speed, error, torque, delay = figure.axes
    expected = [*range(50), -1, *range(51, 100), -1, *range(120, CYCLES - 1)]
    for line in (speed.lines[1], error.lines[0], torque.lines[1], delay.lines[0]):
        assert drawn_cycles(line) == expected
    for line in (speed.lines[0], torque.lines[0]):
        assert drawn_cycles(line) == list(range(CYCLES)), "what was asked for is known in each cycle"
    assert marked(speed, "dropout") == [(0.05, 0.051), (0.1, 0.12), (0.599, 0.6)]
    heights = [path.get_extents().y1 for each in speed.collections for path in each.get_paths()]
    assert max(heights) < 0.1, "at the foot of the plot"
    assert "dropout" in [text.get_text() for text in speed.get_legend().get_texts()]


@pytest.mark.long
@pytest.mark.parametrize("batch", [1, 7, 1_000_000])
@pytest.mark.parametrize("seed", few_of(range(5), 2))
def test_whichever_way_rows_come_the_dropouts_are_those_of_a_plain_loop(seed: int, batch: int) -> None:
    dice = np.random.default_rng(seed)
    dropped = dice.random(CYCLES) < dice.choice([0.01, 0.3, 0.9])
    run = made_run(with_dropouts(*np.flatnonzero(dropped).tolist()), batch=batch)
    begins, lasted = signals_of(run).gaps["axis1"].points(CYCLES * 1_000_000)
    expected, since = [], None
    for cycle, lost in enumerate([*dropped.tolist(), False]):
        if lost and since is None:
            since = cycle
        if not lost and since is not None:
            expected.append((since, cycle - since))
            since = None
    assert [(at // 10**6, round(ns / 10**6)) for at, ns in zip(begins, lasted, strict=True)] == expected


@pytest.mark.long
def test_of_many_dropouts_in_a_long_run_those_are_gaps_that_can_be_seen() -> None:
    """200 s at 1 kHz: two drawn points are some 60 ms apart, one lost reading in 20 is none to be seen."""
    many = plain_rows(200_000, reference=100.0, velocity=98.0)
    dropped = np.zeros(many.size, bool)
    dropped[::20] = True
    dropped[90_000:91_000] = True
    many["fate"][dropped] = 1
    many["velocity_rad_s"][dropped] = np.nan
    figure: Any = paper_figure(signals(of=many))
    line = figure.axes[0].lines[1]
    gaps = np.flatnonzero(np.isnan(line.get_ydata()))
    (gap,) = gaps
    around = [line.get_xdata()[gap - 1], line.get_xdata()[gap + 1]]
    assert around == pytest.approx([89.999, 91.001], abs=1e-3)


def test_an_error_is_shaded_where_it_is_not_counted_and_its_limit_is_drawn_elsewhere() -> None:
    """The reference steps in cycle 300; the speed has 250 ms to settle."""
    stepped = rows()
    stepped["reference_rad_s"][:300] = 0.0
    stepped["velocity_rad_s"][:300] = 0.0
    _, error, *_ = paper_figure(signals(of=stepped, percent=5.0)).axes
    assert marked(error, "not counted") == [(0.3, 0.55)]
    limit = error.lines[1]
    times, values = np.array(limit.get_xdata()), np.array(limit.get_ydata())
    assert times == pytest.approx([0.0, 0.3, 0.3, 0.55, 0.599])
    assert [None if np.isnan(value) else round(value / RPM_PER_RAD_S, 6) for value in values] == [
        *(5.0, 5.0, None),
        *(5.0, 5.0),
    ]


def test_a_part_of_a_run_is_as_high_as_what_is_in_it() -> None:
    """From 0.4 s on the speed is 98 rad/s, at first it is 20."""
    slow = rows()
    slow["velocity_rad_s"][:300] = 20.0
    begin, end = 0.4, 0.5
    run = made_run(slow, limits=VerdictLimits(speed_error_peak_percent_max=50.0))
    figure: Any = paper_figure(signals_of(run, begin, end))
    speed, error, *_ = figure.axes
    assert min(drawn_cycles(speed.lines[1])) == 400
    assert max(drawn_cycles(speed.lines[1])) == 500
    low, high = (value / RPM_PER_RAD_S for value in speed.get_ylim())
    assert 97.0 < low < 98.0 < 100.0 < high < 101.0
    assert error.get_ylim()[1] == pytest.approx(1.4 * 2.0 * RPM_PER_RAD_S), "a limit of 50 is far away"


def test_an_axis_with_a_position_to_reach_is_drawn_by_its_position() -> None:
    made = rows()
    made["reference_rad_s"] = 0.0
    made["reference_position_rad"] = 2.0
    made["position_rad"] = 1.75
    made["sampled_at"] = made["due_at"]
    run = made_run(made, limits=VerdictLimits(position_error_peak_rad_max=0.5))
    axes = tuple(replace(axis, quantity="position") for axis in run.review.axes)
    run = replace(run, review=replace(run.review, axes=axes))
    figure: Any = paper_figure(signals_of(run))
    position, error, torque, _ = figure.axes
    told = [position.get_ylabel(), error.get_ylabel(), torque.get_ylabel()]
    assert told == ["Position [rad]", "Position error [rad]", "Torque [N m]"]
    assert [(line[0], line[4]) for line in lines(position)] == [("reference", 2.0), ("measured", 1.75)]
    assert [(line[0], line[4]) for line in lines(error)] == [("error", 0.25), ("limit", 0.5), ("", -0.5)]


def test_speeds_and_positions_have_plots_of_their_own_where_axes_are_given_either() -> None:
    run = made_run(rows(2), ["axis1", "axis2"])
    first, second = run.review.axes
    run = replace(run, review=replace(run.review, axes=(first, replace(second, quantity="position"))))
    figure: Any = paper_figure(signals_of(run))
    drawn = {ax.get_ylabel(): [line[:2] for line in lines(ax)] for ax in figure.axes}
    assert drawn == {
        "Speed [r/min]": [("reference", GREY), ("axis1: measured", FIRST)],
        "Speed error [r/min]": [("axis1: error", FIRST)],
        "Position [rad]": [("reference", GREY), ("axis2: measured", SECOND)],
        "Position error [rad]": [("axis2: error", SECOND)],
        "Torque [N m]": [
            ("load", GREY),
            ("axis1: measured", FIRST),
            ("", GREY),
            ("axis2: measured", SECOND),
        ],
        "Delay [us]": [("axis1: delay", FIRST), ("axis2: delay", SECOND), ("deadline", RED)],
    }
    assert figure.get_size_inches()[1] == pytest.approx(6.4 * 9.3 / 6.0)


def test_what_was_not_measured_is_not_drawn() -> None:
    nothing = rows()
    nothing["fate"] = 1
    nothing["delay_ns"] = NOTHING
    figure: Any = paper_figure(signals(of=nothing))
    drawn = [sum(len(line.get_xdata()) > 0 for line in ax.lines) for ax in figure.axes]
    assert drawn == [1, 0, 1, 1], "references, loads and the deadline"
    bars = histogram_figure(signals(of=nothing)).axes[0]
    assert len(bars.patches) == 0


def test_delays_are_counted_for_each_axis_beside_the_deadline() -> None:
    figure: Any = histogram_figure(signals(2))
    assert tuple(figure.get_size_inches()) == pytest.approx((7.2, 3.5))
    assert [ax.get_ylabel() for ax in figure.axes] == ["axis1", "axis2"]
    assert figure.axes[-1].get_xlabel() == "delay of the readings [us]; dashed: the deadline"
    for ax in figure.axes:
        assert ax.get_yscale() == "symlog"
        (deadline,) = ax.lines
        assert list(deadline.get_xdata()) == [2000.0, 2000.0]
        (steps,) = ax.patches
        counts, edges_us, _ = steps.get_data()
        width_us = 500_000 // 60 / 1000
        assert edges_us == pytest.approx(np.arange(500_000 // (500_000 // 60) + 2) * width_us)
        filled = {round(float(edges_us[place]), 3): int(count) for place, count in enumerate(counts) if count}
        assert sum(filled.values()) == CYCLES
        assert list(filled.values()) == [CYCLES // 5] * 5
        for left, delay_us in zip(filled, range(100, 600, 100), strict=True):
            assert left - 0.5 <= delay_us <= left + width_us + 0.5, "a time is known to 0.1 %"


def test_bars_are_no_narrower_than_a_microsecond() -> None:
    short = rows()
    short["delay_ns"] = 5_500
    bars: Any = histogram_figure(signals(of=short)).axes[0].patches[0]
    _, edges_us, _ = bars.get_data()
    assert edges_us == pytest.approx(np.arange(7.0))


@pytest.mark.parametrize("suffix", [".svg", ".png", ".pdf"])
def test_a_figure_is_saved_the_same_each_time(tmp_path: Path, suffix: str) -> None:
    for name in ("one", "two"):
        figure = Figure(figsize=(1.0, 1.0))
        figure.add_axes((0.2, 0.2, 0.7, 0.7)).plot([0.0, 1.0])
        save_figure(figure, tmp_path / f"{name}{suffix}")
    one, two = ((tmp_path / f"{name}{suffix}").read_bytes() for name in ("one", "two"))
    assert len(one) == len(two)
    if suffix == ".svg":
        assert one == two
        assert b"<dc:date>" not in one
    if suffix == ".png":
        assert (int.from_bytes(one[16:20]), int.from_bytes(one[20:24])) == (150, 150)


def test_a_figure_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as caught:
        save_figure(Figure(), tmp_path / "a.gif")
    told = f"OUT: found '{tmp_path / 'a.gif'}', expected a file that ends in .svg, .pdf, .png"
    assert str(caught.value) == told


def test_a_picture_in_a_page_begins_with_its_element() -> None:
    text = svg_text(Figure(figsize=(1.0, 1.0)))
    assert text.startswith("<svg ")
    assert text.rstrip().endswith("</svg>")
