"""Runs beside each other and over each other, as one Rerun recording of envelopes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from drivers.errors import BadInput
from drivers.timebase import NS_PER_S
from hil.recorded.comparison import Against
from hil.recording.page_series import AXIS_COLORS, GREY, TIMELINE
from hil.recording.rerun_page import framed, stream_into
from hil.reviewing.envelope import Envelope

_PLOTS: Final = (
    ("speed/measured", "Speed [r/min]"),
    ("error/error", "Speed error [r/min]"),
    ("torque/measured", "Torque [N m]"),
    ("delay/delay", "Delay [us]"),
)
_APPLICATION: Final = "servobench comparison"


def write_comparison(found: Sequence[Against], markdown: str, path: Path) -> None:
    """``markdown``: what is told beside the plots. Raises BadInput for a path that cannot be written to."""
    names = [f"{number}_{each.run.folder.name}" for number, each in enumerate(found)]
    try:
        with stream_into(path, _APPLICATION) as stream:
            for place, (name, each) in enumerate(zip(names, found, strict=True)):
                color = AXIS_COLORS[place % len(AXIS_COLORS)]
                for path_of_signal, envelope in each.signals.signals.items():
                    beside = path_of_signal.endswith(("/reference", "/load"))
                    _send(stream, f"/{name}/{path_of_signal}", envelope, name, GREY if beside else color)
            text = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
            stream.log("/differences", text, static=True)
            stream.send_blueprint(_layout(found, names))
    except OSError as error:
        raise BadInput("--out", "", str(path), "a place to write to", str(error)) from None


def _send(
    stream: rr.RecordingStream, path: str, envelope: Envelope, name: str, color: tuple[int, int, int]
) -> None:
    times, values = envelope.points()
    if not times.size:
        return
    style = rr.SeriesLines(names=name, colors=color, widths=1.2, aggregation_policy="MinMax")
    stream.log(path, style, static=True)
    column = rr.TimeColumn(TIMELINE, duration=times.astype("timedelta64[ns]"))
    stream.send_columns(path, [column], rr.Scalars.columns(scalars=values))


def _layout(found: Sequence[Against], names: Sequence[str]) -> rrb.Blueprint:
    axes = list(dict.fromkeys(axis for each in found for axis in each.run.axes))
    end_s = max((_end_s(each) for each in found), default=1.0)
    error_rpm = {axis: _error_rpm(found, axis) for axis in axes}
    overlaid = [_column(names, axis, f"{axis}: overlaid", end_s, error_rpm[axis]) for axis in axes]
    beside = [
        rrb.Horizontal(
            *(_column([name], axis, name, end_s, error_rpm[axis]) for name in names),
            name=f"{axis}: side by side",
        )
        for axis in axes
    ]
    text = rrb.TextDocumentView(origin="/differences", name="Differences")
    return framed(rrb.Horizontal(rrb.Tabs(*overlaid, *beside), text, column_shares=[7, 3]))


def _error_rpm(found: Sequence[Against], axis: str) -> float:
    """How far the errors that count reach, of all runs."""
    reach = max((each.signals.counted_error_rpm.get(axis, 0.0) for each in found), default=0.0)
    limits = [limit for each in found if (limit := each.signals.error_limits_rpm.get(axis)) is not None]
    return max(1.5 * reach, *limits, 1e-9)


def _column(names: Sequence[str], axis: str, title: str, end_s: float, error_rpm: float) -> rrb.Vertical:
    """``error_rpm``: how far the error is seen, so that a step does not flatten it."""
    views = []
    for path, words in _PLOTS:
        paths = [f"/{name}/{axis}/{path}" for name in names]
        if path == "speed/measured":
            paths.append(f"/{names[0]}/{axis}/speed/reference")
        boundary = rrb.TimeRangeBoundary
        window = rrb.TimeRange(
            boundary.absolute(seconds=-0.02 * end_s), boundary.absolute(seconds=1.02 * end_s)
        )
        views.append(
            rrb.TimeSeriesView(
                origin="/",
                contents=[f"+ {each}" for each in paths],
                name=words if len(names) > 1 else f"{title} · {words}",
                axis_x=rrb.TimeAxis(link="Independent", view_range=window),
                axis_y=rrb.ScalarAxis(range=(-error_rpm, error_rpm)) if path == "error/error" else None,
                plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=len(names) > 1),
                time_ranges=rrb.VisibleTimeRange(
                    TIMELINE, start=boundary.infinite(), end=boundary.infinite()
                ),
            )
        )
    return rrb.Vertical(*views, row_shares=[2.0, 1.3, 1.5, 1.2], name=title)


def _end_s(each: Against) -> float:
    ends = [envelope.points()[0] for envelope in each.signals.signals.values()]
    return float(np.max([times[-1] for times in ends if times.size], initial=0)) / NS_PER_S
