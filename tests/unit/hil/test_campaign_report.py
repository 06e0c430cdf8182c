"""A campaign as one HTML file and as a page of maps: what stands in its tables, cells and colours."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from matplotlib import colormaps
from matplotlib.figure import Figure
from rerun.chunk import RrdReader

from servobench.hil.campaign import page, report
from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, CellMap, cell_maps
from servobench.hil.campaign.plan import GridAxis
from servobench.hil.campaign.worker import FIGURES
from servobench.hil.verdict.summary_text import number
from tests.page_text import page_text

LOAD = GridAxis("load.nm", (), ("0.1", "0.2", "0.4"), (0.1, 0.2, 0.4))
KIND = GridAxis("controller", (), ("pi", "<hinf>"), None)
POINTS = [(load, kind) for load in range(3) for kind in range(2)]
RUNS = 12


def labels(number: int) -> dict[str, Any]:
    load, kind = POINTS[number % 6]
    assert LOAD.numbers is not None
    return {LOAD.title: LOAD.numbers[load], KIND.title: KIND.labels[kind]}


def made(certificate: str = "", adaptive: Any = None) -> Campaign:
    """Two runs at each of six points but the last, where there is one; run 4 came to no peak error."""
    numbers = list(range(RUNS - 1))
    passed = [number % 4 != 1 for number in numbers]
    section = SimpleNamespace(name="a&b")
    stop = SimpleNamespace(confidence=0.95, rate_width=None)
    plan: Any = SimpleNamespace(
        axes=() if adaptive else (LOAD, KIND),
        points=1 if adaptive else 6,
        count=15,
        sweep=SimpleNamespace(stop=stop, adaptive=adaptive, campaign=section),
        own=SimpleNamespace(checks=False),
        point_title=lambda point: "" if adaptive else f"p{point}",
        run=lambda number: SimpleNamespace(labels=labels(number)),
    )
    campaign = Campaign(Path("some where"), plan)
    columns: dict[str, Any] = {name: pa.array([None] * len(numbers), pa.float64()) for name in FIGURES}
    columns[PEAK] = [None if number == 4 else 1.5 + number for number in numbers]
    columns["load_gain_least_rad_s_nm"] = [0.5] * len(numbers)
    columns["load_gain_certified_rad_s_nm"] = [2.0] * len(numbers)
    campaign.__dict__["table"] = pa.table(
        {
            "run": numbers,
            "seed": [100 + number for number in numbers],
            "replicate": [number // 6 for number in numbers],
            "point": [0 if adaptive else number % 6 for number in numbers],
            LOAD.title: [labels(number)[LOAD.title] for number in numbers],
            KIND.title: [labels(number)[KIND.title] for number in numbers],
            "passed": passed,
            "counts": [True] * len(numbers),
            "weight": [1.0] * len(numbers),
            "completed": [number != 4 for number in numbers],
            "outcome": ["passed" if each else "not <passed>" for each in passed],
            "reason": [""] * len(numbers),
            "digest": [f"{number:04x}" for number in numbers],
            "certificate": [certificate] * len(numbers),
            "premises_left": ["delay: 2 ms" if certificate else ""] * len(numbers),
            "premises_unknown": [""] * len(numbers),
            "findings": [[] for _ in numbers],
            **columns,
        }
    )
    return campaign


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps are looked at by themselves."""
    monkeypatch.setattr(report, "heat_maps", lambda _maps, rows, across: f"[{rows.title} x {across.title}]")


def sections(done: Campaign, place: Path) -> dict[str, str]:
    """By title what stands below it, the head by ''."""
    report.write_report(done, place)
    text = place.read_text(encoding="utf-8")
    assert text.startswith(
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'><title>a&amp;b</title><style>"
    )
    assert text.endswith("</body></html>\n")
    parts = re.split(r"<h2>(.*?)</h2>", text.split("<body>")[1].removesuffix("</body></html>\n"))
    return dict(zip(["", *parts[1::2]], parts[::2], strict=True))


def table(text: str) -> list[list[str]]:
    (body,) = re.findall(r"<table>(.*)</table>", text)
    rows = re.findall(r"<tr(?: id='run\d+')?>(.*?)</tr>", body)
    cells = (re.findall(r"<t[hd](?: class='n')?>(.*?)</t[hd]>", row) for row in rows)
    return [[cell.replace("\N{NO-BREAK SPACE}", " ") for cell in row] for row in cells]


@pytest.mark.usefixtures("plain")
def test_the_head_tells_what_the_campaign_came_to(tmp_path: Path) -> None:
    parts = sections(made(), tmp_path / "r.html")
    assert parts[""] == (
        "<h1>Campaign a&amp;b</h1><p class='b'>8 of 11 runs passed, 15 were planned.</p>"
        "<p>Intervals of 95 %; of pass rates: Clopper-Pearson; of quantiles and means: bootstrap. No "
        "interval spans several points of the grid, because they share their draws and seeds.</p>"
        "<p>3 not &lt;passed&gt;, 8 passed</p>"
    )
    assert list(parts) == [
        "",
        "Runs that did not pass",
        "load.nm over controller",
        "Points",
        "Pairs on the same draws and seeds",
        "Figures of all runs",
        "What matters",
        "Worst runs that passed",
    ]
    assert parts["load.nm over controller"] == "<div class='wide'>[load.nm x controller]</div>"


@pytest.mark.usefixtures("plain")
def test_the_tables_are_rows_of_figures(tmp_path: Path) -> None:
    parts = sections(made(), tmp_path / "r.html")
    points = table(parts["Points"])
    assert points[0] == [
        "point",
        "runs",
        "passed",
        "rate",
        "low",
        "high",
        "peak error, 95 % of runs",
        "low",
        "high",
    ]
    assert points[1][:4] == ["p0", "2", "2", "100.00 %"]
    assert points[1][4:6] == [f"{100 * 0.025**0.5:.2f} %", "100.00 %"]
    assert points[2][:3] == ["p1", "2", "1"]
    assert points[5][6:] == ["11.5", "-", "-"], "one run alone has a peak, and no interval"
    assert points[6][:3] == ["p5", "1", "0"]
    worst = table(parts["Runs that did not pass"])
    passed = table(parts["Worst runs that passed"])
    assert worst[0] == passed[0] == ["run", "keys", "seed", "outcome", "peak, %", "again"]
    assert [row[0] for row in worst[1:]] == ["9", "5", "1"]
    assert [row[0] for row in passed[1:]] == ["4", "10", "8", "7", "6", "3", "2"]
    assert worst[1][:5] == [
        "9",
        "load.nm = 0.2, controller = &lt;hinf&gt;",
        "109",
        "not &lt;passed&gt;",
        "10.5",
    ]
    assert passed[1] == [
        "4",
        "load.nm = 0.4, controller = pi",
        "104",
        "passed",
        "-",
        "hil campaign replay some where --run 4",
    ]
    quantiles = table(parts["Figures of all runs"])
    assert quantiles[1] == ["speed_error_peak_percent", "%", "10", "7", "11.05", "11.5"]
    assert "<td class='n'>10</td>" in parts["Figures of all runs"]
    matters = table(parts["What matters"])
    assert [row[0] for row in matters[1:]] == ["load.nm", "controller"]
    assert all(len(row) == 5 for row in matters)
    assert matters[2][2] == "-"
    pairs = table(parts["Pairs on the same draws and seeds"])
    assert pairs[1][:5] == ["pi", "&lt;hinf&gt;", "5", "3", "0"]
    assert pairs[1][5:] == ["0.25", "1 % (1 to 1)"]


@pytest.mark.usefixtures("plain")
def test_a_certificate_has_a_part_of_its_own(tmp_path: Path) -> None:
    found = sections(made("kept"), tmp_path / "r.html")["Held against the certificate"]
    assert "<tr><td>kept</td><td class='n'>11</td></tr>" in found
    assert "<p>Run 0 came nearest, to 25.00 % of what is certified.</p>" in found
    assert "<tr><td>delay</td><td class='n'>11</td></tr>" in found
    none = sections(made("premise left"), tmp_path / "r.html")["Held against the certificate"]
    assert "came nearest" not in none


@pytest.mark.usefixtures("plain")
def test_adaptive_draws_tell_their_failure_probability(tmp_path: Path) -> None:
    head = sections(made(adaptive=SimpleNamespace(round_runs=6)), tmp_path / "r.html")[""]
    assert "of pass rates: weighted draws, normal in the logarithm;" in head
    assert "<p class='b'>failure probability 0.273, " in head
    assert "are of the first round alone, which is drawn as the sweep has it.</p>" in head


def test_words_for_what_is_not_known() -> None:
    assert [report._percent(value) for value in (None, 0.5, 1.0)] == ["-", "50.00 %", "100.00 %"]
    assert [number(value) for value in (None, 0.123456, 999.96, 12345.6)] == ["-", "0.1235", "1000", "12346"]


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    saved: list[Figure] = []
    save = Figure.savefig

    def note(figure: Figure, *given: Any, **named: Any) -> None:
        saved.append(figure)
        save(figure, *given, **named)

    monkeypatch.setattr(Figure, "savefig", note)
    return saved


def test_a_heat_map_shows_rate_and_peak_of_each_cell(pictures: list[Figure]) -> None:
    text = report.heat_maps(cell_maps(made(), LOAD, KIND), LOAD, KIND)
    assert text.startswith("<svg ")
    assert "dc:date" not in text
    (picture,) = pictures
    assert tuple(picture.get_size_inches()) == pytest.approx((12.0, 0.8 + 0.5 * 6))
    rate, peak = picture.axes[:2]
    assert (rate.get_title(), peak.get_title()) == ("pass rate", "largest peak error, %")
    for axes in (rate, peak):
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("controller", "load.nm")
        assert [label.get_text() for label in axes.get_xticklabels()] == ["pi", "<hinf>"]
        assert [label.get_text() for label in axes.get_yticklabels()] == ["0.1", "0.2", "0.4"]
    rates, peaks = rate.images[0], peak.images[0]
    assert (rates.cmap.name, rates.get_clim(), rates.origin) == ("RdYlBu", (0.0, 1.0), "lower")
    assert (peaks.cmap.name, peaks.get_clim()) == ("viridis_r", (6.5, 11.5))
    written = {text.get_position(): text.get_text() for text in rate.texts}
    assert written[0, 0].splitlines() == ["1.00", "(0.16 to 1.00)"]
    assert written[1, 2].splitlines() == ["0.00", "(0.00 to 0.97)", "run 5"]
    assert {text.get_position(): text.get_text() for text in peak.texts} == {
        (0, 0): "7.5 %\nrun 6", (1, 0): "8.5 %\nrun 7", (0, 1): "9.5 %\nrun 8",
        (1, 1): "10.5 %\nrun 9", (0, 2): "11.5 %\nrun 10", (1, 2): "6.5 %\nrun 5",
    }  # fmt: skip


def test_a_cell_is_a_link_to_its_run(tmp_path: Path) -> None:
    report.write_report(made(), tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    links, places = set(re.findall(r'"#(run\d+)"', text)), re.findall(r"<tr id='(run\d+)'>", text)
    assert links == {f"run{number}" for number in (1, 5, 6, 7, 8, 9, 10)}
    assert links <= set(places)


@pytest.mark.long
@pytest.mark.parametrize(("rows", "named"), [(20, True), (21, False)])
def test_beyond_two_hundred_cells_no_number_is_written(rows: int, named: bool) -> None:
    values = np.zeros((rows, 10))
    values[0, 0] = math.nan
    down = GridAxis("a", (), tuple(map(str, range(rows))), None)
    across = GridAxis("b", (), tuple(map(str, range(10))), None)
    nowhere = np.full(values.shape, math.nan)
    cells = CellMap("pass rate", values, nowhere, nowhere, np.full(values.shape, -1), True)
    assert report.heat_maps([cells, cells], down, across).count("<!-- 0.00 -->") == (
        2 * (rows * 10 - 1) if named else 0
    )


GREY = [60, 60, 60]


def shade(name: str, share: float) -> list[int]:
    return [round(255 * part) for part in colormaps[name](share)[:3]]


def cells_of(values: list[list[float]], is_rate: bool, runs: list[list[int]] | None = None) -> CellMap:
    array = np.array(values)
    nowhere = np.full(array.shape, math.nan)
    named = np.full(array.shape, -1) if runs is None else np.array(runs)
    return CellMap("", array, nowhere, nowhere, named, is_rate)


def test_cells_are_coloured_by_their_share() -> None:
    rates = cells_of([[0.0, 0.5], [1.0, math.nan]], True).colors
    assert rates.tolist() == [
        [shade("RdYlBu", 0.0), shade("RdYlBu", 0.5)],
        [shade("RdYlBu", 1.0), GREY],
    ]
    peaks = cells_of([[4.0, 6.0, math.nan, 8.0]], False).colors
    assert peaks.tolist() == [
        [shade("viridis_r", 0.0), shade("viridis_r", 0.5), GREY, shade("viridis_r", 1.0)]
    ]
    assert cells_of([[4.0, 4.0]], False).colors.tolist() == [[shade("viridis_r", 0.5)] * 2]
    assert cells_of([[math.nan]], False).colors.tolist() == [[GREY]]


def test_a_map_without_runs_names_none() -> None:
    nothing = GridAxis("load.nm", (), ("9",), (9.0,))
    for cells in cell_maps(made(), nothing, KIND):
        assert [cells.label(0, 0), cells.label(0, 1)] == ["none", "none"]


def texts(points: rr.Points2D) -> tuple[list[str], list[list[float]]]:
    assert points.labels is not None
    assert points.positions is not None
    return points.labels.as_arrow_array().to_pylist(), points.positions.as_arrow_array().to_pylist()


def test_values_and_keys_stand_in_and_beside_the_cells() -> None:
    values, runs = [[0.25, math.nan], [1.0, 12.3456]], [[3, -1], [-1, 7]]
    rates, errors = cells_of(values, True, runs), cells_of(values, False, runs)
    told, places = texts(page._labels(rates))
    assert told == ["0.25, run 3", "none", "1.00", "12.35, run 7"]
    assert places == [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]]
    assert texts(page._labels(errors))[0][3] == "12.3 %, run 7"
    told, places = texts(page._keys(LOAD, KIND))
    assert told == ["0.1", "0.2", "0.4", "pi", "<hinf>"]
    assert places == [[-0.25, 0.5], [-0.25, 1.5], [-0.25, 2.5], [0.5, 3.25], [1.5, 3.25]]


def entities(path: Path) -> Iterator[str]:
    for chunk in RrdReader(path).stream():
        yield str(chunk.entity_path)


def test_the_page_holds_maps_members_and_a_summary(tmp_path: Path) -> None:
    place = tmp_path / "campaign.rrd"
    page.write_page(made(), place)
    maps = {f"/map0/{kind}/{part}" for kind in ("rate", "peak") for part in ("cells", "values", "keys")}
    found = {entity for entity in entities(place) if not entity.startswith("/__")}
    assert found == maps | {"/members/passed", "/members/failed", "/summary"}
    text = page_text(place)
    assert "pass rate: load.nm (down) over controller" in text
    assert "largest peak error, %: load.nm (down) over controller" in text
    assert "Map 1" in text
    assert "Map 2" not in text
    for chunk in RrdReader(place).stream():
        batch = chunk.to_record_batch()
        if "run" in batch.schema.names:
            numbers = batch.column("run").to_pylist()
            failed = str(chunk.entity_path) == "/members/failed"
            assert numbers == [n for n in range(RUNS - 1) if (n % 4 == 1) == failed and n != 4]


def test_the_summary_leads_from_a_cell_to_a_run() -> None:
    figures = {
        "name": "x",
        "passed": 3,
        "runs": 4,
        "outcomes": {"passed": 3, "failed": 1},
        "worst": [
            {"run": 7, "outcome": "failed", PEAK: 12.345, "load.nm": 0.1, "controller": "pi"},
            {"run": 8, "outcome": "passed", PEAK: None, "load.nm": 0.2, "controller": "pi"},
        ],
    }
    assert page._markdown(made(), figures).split("\n\n") == [
        "# Campaign x",
        "3 of 4 runs passed: 3 passed, 1 failed.",
        "A cell of pass rates names the worst of its runs that did not pass, one of errors that of the "
        "largest. To look into a run, and to lay it beside another:",
        "    hil campaign replay some where --run K --into runs/K\n"
        "    hil view runs/K\n    hil compare runs/K runs/L",
        "| worst run | outcome | peak | keys |\n|--:|:--|--:|:--|\n"
        "| 7 | failed | 12.3 % | load.nm 0.1, controller pi |\n"
        "| 8 | passed | - | load.nm 0.2, controller pi |",
    ]
