"""A campaign as Rerun shows it: the map, every run as a point, and the way from a cell to its worst run."""

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps
from numpy.typing import NDArray

from hil.campaign.campaign import Campaign
from hil.campaign.figures import PEAK, figures_of, grid_of
from hil.campaign.plan import GridAxis
from hil.recording.rerun_page import framed, plot, stream_into

TIMELINE: Final = "run"
"""Runs by their number: a sequence, no time."""
_APPLICATION: Final = "servobench campaign"
_MEMBERS: Final = "/members"
_GREEN, _RED = (112, 224, 128), (255, 74, 96)
_INK: Final = (235, 235, 235)
_GREY: Final = 60
"""Of 255: cells without runs."""
_MARGIN: Final = 0.5
"""Of a cell, about the map."""


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
        worst = _worst_in_cells(done, rows, across)
        for name, values in grid_of(done, rows, across).items():
            is_rate = name == "pass rate"
            path = f"/map{number}/{'rate' if is_rate else 'peak'}"
            stream.log(f"{path}/cells", rr.Image(_colors(values, is_rate=is_rate)), static=True)
            stream.log(f"{path}/values", _labels(values, worst, is_rate=is_rate), static=True)
            stream.log(f"{path}/keys", _keys(rows, across), static=True)
            yield _Map(path, f"{name}: {rows.title} (down) over {across.title}", values.shape)


def _worst_in_cells(done: Campaign, rows: GridAxis, across: GridAxis) -> NDArray[np.int64]:
    """(rows, columns): the run with the largest peak error, or one that did not come to its end; -1: none."""
    peak = done.column(PEAK).astype(float)
    peak = np.where(np.isfinite(peak), peak, np.inf)
    numbers = done.column("run").astype(int)
    worst = np.full((len(rows.labels), len(across.labels)), -1)
    for place in np.ndindex(worst.shape):
        inside = done.at(rows, place[0]) & done.at(across, place[1])
        if inside.any():
            worst[place] = numbers[inside][np.argmax(peak[inside])]
    return worst


def _colors(values: NDArray[np.float64], *, is_rate: bool) -> NDArray[np.uint8]:
    """(rows, columns, 3): a pixel for each cell; one without a value is grey."""
    finite = values[np.isfinite(values)]
    low, high = (0.0, 1.0) if is_rate or not finite.size else (float(finite.min()), float(finite.max()))
    shares = (values - low) / (high - low) if high > low else np.full(values.shape, 0.5)
    shades = colormaps["RdYlGn" if is_rate else "viridis_r"](np.nan_to_num(shares))
    rgb = np.where(np.isfinite(values)[..., None], shades[..., :3], _GREY / 255.0)
    return np.asarray(np.round(255.0 * rgb), np.uint8)


def _labels(values: NDArray[np.float64], worst: NDArray[np.int64], *, is_rate: bool) -> rr.Points2D:
    """In each cell its value, and its worst run."""
    places, labels = [], []
    for (row, column), value in np.ndenumerate(values):
        label = "none" if not np.isfinite(value) else f"{value:.2f}" if is_rate else f"{value:.3g} %"
        places.append((column + 0.5, row + 0.5))
        labels.append(f"{label} · run {worst[row, column]}" if worst[row, column] >= 0 else label)
    return rr.Points2D(places, labels=labels, colors=_INK, radii=0.02, show_labels=True)


def _keys(rows: GridAxis, across: GridAxis) -> rr.Points2D:
    """What varies, beside the cells."""
    places = [(-_MARGIN / 2, row + 0.5) for row in range(len(rows.labels))]
    places += [(column + 0.5, len(rows.labels) + _MARGIN / 2) for column in range(len(across.labels))]
    labels = [*rows.labels, *across.labels]
    return rr.Points2D(places, labels=labels, colors=_INK, radii=0.01, show_labels=True)


def _send_members(stream: rr.RecordingStream, done: Campaign) -> None:
    """Each run's peak error over its number; one without a peak error is not drawn."""
    numbers, peak = done.column("run").astype(np.int64), done.column(PEAK).astype(float)
    passed = done.column("passed").astype(bool)
    for name, kept, color in (("passed", passed, _GREEN), ("failed", ~passed, _RED)):
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
            "A cell of a map names its worst run. To look into a run, and to lay it beside another:",
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
