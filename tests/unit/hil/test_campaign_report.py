"""A campaign as one HTML file and as a page of maps: what stands in its tables, cells and colours."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.figure import Figure
from rerun.chunk import RrdReader

from servobench.hil.campaign import page, report
from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, CellMap, cell_maps
from servobench.hil.campaign.plan import GridAxis
from servobench.hil.verdict.summary_text import number
from tests.page_text import page_text
from tests.unit.hil.made_campaigns import GAIN, INERTIA, LOSS, campaign_of, grid, plan_of

LOADS, KINDS = (0.1, 0.2, 0.4), ("pi", "<hinf>")
RUNS = 12


def made(folder: Path, certificate: str = "", **tables: Any) -> Campaign:
    """Eleven runs; run 4 came to no peak error."""
    rows = [
        {
            "passed": number % 4 != 1,
            "outcome": "passed" if number % 4 != 1 else "not <passed>",
            "completed": number != 4,
            "certificate": certificate,
            "premises_left": "delay: 2 ms" if certificate else "",
            PEAK: None if number == 4 else 1.5 + number,
            "load_gain_least_rad_s_nm": 0.5,
            "load_gain_certified_rad_s_nm": 2.0,
            "counts": True,
        }
        for number in range(RUNS - 1)
    ]
    return campaign_of(folder, plan_of(**tables), rows)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """Two runs at each of six points but the last, where there is one."""
    return made(tmp_path_factory.mktemp("campaign") / "some where", seeds=3, **grid(LOADS, KINDS))


@pytest.fixture(scope="module")
def pictures() -> Iterator[list[Figure]]:
    saved: list[Figure] = []
    save = Figure.savefig

    def note(figure: Figure, *given: Any, **named: Any) -> None:
        saved.append(figure)
        save(figure, *given, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", note)
        yield saved


@pytest.fixture(scope="module")
def reported(mapped: Campaign, pictures: list[Figure]) -> str:
    """The file's text; what was drawn for it is in ``pictures``."""
    place = mapped.folder / "r.html"
    report.write_report(mapped, place)
    assert len(pictures) == 1
    return place.read_text(encoding="utf-8")


def sections(text: str) -> dict[str, str]:
    """By title what stands below it, the head by ''."""
    assert text.startswith(
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width'><title>made-up</title><style>"
    )
    assert text.endswith("</body></html>\n")
    parts = re.split(r"<h2>(.*?)</h2>", text.split("<body>")[1].removesuffix("</body></html>\n"))
    return dict(zip(["", *parts[1::2]], parts[::2], strict=True))


def table(text: str) -> list[list[str]]:
    (body,) = re.findall(r"<table>(.*)</table>", text)
    rows = re.findall(r"<tr(?: id='run\d+')?>(.*?)</tr>", body)
    cells = (re.findall(r"<t[hd](?: class='n')?>(.*?)</t[hd]>", row) for row in rows)
    return [[cell.replace("\N{NO-BREAK SPACE}", " ") for cell in row] for row in cells]


def test_the_head_tells_what_the_campaign_came_to(mapped: Campaign, reported: str) -> None:
    parts = sections(reported)
    assert parts[""] == (
        "<h1>Campaign made-up</h1><p class='b'>8 of 11 runs passed, 18 were planned.</p>"
        "<p>Intervals of 95 %; of pass rates: Clopper-Pearson; of quantiles and means: bootstrap. No "
        "interval spans several points of the grid, because they share their draws and seeds.</p>"
        "<p>3 not &lt;passed&gt;, 8 passed</p>"
        f"<p>To look into run K: <code>hil campaign replay {mapped.folder} --run K --into runs/K</code>, "
        "then <code>hil view runs/K</code></p>"
    )
    assert list(parts) == [
        "",
        "Runs that did not pass",
        f"{LOSS} over {GAIN}",
        "Points",
        "Pairs on the same draws and seeds",
        "Figures of all runs",
        "What matters",
        "Worst runs that passed",
    ]
    assert parts[f"{LOSS} over {GAIN}"].startswith("<div class='wide'><svg ")
    assert "dc:date" not in reported


def test_the_tables_are_rows_of_figures(reported: str) -> None:
    parts = sections(reported)
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
    assert points[1][:4] == [f"{LOSS} = 0.1, {GAIN} = pi", "2", "2", "100.00 %"]
    assert points[1][4:6] == [f"{100 * 0.025**0.5:.2f} %", "100.00 %"]
    assert points[2][1:3] == ["2", "1"]
    assert points[5][6:] == ["11.5", "-", "-"], "one run alone has a peak, and no interval"
    assert points[6][1:3] == ["1", "0"]
    worst = table(parts["Runs that did not pass"])
    passed = table(parts["Worst runs that passed"])
    assert worst[0] == passed[0] == ["run", "keys", "seed", "outcome", "peak, %"]
    assert [row[0] for row in worst[1:]] == ["9", "5", "1"]
    assert [row[0] for row in passed[1:]] == ["4", "10", "8", "7", "6", "3", "2"]
    assert worst[1][:5] == [
        "9",
        f"{LOSS} = 0.2, {GAIN} = &lt;hinf&gt;",
        "2",
        "not &lt;passed&gt;",
        "10.5",
    ]
    assert passed[1] == [
        "4",
        f"{LOSS} = 0.4, {GAIN} = pi",
        "1",
        "passed",
        "-",
    ]
    quantiles = table(parts["Figures of all runs"])
    assert quantiles[1] == ["speed error, peak", "%", "10", "7", "11.05", "11.5"]
    assert "<td class='n'>10</td>" in parts["Figures of all runs"]
    matters = table(parts["What matters"])
    assert [row[0] for row in matters[1:]] == [LOSS, GAIN]
    assert all(len(row) == 5 for row in matters)
    assert matters[2][2] == "-"
    pairs = table(parts["Pairs on the same draws and seeds"])
    assert pairs[1][:5] == ["pi", "&lt;hinf&gt;", "5", "3", "0"]
    assert pairs[1][5:] == ["0.25", "1 % (1 to 1)"]


def test_a_certificate_has_a_part_of_its_own(tmp_path: Path) -> None:
    def told(state: str) -> str:
        report.write_report(made(tmp_path / state, state, seeds=11), tmp_path / "r.html")
        return sections((tmp_path / "r.html").read_text())["Held against the certificate"]

    kept = told("kept")
    assert "<tr><td>kept</td><td class='n'>11</td></tr>" in kept
    assert "<p>Run 0 came nearest, to 25.00 % of what is certified.</p>" in kept
    assert "<tr><td>delay</td><td class='n'>11</td></tr>" in kept
    assert "came nearest" not in told("premise left")


def test_adaptive_draws_tell_their_failure_probability(tmp_path: Path) -> None:
    drawn: dict[str, Any] = {"draw": [INERTIA], "adaptive": {"guide": PEAK, "round_runs": 20}}
    report.write_report(made(tmp_path / "adaptive", seeds=40, **drawn), tmp_path / "r.html")
    head = sections((tmp_path / "r.html").read_text())[""]
    assert "of pass rates: weighted draws, normal in the logarithm;" in head
    assert "<p class='b'>failure probability 0.273, " in head
    assert "are of the first round alone, which is drawn as the sweep has it.</p>" in head


def test_words_for_what_is_not_known() -> None:
    assert [number(value) for value in (None, 0.123456, 999.96, 12345.6)] == ["-", "0.1235", "1000", "12346"]


@pytest.mark.usefixtures("reported")
def test_a_heat_map_shows_rate_and_peak_of_each_cell(pictures: list[Figure]) -> None:
    picture = pictures[0]
    assert tuple(picture.get_size_inches()) == pytest.approx((12.0, 0.8 + 0.5 * 6))
    rate, peak = picture.axes[:2]
    assert (rate.get_title(), peak.get_title()) == ("pass rate", "largest peak error, %")
    for axes in (rate, peak):
        assert (axes.get_xlabel(), axes.get_ylabel()) == (GAIN, LOSS)
        assert [label.get_text() for label in axes.get_xticklabels()] == [*KINDS]
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


def test_a_cell_is_a_link_to_its_run(reported: str) -> None:
    links, places = set(re.findall(r'"#(run\d+)"', reported)), re.findall(r"<tr id='(run\d+)'>", reported)
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


def test_a_map_without_runs_names_none(mapped: Campaign) -> None:
    nothing = GridAxis(LOSS, (), ("9",), (9.0,))
    for cells in cell_maps(mapped, nothing, mapped.plan.axes[1]):
        assert [cells.label(0, 0), cells.label(0, 1)] == ["none", "none"]


@pytest.fixture(scope="module")
def paged(mapped: Campaign) -> Path:
    page.write_page(mapped, mapped.folder / "campaign.rrd")
    return mapped.folder / "campaign.rrd"


def points_of(place: Path, entity: str) -> dict[str, Any]:
    """The points of an entity, by component."""
    for chunk in RrdReader(place).stream():
        batch = chunk.to_record_batch()
        columns = {name.rpartition(":")[2]: name for name in batch.schema.names}
        if str(chunk.entity_path) == entity and "labels" in columns:
            return {part: batch.column(name).to_pylist()[0] for part, name in columns.items()}
    raise LookupError(entity)


def told_at(place: Path, entity: str) -> dict[tuple[float, float], str]:
    """The texts of an entity by where they stand."""
    points = points_of(place, entity)
    return dict(zip(map(tuple, points["positions"]), points["labels"], strict=True))


def in_cell(told: dict[tuple[float, float], str], row: int, column: int) -> list[str]:
    """The lines in a cell, from above."""
    inside = [(y, text) for (x, y), text in told.items() if (int(x), int(y)) == (column, row)]
    return [text for _, text in sorted(inside)]


def test_values_and_keys_stand_in_and_beside_the_cells(paged: Path) -> None:
    rates, peaks = (told_at(paged, f"/map0/{kind}/values") for kind in ("rate", "peak"))
    assert in_cell(rates, 0, 0) == ["1.00", "(0.16 to 1.00)"]
    assert in_cell(rates, 2, 1) == ["0.00", "(0.00 to 0.97)", "run 5"]
    assert in_cell(peaks, 1, 1) == ["10.5 %", "run 9"]
    assert all(in_cell(each, row, column) for each in (rates, peaks) for row, column in np.ndindex(3, 2))
    assert told_at(paged, "/map0/rate/keys") == {
        (-0.25, 0.5): "0.1", (-0.25, 1.5): "0.2", (-0.25, 2.5): "0.4",
        (0.5, 3.25): "pi", (1.5, 3.25): "<hinf>",
    }  # fmt: skip


@pytest.mark.parametrize(("losses", "shown"), [(7, True), (8, False)])
def test_labels_that_would_cover_one_another_wait_for_the_pointer(
    tmp_path: Path, losses: int, shown: bool
) -> None:
    axes = grid([0.01 * place for place in range(losses)], ["pi"])
    page.write_page(campaign_of(tmp_path / "out", plan_of(**axes), [{}] * losses), tmp_path / "page.rrd")
    assert points_of(tmp_path / "page.rrd", "/map0/rate/values")["show_labels"] == [shown]


def test_the_page_holds_maps_members_and_a_summary(paged: Path) -> None:
    maps = {f"/map0/{kind}/{part}" for kind in ("rate", "peak") for part in ("cells", "values", "keys")}
    found = {str(chunk.entity_path) for chunk in RrdReader(paged).stream()}
    assert {each for each in found if not each.startswith("/__")} == maps | {
        "/members/passed", "/members/failed", "/summary",
    }  # fmt: skip
    text = page_text(paged)
    assert f"pass rate: {LOSS} (down) over {GAIN}" in text
    assert f"largest peak error, %: {LOSS} (down) over {GAIN}" in text
    assert "Map 1" in text
    assert "Map 2" not in text
    for chunk in RrdReader(paged).stream():
        batch = chunk.to_record_batch()
        if "run" in batch.schema.names:
            numbers = batch.column("run").to_pylist()
            failed = str(chunk.entity_path) == "/members/failed"
            assert numbers == [n for n in range(RUNS - 1) if (n % 4 == 1) == failed and n != 4]


def test_the_summary_leads_from_a_cell_to_a_run(paged: Path, mapped: Campaign) -> None:
    text = page_text(paged)
    assert "# Campaign made-up\n\n8 of 11 runs passed: 3 not <passed>, 8 passed.\n\n" in text
    assert f"    hil campaign replay {mapped.folder} --run K --into runs/K\n    hil view runs/K\n" in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert rows[0] == "| worst run | outcome | peak | keys |"
    assert f"| 9 | not <passed> | 10.5 % | {LOSS} 0.2, {GAIN} <hinf> |" in rows
    assert f"| 4 | passed | - | {LOSS} 0.4, {GAIN} pi |" in rows
