"""How the Rerun viewer lays a run out: states, plots of each axis, verdict, delay histogram, events."""

import rerun.blueprint as rrb

from drivers.rotation import RPM_PER_RAD_S
from hil.rows.recording_plan import RecordingPlan
from hil.verdict.summary import Summary

TIMELINE = "run_time"
STATE_ROOT, VERDICT, HISTOGRAM, EVENTS = "/state", "/verdict", "/delay_histogram", "/events"
SUMMARY = "/summary"
"""The object of summary.json, as text; in no view."""
_STATES_SHARE, _LANE_SHARE, _STATES_SHARE_MAX = 0.055, 0.04, 0.5
"""Of the height of a window of 1080 lines, so that each lane is seen whole."""


def layout(plan: RecordingPlan, summary: Summary | None = None, delay_least_us: float = 0.0) -> rrb.Blueprint:
    """The layout while the run goes on, or with ranges that fit the figures once they are known.

    ``delay_least_us``: below 0 where a drive's clock was wrong; it is to be seen.
    """
    names = [axis.name for axis in plan.review.axes]
    delay_range = _delay_range(plan, summary, delay_least_us)
    plots = [_axis_plots(name, summary, delay_range, name in plan.channels) for name in names]
    # One lane for each axis' drive and link, one for the phase, one for the host
    lanes = 2 * len(names) + 2
    states_share = min(_STATES_SHARE + _LANE_SHARE * lanes, _STATES_SHARE_MAX)
    states = rrb.StateTimelineView(
        origin=STATE_ROOT, name="States", time_view=rrb.TimeAxis(link="LinkToGlobal")
    )
    left = rrb.Vertical(
        states,
        plots[0] if len(plots) == 1 else rrb.Tabs(*plots),
        row_shares=[states_share, 1.0 - states_share],
    )
    columns = rrb.archetypes.TextLogColumns(
        timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"]
    )
    right = rrb.Vertical(
        rrb.TextDocumentView(origin=VERDICT, name="Verdict"),
        rrb.BarChartView(
            origin=HISTOGRAM,
            name="Delay histogram: readings over us",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        rrb.TextLogView(origin=EVENTS, name="Events", columns=columns),
        row_shares=[4.9, 2.0, 2.6],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[7, 3]),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if summary is None else "paused"
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _axis_plots(
    name: str, summary: Summary | None, delay_range: tuple[float, float] | None, has_channels: bool
) -> rrb.Vertical:
    own = [_plot(f"/{name}/controller", "Told by the controller")] if has_channels else []
    return rrb.Vertical(
        _plot(f"/{name}/speed", "Speed [rpm]"),
        _plot(f"/{name}/error", "Speed error [rpm]", _error_range(summary), legend=False),
        _plot(f"/{name}/torque", "Torque [N m]"),
        _plot(f"/{name}/delay", "Delay of the readings [us]", delay_range),
        rrb.Horizontal(
            _plot(f"/{name}/commands", "Commands, from hand-over [us]"),
            _plot(f"/{name}/clock", "Clock offset since the start, with its bounds [us]", legend=False),
            *own,
        ),
        row_shares=[2.0, 1.1, 1.3, 1.4, 1.4],
        name=name,
    )


def _plot(
    origin: str, name: str, y_range: tuple[float, float] | None = None, legend: bool = True
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=None if y_range is None else rrb.ScalarAxis(range=y_range),
        plot_legend=rrb.PlotLegend(visible=legend, corner=rrb.Corner2D.LeftTop),
        time_ranges=rrb.VisibleTimeRange(
            TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
        ),
    )


def _error_range(summary: Summary | None) -> tuple[float, float] | None:
    """Wide enough for the error that counts, so that a step's first instant does not flatten the rest."""
    peak = summary.speed_error.peak_rad_s if summary is not None else None
    if not peak:
        return None
    return -2.5 * peak * RPM_PER_RAD_S, 2.5 * peak * RPM_PER_RAD_S


def _delay_range(plan: RecordingPlan, summary: Summary | None, least_us: float) -> tuple[float, float] | None:
    if summary is None:
        return None
    top = 1.15 * max(plan.deadline / 1_000, summary.delay_us.max or 0.0)
    return min(-0.08 * top, 1.15 * least_us), top
