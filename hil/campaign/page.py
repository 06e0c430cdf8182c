"""A campaign in Rerun: the map, every run as a point, and the way from a cell to its worst run."""

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, CellMap, cell_maps, figures_of
from servobench.hil.campaign.plan import GridAxis
from servobench.hil.recording.page_series import BLUE, RED
from servobench.hil.recording.rerun_page import framed, plot, stream_into

TIMELINE: Final = "run"
"""Runs by their number: a sequence, no time."""
_APPLICATION: Final = "servobench campaign"
_MEMBERS: Final = "/members"

_INK: Final = (235, 235, 235)
_MARGIN: Final = 0.5
"""Margin around the map, in cells."""
_LINE: Final = 0.27
"""Distance of the lines in a cell, in cells: three of them fill it."""
_LABELLED_MAX: Final = 7
"""Cells down or across: of more, labels would cover one another; a point that is pointed at tells its own."""


class _Map(NamedTuple):
    path: str
    title: str
    shape: tuple[int, ...]
    """Rows and columns."""


def write_page(done: Campaign, place: Path) -> None:
    """Write it. Error: OSError."""
    figures = figures_of(done)
    with stream_into(place, _APPLICATION) as stream:
        maps = list(_send_maps(stream, done))
        _send_members(stream, done)
        text = rr.TextDocument(_markdown(done, figures), media_type=rr.MediaType.MARKDOWN)
        stream.log("/summary", text, static=True)
        stream.send_blueprint(_layout(maps, done.table.num_rows))


def _send_maps(stream: rr.RecordingStream, done: Campaign) -> Iterator[_Map]:
    for number, (rows, across) in enumerate(combinations(done.plan.axes, 2)):
        for cells in cell_maps(done, rows, across):
            path = f"/map{number}/{'rate' if cells.is_rate else 'peak'}"
            stream.log(f"{path}/cells", rr.Image(cells.colors), static=True)
            stream.log(f"{path}/values", _labels(cells), static=True)
            stream.log(f"{path}/keys", _keys(rows, across), static=True)
            yield _Map(path, f"{cells.title}: {rows.title} (down) over {across.title}", cells.values.shape)


def _labels(cells: CellMap) -> rr.Points2D:
    """Label each cell by a point for each line, as the viewer cuts a label off behind its first line."""
    lines = [
        (line, (column + 0.5, row + 0.5 + _LINE * (2 * number - last) / 2), cells.inks[row, column])
        for row, column in np.ndindex(cells.values.shape)
        for texts in [cells.label(row, column).split("\n")]
        for last in [len(texts) - 1]
        for number, line in enumerate(texts)
    ]
    labels, places, inks = zip(*lines, strict=True)
    return rr.Points2D(
        places,
        labels=labels,
        colors=inks,
        radii=0.01,
        show_labels=max(cells.values.shape) <= _LABELLED_MAX,
    )


def _keys(rows: GridAxis, across: GridAxis) -> rr.Points2D:
    """Label the varied values beside the cells."""
    places = [(-_MARGIN / 2, row + 0.5) for row in range(len(rows.labels))]
    places += [(column + 0.5, len(rows.labels) + _MARGIN / 2) for column in range(len(across.labels))]
    labels = [*rows.labels, *across.labels]
    return rr.Points2D(places, labels=labels, colors=_INK, radii=0.01, show_labels=True)


def _send_members(stream: rr.RecordingStream, done: Campaign) -> None:
    """Send each run's peak error over its number; one without a peak error is not drawn."""
    numbers, peak = done.column("run").astype(np.int64), done.column(PEAK).astype(float)
    passed = done.column("passed").astype(bool)
    for name, kept, color in (("passed", passed, BLUE), ("failed", ~passed, RED)):
        chosen = kept & np.isfinite(peak)
        path = f"{_MEMBERS}/{name}"
        style = rr.SeriesPoints(names=name, colors=color, marker_sizes=3.0)
        stream.log(path, style, static=True)
        if chosen.any():
            column = rr.TimeColumn(TIMELINE, sequence=numbers[chosen])
            stream.send_columns(path, [column], rr.Scalars.columns(scalars=peak[chosen]))


def _markdown(done: Campaign, figures: dict[str, Any]) -> str:
    outcomes = ", ".join(f"{count} {name}" for name, count in figures["outcomes"].items())
    rows = [
        f"| {each['run']} | {each['outcome']} | {_peak(each[PEAK])} | "
        f"{', '.join(f'{key} {each[key]}' for key in done.plan.run(0).labels)} |"
        for each in figures["worst"]
    ]
    return "\n\n".join(
        [
            f"# Campaign {figures['name']}",
            f"{figures['passed']} of {figures['runs']} runs passed: {outcomes}.",
            "A cell of pass rates names the worst of its runs that did not pass, one of errors that of the "
            "largest. To look into a run, and to lay it beside another:",
            f"    hil campaign replay {done.folder} --run K --into runs/K\n"
            "    hil view runs/K\n    hil compare runs/K runs/L",
            "\n".join(["| worst run | outcome | peak | keys |", "|--:|:--|--:|:--|", *rows]),
        ]
    )


def _peak(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g} %"


def _layout(maps: list[_Map], runs: int) -> rrb.Blueprint:
    boundary = rrb.TimeRangeBoundary
    window = rrb.TimeRange(
        boundary.absolute(seq=-max(1, runs // 50)), boundary.absolute(seq=runs + runs // 50)
    )
    views: list[rrb.View | rrb.Container] = [
        rrb.Spatial2DView(
            origin=each.path,
            name=each.title,
            visual_bounds=rrb.VisualBounds2D(
                x_range=(-_MARGIN, each.shape[1] + 0.1), y_range=(-0.1, each.shape[0] + _MARGIN)
            ),
        )
        for each in maps
    ]
    pairs = [
        rrb.Horizontal(*views[place : place + 2], name=f"Map {1 + place // 2}")
        for place in range(0, len(views), 2)
    ]
    axis, title = (
        rrb.TimeAxis(link="Independent", view_range=window),
        "Peak error of every run, % of the reference",
    )
    members = plot(_MEMBERS, "$origin/**", title, axis, timeline=TIMELINE)
    left = rrb.Vertical(rrb.Tabs(*pairs), members, row_shares=[6, 4]) if pairs else members
    summary = rrb.TextDocumentView(origin="/summary", name="What came of it")
    return framed(rrb.Horizontal(left, summary, column_shares=[7, 3]), TIMELINE)
