"""Runs beside each other, and a commissioning, as Rerun shows them: series, colours, ranges and tables."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.loop.cycle_record import FATE_MISSED
from servobench.hil.recorded import commissioning_page as commissioned
from servobench.hil.recorded import comparison_page
from servobench.hil.recorded.commissioning_page import commissioning_page, is_commissioning
from servobench.hil.recorded.comparison import compare_runs
from servobench.hil.recorded.comparison_page import write_comparison
from servobench.hil.recording.page_series import AXIS_COLORS, GREY, torque_scale
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.plain_values import from_plain
from tests.page_text import page_text
from tests.recorded_frames import write_frames
from tests.rrd_columns import view_ranges
from tests.unit.hil.made_runs import MadeRun, made_run
from tests.unit.hil.row_tools import plain_rows


def rows(velocity: float, count: int = 600) -> Rows:
    made = plain_rows(count, reference=100.0, velocity=velocity, load=0.25)
    made["torque_nm"], made["delay_ns"] = 0.5, 400_000
    made["velocity_rad_s"][count // 2] -= 1.0
    return made


def run(folder: str, velocity: float, percent: float | None = None, count: int = 600) -> MadeRun:
    limits = VerdictLimits(speed_error_peak_percent_max=percent)
    return made_run(rows(velocity, count), folder=f"runs/{folder}", limits=limits)


def series(path: Path) -> dict[str, np.ndarray]:
    """By entity its values."""
    found: dict[str, list[float]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name == "Scalars:scalars":
                values = [each[0] for each in batch.column(name).to_pylist() if each]
                found.setdefault(str(chunk.entity_path), []).extend(values)
    return {name: np.array(values) for name, values in found.items()}


def test_each_run_has_its_series_in_the_units_of_the_plots(tmp_path: Path) -> None:
    compared = compare_runs([run("one", 98.0), run("two", 99.0)])
    path = tmp_path / "both.rrd"
    write_comparison(compared, "# what is told", path)
    found = series(path)
    scale, unit = torque_scale(compared[0].run.review.axes[0])
    for name, velocity in (("0_one", 98.0), ("1_two", 99.0)):
        measured = found[f"/{name}/axis1/speed/measured"]
        assert (measured.min(), measured.max()) == pytest.approx(
            ((velocity - 1.0) * RPM_PER_RAD_S, velocity * RPM_PER_RAD_S)
        )
        assert found[f"/{name}/axis1/torque/measured"] == pytest.approx(np.full(600, 0.5 * scale))
        assert found[f"/{name}/axis1/delay/delay"] == pytest.approx(np.full(600, 400.0))
    text = page_text(path)
    assert "# what is told" in text
    for title in ("axis1: overlaid", "axis1: side by side", "Differences", f"Torque [{unit}]"):
        assert title in text
    colors = {AXIS_COLORS[0], AXIS_COLORS[1], GREY}
    packed = {str((red << 24) + (green << 16) + (blue << 8) + 255) for red, green, blue in colors}
    told = {line.split(": ")[1] for line in text.splitlines() if "SeriesLines:colors" in line}
    assert told == packed


def test_no_line_crosses_a_gap_and_time_zero_stands_in_one_place(tmp_path: Path) -> None:
    lossy = rows(98.0)
    lossy["fate"][200:230] = FATE_MISSED
    compared = compare_runs([run("one", 98.0), made_run(lossy, folder="runs/two")])
    write_comparison(compared, "", tmp_path / "both.rrd")
    found = series(tmp_path / "both.rrd")
    for line in ("speed/measured", "error/error", "torque/measured", "delay/delay"):
        whole, broken = (found[f"/{name}/axis1/{line}"] for name in ("0_one", "1_two"))
        assert not np.isnan(whole).any()
        assert np.isnan(broken).any()
    assert not np.isnan(found["/1_two/axis1/speed/reference"]).any()
    begins = {low for low, _ in view_ranges(tmp_path / "both.rrd")}
    assert len(begins) > 1, "a plot with wide labels begins earlier"


def test_the_ranges_are_those_of_all_runs() -> None:
    compared = compare_runs([run("one", 98.0, 5.0), run("two", 90.0, 2.0)])
    speed, error, torque, delay = comparison_page._ranges(compared, "axis1")
    low, high = 89.0 * RPM_PER_RAD_S, 98.0 * RPM_PER_RAD_S
    margin = 0.15 * (high - low)
    assert speed == pytest.approx((low - margin, high + margin))
    reach = 1.3 * 10.0 * RPM_PER_RAD_S
    assert error == pytest.approx((-reach, reach))
    assert (torque, delay) == (None, None), "each has one value alone"
    assert comparison_page._end_s(compared[0]) == pytest.approx(0.599)
    wide = comparison_page._ranges(compare_runs([run("one", 98.0, 50.0)]), "axis1")[1]
    assert wide == pytest.approx((-1300.0, 1300.0)), (
        "620 r/min with its margin, up to where ticks are far apart"
    )


def test_runs_without_rows_have_a_page(tmp_path: Path) -> None:
    compared = compare_runs([run("one", 98.0, count=2), made_run(rows(1.0)[:0], folder="two")])
    write_comparison(compared, "none", tmp_path / "none.rrd")
    assert {name.split("/")[1] for name in series(tmp_path / "none.rrd")} == {"0_one"}
    assert comparison_page._end_s(compared[1]) == 0.0


STEP: dict[str, Any] = {
    "name": "units",
    "title": "Units",
    "verdict": "done",
    "quantities": [],
    "faults": [],
    "reason": "",
    "headline": "",
}


def figures_of(*steps: dict[str, Any], **more: Any) -> commissioned._Figures:
    """As the page reads them out of figures.json."""
    return from_plain(commissioned._Figures, {"steps": steps, **more})


@pytest.mark.parametrize(
    ("changes", "lines"),
    [
        ({}, [""]),
        ({"headline": "as told"}, ["as told"]),
        ({"headline": "as told", "reason": "left out"}, ["left out"]),
        (
            {
                "quantities": [
                    {"name": "inertia", "value": 0.00123456, "uncertainty": 0.0000456, "unit": "kg m^2"},
                    {"name": "turns", "value": 3.0, "uncertainty": None, "unit": ""},
                ]
            },
            ["inertia 0.0012346 +- 4.6e-05 kg m^2; turns 3"],
        ),
        ({"faults": ["a | b"], "headline": "x"}, ["**a / b**"]),
        ({"headline": "word " * 20}, [" ".join(["word"] * 10), " ".join(["word"] * 10)]),
    ],
)
def test_a_step_came_to_figures_faults_or_words(changes: dict[str, Any], lines: list[str]) -> None:
    (step,) = figures_of(STEP | changes).steps
    assert commissioned._result(step) == lines


def test_a_commissioning_is_told_step_by_step() -> None:
    failed = STEP | {"title": "Turn", "verdict": "failed", "faults": ["it did not"]}
    long = STEP | {"headline": "word " * 20}
    header = {"date": "today", "tool": "", "adapter": "can0"}
    figures = figures_of(long, failed, header=header, error="Turn failed")
    words = " ".join(["word"] * 10)
    assert commissioned._markdown(Path("a/drive7"), figures) == (
        "# Commissioning · drive7\n\ntoday, can0\n\n**Turn failed**\n\n| step | | |\n|:--|:--|:--|\n"
        f"| Units | done | {words} |\n| | | {words} |\n| Turn | failed | **it did not** |\n"
    )
    killed = commissioned._markdown(Path("drive7"), commissioned._Figures(()))
    assert killed.split("\n\n")[1] == "It did not come to its end: nothing but frames and events is there."


@pytest.mark.parametrize(
    ("text", "at_ns"),
    [("0 ns is (12.000345) of frames.arrow", 12_000_345_000), ("0 ns is (1.5)", None), ("", None)],
)
def test_the_first_event_tells_where_time_begins(text: str, at_ns: int | None) -> None:
    assert commissioned._zero_ns({"text": text}) == at_ns
    assert commissioned._zero_ns({}) is None


def folder_of(tmp_path: Path, figures: Any = None) -> Path:
    """Two statuswords by SDO, an EMCY, and the events of a step."""
    recording = tmp_path / "recording"
    recording.mkdir()
    frames = ["601#4041600000000000", "581#4B41600040020000", "601#4041600000000000", "581#4B41600031020000"]
    frames += ["081#1043090000000000", "601#4041600000000000", "581#4B41600031020000"]
    lines = [f"(0000000005.{100_000 * place:06d}) can0 {frame}" for place, frame in enumerate(frames)]
    write_frames(recording, "\n".join(lines) + "\n", "TRTRRTR")
    events = [
        {"at_ns": 0, "level": "INFO", "text": "0 ns is (4.900000) in frames.arrow"},
        {"at_ns": 50_000_000, "track": "step", "state": "units"},
        {"at_ns": 900_000_000, "track": "step", "state": "other"},
    ]
    (recording / "events.jsonl").write_text("\n".join(map(json.dumps, events)))
    if figures is not None:
        (tmp_path / "figures.json").write_text(json.dumps(figures))
    return tmp_path


def test_a_page_is_made_of_frames_events_and_figures(tmp_path: Path) -> None:
    assert not is_commissioning(tmp_path)
    folder = folder_of(tmp_path, {"steps": [STEP]})
    assert is_commissioning(folder)
    page = commissioning_page(folder)
    assert page == folder / "recording" / "run.rrd"
    assert not list(page.parent.glob("*.part"))
    text = page_text(page)
    lane = [line for line in text.splitlines() if line.startswith("  ") and "s Units" in line]
    assert lane == ["  0.050000 s Units"]
    assert "  0.900000 s other" in text
    assert "  0.200000 s Switch on disabled" in text
    assert "  0.400000 s Ready to switch on" in text
    states = [line for line in text.splitlines() if line.startswith("/state drive") and "rows" in line]
    assert [line.rsplit(": ")[1] for line in states] == ["2 rows"], "told again it is the same"
    assert "0.500 s  " in text
    assert "WARN" in text
    assert "0.000 s  0 ns is (4.900000) in frames.arrow" in text


def test_a_page_is_made_anew_when_its_sources_are_newer(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    page = commissioning_page(folder)
    first = page.stat().st_mtime_ns
    assert commissioning_page(folder).stat().st_mtime_ns == first
    (folder / "figures.json").write_text(json.dumps({"steps": [STEP]}))
    later = page.stat().st_mtime_ns + 1_000_000
    os.utime(folder / "figures.json", ns=(later, later))
    assert commissioning_page(folder).stat().st_mtime_ns != first
    assert "Units" in page_text(page)


@pytest.mark.parametrize(
    ("figures", "lacking"),
    [
        (["no table"], "Input should be"),
        ({}, "steps"),
        ({"steps": 1}, "steps"),
        ({"steps": [{**STEP, "quantities": [{"name": "inertia"}]}]}, "steps.0.quantities.0.value"),
        ({"steps": [{"name": "units"}]}, "steps.0.title"),
        ({"steps": [], "error": {}}, "error"),
    ],
)
def test_figures_that_are_none_are_refused(tmp_path: Path, figures: Any, lacking: str) -> None:
    folder = folder_of(tmp_path, figures)
    with pytest.raises(BadInput) as caught:
        commissioning_page(folder)
    error = caught.value
    assert (error.source, error.expected) == (str(folder / "figures.json"), "what hil commission wrote")
    assert lacking in str(error.value)
    assert not (folder / "recording" / "run.rrd").exists()


def test_an_event_that_lacks_something_is_passed_over(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    with (folder / "recording" / "events.jsonl").open("a") as events:
        events.write('\n{"at_ns": 1, "track": "step"}\n{"at_ns": 2, "text": "no level"}\n')
    text = page_text(commissioning_page(folder))
    assert "0.000 s  0 ns is (4.900000) in frames.arrow" in text
    assert "no level" not in text


def test_a_place_that_takes_no_page_is_bad_input(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    page = folder / "recording" / "run.rrd"
    page.mkdir()
    os.utime(page, (0.0, 0.0))  # older than what it would be made of
    with pytest.raises(BadInput) as caught:
        commissioning_page(folder)
    assert (caught.value.source, caught.value.value) == ("RUN", str(page))
    assert caught.value.expected == "a place to write to"


def test_signals_are_drawn_in_the_unit_of_their_plot() -> None:
    signals = commissioned._SIGNALS
    assert commissioned._path(Object.VELOCITY_ACTUAL_VALUE) == "/speed/606Ch"
    scales = {index: signals[index].scale for index in signals}
    assert scales[Object.TARGET_VELOCITY] == scales[Object.VELOCITY_ACTUAL_VALUE] == pytest.approx(30 / np.pi)
    assert scales[Object.TARGET_POSITION] == scales[Object.POSITION_ACTUAL_VALUE]
    assert scales[Object.TARGET_POSITION] == pytest.approx(1 / (2 * np.pi))
    assert scales[Object.TARGET_TORQUE] == scales[Object.TORQUE_ACTUAL_VALUE] == 1.0
