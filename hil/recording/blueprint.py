"""How the Rerun viewer lays a run out: lanes of states, plots of each axis, verdict, delay histogram, events.

Pages are tabs: an overview that opens on the whole run, with an independent time axis of an absolute range
for each view (an axis that is linked opens on the viewer's own window of 60 s); for several axes one of all
of them first, then one of each; the timing; what controllers tell; and the same plots with linked axes.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

import rerun.blueprint as rrb

from servobench.hil.recording.lanes import (
    BY_CYCLE,
    DROPOUTS,
    STATES,
    in_order,
    lane,
    lane_colors,
    live_tracks,
)
from servobench.hil.recording.page_series import (
    AXIS_COLORS,
    LIMITS,
    OVERVIEW,
    SERIES,
    Color,
    Series,
    own_series,
    torque_scale,
)
from servobench.hil.recording.plot_scale import (
    COLUMN_PX,
    LANE_GUTTER,
    Range,
    fitted,
    gutter,
    lanes_px,
    plot_heights,
)
from servobench.hil.recording.rerun_page import event_list, framed, plot
from servobench.hil.recording.wide_rows import cycles_entity, drawn
from servobench.hil.rows.recording_plan import RecordingPlan

VERDICT, HISTOGRAM, EVENTS = "/verdict", "/delay_histogram", "/events"
SUMMARY = "/summary"
"""The object of summary.json, as text; in no view."""
OVERVIEW_PAGE, TIMING_PAGE, CONTROLLER_PAGE, ZOOM_PAGE = "Overview", "Timing", "Controller", "Zoom"
OBSERVED_PAGE: Final = "Observed"
"""Page of the objects the drives report for the recording alone."""
SPEED_PAGE = "Speed"
"""Page of the speeds of axes under position reference; the position is seen first."""
LIVE_WINDOW_S: Final = 20.0
"""Seconds shown of a run in progress: enough for a step with its response, and single cycles remain
visible."""
MARKS_MAX: Final = 30
"""More dropouts would bury the line; their lane shows all of them."""

Styled = tuple[Series, Color | None, str]
"""A line, and colour and name in place of its own."""
Ranges = Mapping[str, Range | None]
"""Of plots, by name, from above to below."""
Overrides = dict[Any, Any]
"""How lines are drawn, by entity."""


@dataclass(frozen=True, slots=True)
class Whole:
    """Layout data for the pages of a run that has ended."""

    begin_s: float
    end_s: float
    """End of the shown run time."""
    tracks: Mapping[str, str] = field(default_factory=dict)
    """All lanes, and of which axis each is; empty: of none."""
    enveloped: bool = False
    """There are envelopes; a short run has no more rows than they would have."""
    ranges: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of the values, by axis and plot: "axis1/speed"."""
    remarks: Mapping[str, str] = field(default_factory=dict)
    """By axis and plot, what its title says beside."""
    few_marks: frozenset[str] = frozenset()
    """Axes whose dropouts are marked on the line."""


class Pages:
    """The layout of one run; live without ``whole``."""

    def __init__(self, plan: RecordingPlan, whole: Whole | None) -> None:
        self._plan = plan
        self._whole = whole
        self._axes = [axis.name for axis in plan.review.axes]
        self._positions = [axis.name for axis in plan.review.axes if axis.quantity == "position"]
        self._units = {axis.name: torque_scale(axis)[1] for axis in plan.review.axes}

    def blueprint(self) -> rrb.Blueprint:
        """All of it."""
        running = self._whole is None
        left = rrb.Tabs(*self._pages(), active_tab=0)
        content = rrb.Horizontal(left, self._right(), column_shares=[7, 3])
        return framed(content, follows=running)

    def _pages(self) -> Iterable[rrb.Container | rrb.View]:
        several = len(self._axes) > 1
        if several:
            yield self._all_axes()
            for name in self._axes:
                yield self._axis_page(name, name, linked=False)
        else:
            yield self._axis_page(self._axes[0], OVERVIEW_PAGE, linked=False)
        yield self._of_each(TIMING_PAGE, [self._timing(name) for name in self._axes])
        if self._positions:
            speeds = [
                rrb.Vertical(*self._speed(name, False, False, {}), name=name) for name in self._positions
            ]
            yield self._of_each(SPEED_PAGE, speeds)
        telling = [name for name in self._axes if name in self._plan.channels]
        if telling:
            yield self._of_each(CONTROLLER_PAGE, [self._controller(name) for name in telling])
        if self._plan.observed:
            yield self._of_each(OBSERVED_PAGE, [self._observed(name) for name in self._plan.observed])
        if self._whole is not None:
            zooms = [self._axis_page(name, name, linked=True) for name in self._axes]
            yield self._of_each(ZOOM_PAGE, zooms)

    def _of_each(self, page: str, parts: Sequence[rrb.Container]) -> rrb.Container:
        """One page, with a tab for each axis where there are several."""
        if len(parts) > 1:
            return rrb.Tabs(*parts, name=page)
        parts[0].name = page
        return parts[0]

    def _axis_page(self, name: str, title: str, linked: bool) -> rrb.Vertical:
        marks = self._whole is None or linked or name in self._whole.few_marks
        own = self._tracks("", name)
        ranges = self._fitted([name], len(own))
        first = (
            self._position(name, linked, ranges)
            if name in self._positions
            else self._speed(name, linked, marks, ranges)
        )
        plots = [
            *first,
            self._plot(name, "torque", f"Torque [{self._units[name]}]", linked, ranges=ranges),
            self._plot(
                name,
                "delay",
                "Delay of the readings [us]",
                linked,
                ["delay/uncertain", *(["delay/dropped"] if marks else [])],
                ranges,
            ),
        ]
        if linked:
            by_cycle = {f"{name} {DROPOUTS}": f"{name} {BY_CYCLE}"}
            own = [by_cycle.get(track, track) for track in own]
        return self._with_lanes(own, plots, ranges, title, linked)

    def _speed(self, name: str, linked: bool, marks: bool, ranges: Ranges) -> tuple[rrb.View, rrb.View]:
        return (
            self._plot(name, "speed", "Speed [r/min]", linked, ["speed/dropped"] if marks else [], ranges),
            self._plot(name, "error", "Speed error [r/min]", linked, ranges=ranges),
        )

    def _position(self, name: str, linked: bool, ranges: Ranges) -> tuple[rrb.View, rrb.View]:
        return (
            self._plot(name, "position", "Position [rad]", linked, ranges=ranges),
            self._plot(name, "position_error", "Position error [rad]", linked, ranges=ranges),
        )

    def _all_axes(self) -> rrb.Vertical:
        """Lay out one view per plot, each with all axes."""
        lanes = [
            track
            for track in self._tracks("", *self._axes)
            if self._whole is None or not track.endswith(" drive")
        ]
        ranges = self._fitted(self._axes, len(lanes))
        units = ", ".join(sorted(set(self._units.values())))
        plots = [
            self._together(ranges, "speed/measured", "Speed of all axes [r/min]", "speed/reference"),
            self._together(ranges, "error/error", "Speed errors [r/min]"),
            self._together(ranges, "torque/measured", f"Torques [{units}]"),
            self._together(ranges, "delay/delay", "Delays of the readings [us]"),
        ]
        return self._with_lanes(lanes, plots, ranges, OVERVIEW_PAGE, linked=False)

    def _with_lanes(
        self, lanes: list[str], plots: Sequence[rrb.View], ranges: Ranges, title: str, linked: bool
    ) -> rrb.Vertical:
        """Plots, of these ranges, below their lanes."""
        states = rrb.StateTimelineView(
            origin="/",
            contents=[f"+ {STATES}"],
            name="States",
            time_view=self._time_axis(linked, LANE_GUTTER),
            overrides={STATES: [lane(track, lane_colors(track, self._axes)) for track in lanes]},
        )
        states_px = _states_px(len(lanes))
        # the speed is what is looked at first
        heights = plot_heights(list(ranges.values()), COLUMN_PX - states_px, (0.7, 0.1, 0.1, 0.1))
        return rrb.Vertical(states, *plots, row_shares=[states_px, *heights], name=title)

    def _fitted(self, axes: Sequence[str], lanes: int) -> Ranges:
        """The ranges of the plots below so many lanes, so that all have room, from above to below."""
        position = len(axes) == 1 and axes[0] in self._positions
        first = ("position", "position_error") if position else ("speed", "error")
        names = (*first, "torque", "delay")
        widest = [self._widest(plot, axes) for plot in names]
        return dict(zip(names, fitted(widest, COLUMN_PX - _states_px(lanes)), strict=True))

    def _widest(self, plot: str, axes: Sequence[str]) -> Range | None:
        """The range of a plot that several axes share."""
        ranges = [low_high for name in axes if (low_high := self._range(f"{name}/{plot}"))]
        return (min(low for low, _ in ranges), max(high for _, high in ranges)) if ranges else None

    def _timing(self, name: str) -> rrb.Vertical:
        return rrb.Vertical(
            self._plot(name, "delay", "Delay of the readings [us]", False, ["delay/uncertain"]),
            self._plot(name, "commands", "Commands, from hand-over [us]", False, ["commands/lost"]),
            self._plot(name, "clock", "Clock offset since the start, with its bounds [us]", False),
            row_shares=[1, 1, 1],
            name=name,
        )

    def _controller(self, name: str) -> rrb.Vertical:
        return self._own(name, [(f"controller/{each}", each) for each in self._plan.channels[name]])

    def _observed(self, name: str) -> rrb.Vertical:
        return self._own(name, [(each.path, each.title) for each in self._plan.observed[name].signals])

    def _own(self, name: str, titles: Sequence[tuple[str, str]]) -> rrb.Vertical:
        """A plot for each series, by path and title."""
        known = {each.path: each for each in own_series(self._plan, name)}
        plots = []
        for path, title in titles:
            contents, overrides = self._lines(name, [(known[path], None, "")], False)
            plots.append(self._view(f"/{name}", contents, title, False, overrides=overrides))
        return rrb.Vertical(*plots, name=name)

    def _plot(
        self,
        name: str,
        plot: str,
        title: str,
        linked: bool,
        marks: Sequence[str] = (),
        ranges: Ranges = MappingProxyType({}),
    ) -> rrb.TimeSeriesView:
        """``marks``: which points are shown beside the lines. ``linked``: as high as what is seen of them,
        with the limits of errors alone, as those of the drive are far away. ``ranges``: in place of that of
        the values."""
        series = [(each, None, "") for each in SERIES if each.path.startswith(f"{plot}/")]
        lines, overrides = self._lines(name, series, linked)
        if not linked or "error" in plot:
            lines.append(f"{LIMITS}/{name}/{plot}/**")
        contents = [*lines, *(f"/{name}/{mark}" for mark in marks)]
        remark = "" if self._whole is None else self._whole.remarks.get(f"{name}/{plot}", "")
        low_high = None if linked else ranges.get(plot) or self._range(f"{name}/{plot}")
        return self._view(f"/{name}", contents, title + remark, linked, low_high, overrides)

    def _lines(self, name: str, styled: Sequence[Styled], linked: bool) -> tuple[list[str], Overrides]:
        """What a view shows of an axis, and how: envelopes, or the cycles themselves."""
        if root := self._root(linked):
            restyled = {
                f"{root}/{name}/{series.path}": series.styled(color, title).visualizer()
                for series, color, title in styled
                if color
            }
            return [f"{root}/{name}/{series.path}" for series, _, _ in styled], restyled
        beside = [f"/{name}/{series.path}" for series, _, _ in styled if not series.of_cycles]
        cycles = [drawn(*each) for each in styled if each[0].of_cycles]
        if not cycles:
            return beside, {}
        return [cycles_entity(name), *beside], {cycles_entity(name): cycles}

    def _together(self, ranges: Ranges, path: str, title: str, *beside: str) -> rrb.TimeSeriesView:
        """``path`` of all axes in the colours of the axes; ``beside``: other series, in their own."""
        by_path = {each.path: each for each in SERIES}
        contents: list[str] = []
        overrides: Overrides = {}
        for place, name in enumerate(self._axes):
            own = by_path[path], AXIS_COLORS[place % len(AXIS_COLORS)], name
            lines, styles = self._lines(name, [*((by_path[each], None, "") for each in beside), own], False)
            contents += lines
            overrides |= styles
        return self._view("/", contents, title, False, ranges[path.partition("/")[0]], overrides)

    def _view(
        self,
        origin: str,
        contents: Sequence[str],
        title: str,
        linked: bool,
        low_high: Range | None = None,
        overrides: Overrides | None = None,
    ) -> rrb.TimeSeriesView:
        paths = [f"+ {path}" for path in contents]
        axis = self._time_axis(linked, gutter(low_high))
        return plot(origin, paths, title, axis, low_high, overrides=overrides)

    def _time_axis(self, linked: bool, earlier: float = 0.0) -> rrb.TimeAxis:
        """``earlier``: so much more at the left, of the width."""
        if linked:
            return rrb.TimeAxis(link="LinkToGlobal")
        boundary = rrb.TimeRangeBoundary
        if self._whole is None:
            window = rrb.TimeRange(
                boundary.cursor_relative(seconds=-LIVE_WINDOW_S), boundary.cursor_relative()
            )
        else:
            begin_s, end_s = self._whole.begin_s, self._whole.end_s
            begin_s -= earlier * (end_s - begin_s)
            window = rrb.TimeRange(boundary.absolute(seconds=begin_s), boundary.absolute(seconds=end_s))
        return rrb.TimeAxis(link="Independent", view_range=window)

    def _root(self, linked: bool) -> str:
        return "" if linked or self._whole is None or not self._whole.enveloped else OVERVIEW

    def _range(self, plot: str) -> Range | None:
        return None if self._whole is None else self._whole.ranges.get(plot)

    def _tracks(self, *of: str) -> list[str]:
        """Lanes of some axes, and of none where one of them is empty."""
        if self._whole is None:
            return live_tracks([name for name in of if name])
        return in_order((track for track, axis in self._whole.tracks.items() if axis in of), self._axes)

    def _right(self) -> rrb.Vertical:
        histograms = [
            rrb.BarChartView(
                origin=f"{HISTOGRAM}/{name}",
                # of several axes these are tabs, which have room for less
                name=f"{name}: readings over delay [us]" + self._deadline_remark(name)
                if len(self._axes) == 1
                else f"{name} delays [us]",
                plot_legend=rrb.PlotLegend(visible=False),
            )
            for name in self._axes
        ]
        return rrb.Vertical(
            rrb.TextDocumentView(origin=VERDICT, name="Verdict"),
            histograms[0] if len(histograms) == 1 else rrb.Tabs(*histograms),
            event_list(EVENTS),
            row_shares=[5.6, 1.7, 2.7],
        )

    def _deadline_remark(self, name: str) -> str:
        return "" if self._whole is None else self._whole.remarks.get(f"{name}/histogram", "")


def _states_px(lanes: int) -> float:
    return lanes_px(max(lanes, 3))


def layout(plan: RecordingPlan, whole: Whole | None = None) -> rrb.Blueprint:
    """The layout while the run goes on, or of the whole of it."""
    return Pages(plan, whole).blueprint()
