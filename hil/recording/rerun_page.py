"""What every page of Rerun is framed by, and the file that it goes into."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import rerun as rr
import rerun.blueprint as rrb

from hil.recording.page_series import TIMELINE
from hil.recording.plot_scale import Range


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
    """Lines over the time, all of them from their begin to their end; ``low_high``: None: as they reach."""
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


def from_zero(end_s: float) -> rrb.TimeAxis:
    """From 0 to ``end_s``, with a little margin."""
    boundary = rrb.TimeRangeBoundary
    window = rrb.TimeRange(boundary.absolute(seconds=-0.02 * end_s), boundary.absolute(seconds=1.02 * end_s))
    return rrb.TimeAxis(link="Independent", view_range=window)


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
