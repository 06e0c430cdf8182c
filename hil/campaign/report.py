"""A campaign as one self-contained HTML file."""

import io
from collections.abc import Iterator, Sequence
from html import escape
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, CellMap, cell_maps, failure_line, figures_of, worst_runs
from servobench.hil.campaign.plan import GridAxis
from servobench.hil.reviewing.html_page import html_page, html_table
from servobench.hil.verdict.metrics import METRICS
from servobench.hil.verdict.summary_text import number
from servobench.hil.verdict.verdict import VerdictKind

CELLS_NAMED_MAX = 200
"""Beyond this the numbers do not fit the cells of a heat map."""


def write_report(done: Campaign, place: Path) -> None:
    """Write it. Error: OSError."""
    figures = figures_of(done)
    place.write_text(html_page(figures["name"], _parts(done, figures)), encoding="utf-8")


def _parts(done: Campaign, figures: dict[str, Any]) -> Iterator[str]:
    confidence = 100 * figures["confidence"]
    yield f"<h1>Campaign {escape(figures['name'])}</h1>"
    yield (
        f"<p class='b'>{figures['passed']} of {figures['runs']} runs passed, "
        f"{figures['planned']} were planned.</p>"
        f"<p>Intervals of {confidence:g} %; of pass rates: {escape(figures['interval'])}; of quantiles and "
        "means: bootstrap. No interval spans several points of the grid, because they share their draws "
        "and seeds.</p>"
    )
    outcomes = (f"{count} {escape(name)}" for name, count in figures["outcomes"].items())
    yield f"<p>{', '.join(outcomes)}</p>"
    if "failure" in figures:
        yield (
            f"<p class='b'>{escape(failure_line(figures['failure']))}</p><p>Tables of figures and of what "
            "matters are of the first round alone, which is drawn as the sweep has it.</p>"
        )
    pairs = list(combinations(done.plan.axes, 2))
    maps = [cell_maps(done, rows, across) for rows, across in pairs]
    named = {run for of_pair in maps for cells in of_pair for run in cells.runs.ravel().tolist()}
    worst = worst_runs(done, named)
    failed = [each for each in worst if each["outcome"] != VerdictKind.PASSED]
    if worst:
        again = f"hil campaign replay {escape(str(done.folder))} --run K --into runs/K"
        yield f"<p>To look into run K: <code>{again}</code>, then <code>hil view runs/K</code></p>"
    if failed:
        yield f"<h2>Runs that did not pass</h2>{_runs(done, failed)}"
    for (rows, across), of_pair in zip(pairs, maps, strict=True):
        drawn = heat_maps(of_pair, rows, across)
        yield f"<h2>{escape(rows.title)} over {escape(across.title)}</h2><div class='wide'>{drawn}</div>"
    yield "<h2>Points</h2>" + html_table(
        ("point", "runs", "passed", "rate", "low", "high", "peak error, 95 % of runs", "low", "high"),
        map(_point, figures["points"]),
    )
    if figures["certificate"]:
        yield _certificate(figures["certificate"])
    if figures["pairs"]:
        yield _pairs(figures["pairs"])
    yield "<h2>Figures of all runs</h2>" + html_table(
        ("figure", "unit", "runs", "median", "95 %", "largest"), _quantiles(figures)
    )
    if figures["sensitivity"]:
        yield _sensitivity(figures["sensitivity"])
    if passed := [each for each in worst if each["outcome"] == VerdictKind.PASSED]:
        told = "<p>By their peak error; every one that a map names.</p>"
        yield f"<h2>Worst runs that passed</h2>{told}{_runs(done, passed)}"


def _certificate(tally: dict[str, Any]) -> str:
    runs = html_table(("the certificate", "runs"), tally["runs"].items())
    left = html_table(("premise that was left or is not known", "runs"), tally["premises"].items())
    nearest = (
        ""
        if tally["nearest_run"] is None
        else f"<p>Run {tally['nearest_run']} came nearest, to {_percent(tally['nearest_share'])} of what is "
        "certified.</p>"
    )
    return f"<h2>Held against the certificate</h2>{runs}{nearest}{left}"


def _pairs(pairs: list[dict[str, Any]]) -> str:
    titles = ("first", "second", "pairs", "only first passed", "only second passed", "p", "peak, mean change")
    rows = []
    for each in pairs:
        change = each["peak_percent_second_less_first"]
        shift = f"{number(change['mean'])} % ({number(change['low'])} to {number(change['high'])})"
        shift = shift if change["mean"] is not None else "-"
        shown = [
            each[key] for key in ("first", "second", "pairs", "passed_first_alone", "passed_second_alone")
        ]
        rows.append((*shown, f"{each['p_value']:.3g}", shift))
    return "<h2>Pairs on the same draws and seeds</h2>" + html_table(titles, rows)


def _point(each: dict[str, Any]) -> tuple[Any, ...]:
    rates = (_percent(each[key]) for key in ("rate", "low", "high"))
    peaks = (number(value) for value in each[f"{PEAK}_q95"].values())
    return each["point"] or "all", each["runs"], each["passed"], *rates, *peaks


def _quantiles(figures: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for name, each in figures["quantiles"].items():
        values = (number(each[key]) for key in ("50 %", "95 %", "largest"))
        yield METRICS[name].title if name in METRICS else name, each["unit"], each["runs"], *values


def _sensitivity(figures: dict[str, Any]) -> str:
    titles = ("key", "of passing: share of variance", "rank correlation", "of the peak error: share", "rank")
    rows = []
    for key, each in figures.items():
        of_passing, of_peak = (
            (_percent(one["share_of_variance"]), number(one["rank_correlation"])) for one in each.values()
        )
        rows.append((key, *of_passing, *of_peak))
    return "<h2>What matters</h2>" + html_table(titles, rows)


def _runs(done: Campaign, runs: list[dict[str, Any]]) -> str:
    rows = []
    for each in runs:
        keys = ", ".join(f"{key} = {_value(each[key])}" for key in done.plan.run(0).labels)
        rows.append((each["run"], keys, each["seed"], each["outcome"], number(each[PEAK])))
    titles = ("run", "keys", "seed", "outcome", "peak, %")
    return html_table(titles, rows, [f"run{each['run']}" for each in runs])


def heat_maps(maps: Sequence[CellMap], rows: GridAxis, across: GridAxis) -> str:
    """Return the maps as one SVG; a cell links to the run that it names."""
    picture = Picture(figsize=(12.0, 0.8 + 0.5 * max(6, len(rows.labels))), layout="constrained")
    for axes, cells in zip(picture.subplots(1, len(maps)), maps, strict=True):
        _heat_map(axes, cells, rows, across)
    text = io.StringIO()
    picture.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :].replace(' target="_blank"', "")


def _heat_map(axes: Axes, cells: CellMap, rows: GridAxis, across: GridAxis) -> None:
    image = axes.imshow(
        cells.values,
        origin="lower",
        aspect="auto",
        cmap=cells.palette,
        vmin=0.0 if cells.is_rate else None,
        vmax=1.0 if cells.is_rate else None,
    )
    axes.set(title=cells.title, xlabel=across.title, ylabel=rows.title)
    axes.set_xticks(range(len(across.labels)), across.labels, rotation=30, ha="right")
    axes.set_yticks(range(len(rows.labels)), rows.labels)
    axes.figure.colorbar(image, ax=axes)
    if cells.values.size <= CELLS_NAMED_MAX:
        for row, column in np.argwhere(np.isfinite(cells.values)):
            lines = cells.label(row, column)
            ink = cells.inks[row, column] / 255.0
            run = cells.runs[row, column]
            url = f"#run{run}" if run >= 0 else None
            axes.text(column, row, lines, ha="center", va="center", color=ink, fontsize="small", url=url)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} %"


def _value(of: Any) -> str:
    """Return the value of a key: words as they are."""
    return of if isinstance(of, str) else number(of)
