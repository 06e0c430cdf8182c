"""Frame of every Rerun page, and the file it is written to."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from servobench.hil.recording.page_series import TIMELINE
from servobench.hil.recording.plot_scale import Range
from servobench.hil.reviewing.envelope import Points


def framed(content: rrb.Container, timeline: str = TIMELINE, *, follows: bool = False) -> rrb.Blueprint:
    """A page of ``content`` alone; ``follows``: its cursor goes with what still comes."""
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following" if follows else "paused"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def plot(
    origin: str,
    contents: str | Sequence[str],
    title: str,
    axis_x: rrb.TimeAxis,
    low_high: Range | None = None,
    *,
    timeline: str = TIMELINE,
    legend: bool | None = None,
    overrides: dict[Any, Any] | None = None,
) -> rrb.TimeSeriesView:
    """Lines over time, whole; ``low_high``: the range of their values, None: as far as they reach."""
    boundary = rrb.TimeRangeBoundary
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=title,
        axis_x=axis_x,
        axis_y=None if low_high is None else rrb.ScalarAxis(range=low_high),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
        overrides=overrides,
        time_ranges=rrb.VisibleTimeRange(timeline, start=boundary.infinite(), end=boundary.infinite()),
    )


def event_list(origin: str) -> rrb.TextLogView:
    """Entries with their level; their texts begin with their time."""
    columns = rrb.archetypes.TextLogColumns(
        timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"]
    )
    return rrb.TextLogView(origin=origin, name="Events", columns=columns)


def from_zero(end_s: float, earlier: float = 0.0) -> rrb.TimeAxis:
    """From 0 to ``end_s``, with a little margin; ``earlier``: so much more at the left, of the width."""
    boundary = rrb.TimeRangeBoundary
    begin_s = -(0.02 + 1.04 * earlier) * end_s
    window = rrb.TimeRange(boundary.absolute(seconds=begin_s), boundary.absolute(seconds=1.02 * end_s))
    return rrb.TimeAxis(link="Independent", view_range=window)


def run_times(instants: NDArray[np.int64] | Sequence[int]) -> list[rr.TimeColumn]:
    """Instants of the run time, ns, (n,)."""
    return [rr.TimeColumn(TIMELINE, duration=np.asarray(instants, np.int64).astype("timedelta64[ns]"))]


def send_line(
    stream: rr.RecordingStream, path: str, points: Points, name: str, color: tuple[int, int, int]
) -> None:
    """A line of a plot, whole."""
    style = rr.SeriesLines(names=name, colors=color, widths=1.2, aggregation_policy="MinMax")
    stream.log(path, style, static=True)
    times, values = points
    stream.send_columns(path, run_times(times), rr.Scalars.columns(scalars=values))


@contextmanager
def stream_into(path: Path, application: str) -> Iterator[rr.RecordingStream]:
    """A stream whose file is whole at the end of the block. Error: OSError."""
    stream = rr.RecordingStream(application, recording_id=uuid4().hex)
    try:
        stream.set_sinks(rr.FileSink(path))
    except (RuntimeError, ValueError) as error:
        raise OSError(str(error)) from error
    yield stream
    stream.flush(timeout_sec=60.0)
    stream.disconnect()
