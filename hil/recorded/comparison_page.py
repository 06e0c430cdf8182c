"""Runs beside each other and over each other, as one Rerun recording of envelopes."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.recorded.comparison import Against
from servobench.hil.recording.page_series import AXIS_COLORS, GREY, torque_scale
from servobench.hil.recording.plot_scale import (
    COLUMN_PX,
    Range,
    about,
    around_zero,
    fitted,
    gutter,
    plot_heights,
)
from servobench.hil.recording.rerun_page import framed, from_zero, plot, send_line, stream_into
from servobench.hil.reviewing.envelope import Points

_PLOTS: Final = {
    "speed/measured": "Speed [r/min]",
    "error/error": "Speed error [r/min]",
    "torque/measured": "Torque",
    "delay/delay": "Delay [us]",
}
_APPLICATION: Final = "servobench comparison"


def write_comparison(compared: Sequence[Against], markdown: str, path: Path) -> None:
    """``markdown``: what is told beside the plots. Error: OSError."""
    names = [f"{number}_{each.run.folder.name}" for number, each in enumerate(compared)]
    with stream_into(path, _APPLICATION) as stream:
        for place, (name, each) in enumerate(zip(names, compared, strict=True)):
            color = AXIS_COLORS[place % len(AXIS_COLORS)]
            for axis, signal, points in _signals(compared, each):
                shade = GREY if signal.endswith(("/reference", "/load")) else color
                send_line(stream, f"/{name}/{axis}/{signal}", points, name, shade)
        text = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
        stream.log("/differences", text, static=True)
        stream.send_blueprint(_layout(compared, names))


def _signals(compared: Sequence[Against], each: Against) -> Iterator[tuple[str, str, Points]]:
    """Axis, series and points of one of the runs, in the units of the plots."""
    for path in each.signals.signals:
        axis, _, signal = path.partition("/")
        times, values = each.signals.line(axis, signal)
        if times.size:
            yield (
                axis,
                signal,
                (times, values * (_torque(compared, axis)[0] if signal.startswith("torque/") else 1.0)),
            )


def _torque(compared: Sequence[Against], axis: str) -> tuple[float, str]:
    """Scale and unit of all runs, by the first that has the axis."""
    plans = (plan for each in compared for plan in each.run.review.axes if plan.name == axis)
    return torque_scale(next(plans))


def _layout(compared: Sequence[Against], names: Sequence[str]) -> rrb.Blueprint:
    axes = list(dict.fromkeys(axis for each in compared for axis in each.run.axes))
    end_s = max((_end_s(each) for each in compared), default=1.0)
    ranges = {axis: _ranges(compared, axis) for axis in axes}
    units = {axis: _torque(compared, axis)[1] for axis in axes}
    overlaid = [_column(names, axis, f"{axis}: overlaid", end_s, ranges[axis], units[axis]) for axis in axes]
    beside = [
        rrb.Horizontal(
            *(_column([name], axis, name, end_s, ranges[axis], units[axis]) for name in names),
            name=f"{axis}: side by side",
        )
        for axis in axes
    ]
    text = rrb.TextDocumentView(origin="/differences", name="Differences")
    return framed(rrb.Horizontal(rrb.Tabs(*overlaid, *beside), text, column_shares=[7, 3]))


def _ranges(compared: Sequence[Against], axis: str) -> list[Range | None]:
    """Return the ranges of the plots, the same for all runs; that of the error covers what counts: a step
    does not flatten it."""
    values: dict[str, list[float]] = {}
    for each in compared:
        for name, signal, (_, drawn) in _signals(compared, each):
            if name == axis:
                values.setdefault(signal, []).extend((float(np.nanmin(drawn)), float(np.nanmax(drawn))))
    reach = max((each.signals.counted_error().get(axis, 0.0) for each in compared), default=0.0)
    limits = [limit for each in compared if (limit := each.signals.error_limits_rpm.get(axis)) is not None]
    error = around_zero(max(reach, *limits, 1e-9))
    ranges = [error if path == "error/error" else about(values.get(path, ())) for path in _PLOTS]
    return fitted(ranges, COLUMN_PX)


def _column(
    names: Sequence[str],
    axis: str,
    title: str,
    end_s: float,
    ranges: Sequence[Range | None],
    torque_unit: str,
) -> rrb.Vertical:
    """One plot below the other."""
    views = []
    for (path, words), low_high in zip(_PLOTS.items(), ranges, strict=True):
        of_plot = f"{words} [{torque_unit}]" if path == "torque/measured" else words
        paths = [f"/{name}/{axis}/{path}" for name in names]
        if path == "speed/measured":
            paths.append(f"/{names[0]}/{axis}/speed/reference")
        several = len(names) > 1
        contents, of_view = [f"+ {each}" for each in paths], of_plot if several else f"{title} · {of_plot}"
        views.append(
            plot("/", contents, of_view, from_zero(end_s, gutter(low_high)), low_high, legend=several)
        )
    return rrb.Vertical(*views, row_shares=plot_heights(ranges, COLUMN_PX, (0.4, 0.2, 0.2, 0.2)), name=title)


def _end_s(each: Against) -> float:
    ends = [envelope.points()[0] for envelope in each.signals.signals.values()]
    return float(np.max([times[-1] for times in ends if times.size], initial=0)) / NS_PER_S
