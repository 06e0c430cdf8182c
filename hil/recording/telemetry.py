"""A run as Rerun shows it: rows in, wide columns out. The one module that writes to Rerun.

Times are on the timeline ``run_time``, zero at the first cycle. A reading's values stand at
the due instant of the cycle that asked for it, so that reference and measurement agree.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from drivers.cia402.profile import State
from drivers.rotation import RPM_PER_RAD_S
from drivers.timebase import NS_PER_US, Instant
from hil.loop.samples import CommandFate
from hil.recording.blueprint import EVENTS, HISTOGRAM, STATE_ROOT, SUMMARY, TIMELINE, VERDICT, layout
from hil.recording.run_metadata import run_metadata
from hil.recording.verdict_text import verdict_markdown
from hil.reviewing.histogram import TimeHistogram
from hil.rows.recording_plan import RecordingPlan
from hil.rows.records import COMMAND_FATES, FATE_SAMPLE, NOTHING, Rows
from hil.rows.row_states import (
    HOST_IN_TIME,
    HOST_MISSED,
    LINK_DEGRADED,
    LINK_DOWN,
    LINK_OK,
    DriveStates,
    HostStates,
    LabelChange,
    LinkStates,
)
from hil.rows.side_rows import BeginEvent, IdentityEvent, LoadEvent, RunEvent, StateEvent, TextEvent
from hil.verdict.summary import Summary
from hil.verdict.verdict import LimitResult

_GREY, _BLUE, _RED, _ORANGE = (165, 165, 165), (84, 176, 255), (255, 74, 96), (255, 168, 60)
_GREEN, _VIOLET, _YELLOW, _CORAL = (112, 224, 128), (200, 160, 255), (255, 214, 92), (255, 122, 66)
_CHANNEL_COLORS = (_BLUE, _GREEN, _VIOLET, _YELLOW, _CORAL, _GREY)
_STATE_COLORS = {
    State.NOT_READY: 0x50555CFF,
    State.SWITCH_ON_DISABLED: 0x50555CFF,
    State.READY: 0x8A6D1FFF,
    State.SWITCHED_ON: 0xB8860BFF,
    State.OPERATION_ENABLED: 0x2E7D32FF,
    State.QUICK_STOP: 0xC2571AFF,
    State.FAULT_REACTION: 0xB3202AFF,
    State.FAULT: 0x8B1520FF,
}
_HOST_COLORS = {HOST_IN_TIME: 0x1E6B35FF, HOST_MISSED: 0xB3202AFF}
_LINK_COLORS = {LINK_OK: 0x1E6B35FF, LINK_DEGRADED: 0xA67C1BFF, LINK_DOWN: 0xB3202AFF}
_PHASE_COLORS = {
    "Connecting": 0x3F4650FF,
    "Configuring": 0x4A4F7AFF,
    "Enabling": 0x6A4FA0FF,
    "Calibrating": 0x1C6F7AFF,
    "Running": 0x1F5FA8FF,
    "Stopping": 0x5A5F66FF,
    "Stopped": 0x3F4650FF,
}
"""Phases that a run goes through; any other gets a colour of the viewer's choice."""
_LOST = COMMAND_FATES.index(CommandFate.LOST)
_SPANNING = (
    "speed/reference",
    "error/error",
    "torque/measured",
    "delay/deadline",
    "commands/on_bus",
    "clock/offset",
)
"""One series of each plot of an axis."""
_BARS_MAX = 44
_LATEST = 2**62
_FLUSH_MAX_S = 10.0
_APPLICATION = "servobench"
RERUN_FILE = "run.rrd"
_PROPERTIES = "run"


class Telemetry:
    """One recording stream of one run: into the file, or to a live viewer."""

    def __init__(self, plan: RecordingPlan, recording_id: str, sink: rr.FileSink | rr.GrpcServerSink) -> None:
        """Error: OSError if the sink cannot be opened."""
        self._plan = plan
        self._stream = rr.RecordingStream(_APPLICATION, recording_id=recording_id)
        try:
            self._stream.set_sinks(sink)
        except (RuntimeError, ValueError) as error:
            raise OSError(f"{RERUN_FILE}: {error}") from error
        self._stream.send_recording_name(f"{plan.name} seed {plan.seed}")
        self._stream.send_blueprint(layout(plan))
        self.metadata: Mapping[str, str] = {}
        """What is said of the run in place of what the plan and this machine say of it, if anything is."""
        self._origin: int | None = None
        self._held: list[RunEvent] = []
        self._first_at, self._last_at = _LATEST, -_LATEST
        self._delay_least_us = 0.0
        self._axes = [axis.name for axis in plan.review.axes]
        self._drives = [DriveStates() for _ in self._axes]
        self._links = [LinkStates() for _ in self._axes]
        self._host = HostStates()
        self._offset_origin_ns: list[int | None] = [None] * len(self._axes)
        """Of each axis' clock: its offset in the first row that has one."""
        self._labels: dict[str, str] = {}
        self._tracks: dict[str, str] = {}
        self._load_paths: set[str] = set()
        self._name_series()
        self._name_tracks()
        self._show_verdict(None)

    def take_events(self, events: Sequence[RunEvent]) -> None:
        """Texts and states; those before the run's time zero are held until it is known."""
        for event in events:
            self._note_instants(event.at, event.at)
            if isinstance(event, BeginEvent):
                self._start_at(event.at)
            elif self._origin is None:
                self._held.append(event)
            else:
                self._show_event(event)

    def take_rows(self, rows: Rows) -> None:
        """Cycle records: (n,) of ROW_DTYPE."""
        if not rows.size:
            return
        if self._origin is None:
            self._start_at(int(rows["due_at"][0]))
        self._note_instants(int(rows["due_at"][0]), int(rows["due_at"][-1]))
        for number, name in enumerate(self._axes):
            mine = rows if len(self._axes) == 1 else rows[rows["axis"] == number]
            if mine.size:
                self._show_axis(number, name, mine)

    def show_histogram(self, delay: TimeHistogram) -> None:
        """The delays so far; the last bar holds all that lies beyond it."""
        p99, largest = delay.quantile_ns(0.99), delay.largest_ns
        if p99 is None or largest is None:
            return
        width = _round_width(min(float(largest), 2.0 * p99) / _BARS_MAX)
        count = min(_BARS_MAX, largest // width + 1)
        bars = rr.BarChart(
            delay.bars(width, count),
            abscissa=(np.arange(count) + 0.5) * width / NS_PER_US,
            widths=np.full(count, width / NS_PER_US),
            color=_YELLOW,
        )
        self._stream.log(HISTOGRAM, bars, static=True)

    def flush(self) -> None:
        """Error: OSError if what was sent cannot be written; a full disk shows only here."""
        try:
            self._stream.flush(timeout_sec=_FLUSH_MAX_S)
        except (RuntimeError, ValueError) as error:
            raise OSError(f"the telemetry cannot be written: {error}") from error

    def finish(self, summary: Summary) -> None:
        """Verdict and final layout; ends the stream. Error: OSError as of ``flush``."""
        if self._origin is None:
            self._start_at(self._held[0].at if self._held else 0)
        if self._last_at >= self._first_at:
            self._show_event(_end_event(Instant(self._last_at), summary))
            # A margin, so that the last state is wide enough for its label
            self._extend_plots_to(self._last_at + (self._last_at - self._first_at) // 20)
        self._show_verdict(summary)
        self._stream.send_blueprint(layout(self._plan, summary, self._delay_least_us))
        self.flush()
        self._stream.disconnect()

    def _start_at(self, origin: int) -> None:
        self._origin = origin
        held, self._held = self._held, []
        drives = {event.axis: event.text for event in held if isinstance(event, IdentityEvent)}
        told: dict[str, Any] = {**(self.metadata or run_metadata(self._plan, Instant(origin), drives))}
        self._stream.send_property(_PROPERTIES, rr.AnyValues(**told))
        self.take_events(held)
        if held:
            self._extend_plots_to(held[0].at)

    def _note_instants(self, first_at: int, last_at: int) -> None:
        self._first_at, self._last_at = min(self._first_at, first_at), max(self._last_at, last_at)

    def _extend_plots_to(self, instant: int) -> None:
        """A point without a value in each plot, so that they all span what the states span."""
        for name in self._axes:
            for series in _SPANNING:
                self._plot(f"/{name}/{series}", np.array([instant]), np.array([math.nan]))

    def _times(self, instants: NDArray[np.int64]) -> list[rr.TimeColumn]:
        assert self._origin is not None
        return [rr.TimeColumn(TIMELINE, duration=(instants - self._origin).astype("timedelta64[ns]"))]

    def _show_event(self, event: RunEvent) -> None:
        if isinstance(event, TextEvent):
            self._stream.send_columns(
                EVENTS,
                self._times(np.array([event.at])),
                rr.TextLog.columns(text=[event.text], level=[event.level]),
            )
        elif isinstance(event, StateEvent):
            self._show_changes(event.track, [LabelChange(event.at, event.label)])
        elif isinstance(event, LoadEvent):
            self._show_load(event)

    def _show_load(self, event: LoadEvent) -> None:
        path = f"/{event.axis}/torque/brake"
        if path not in self._load_paths:
            self._load_paths.add(path)
            self._line(path, ["load measured"], [_ORANGE], width=1.4)
        self._plot(path, np.array([event.at]), np.array([event.torque_nm]))

    def _show_axis(self, number: int, name: str, rows: Rows) -> None:
        self._show_changes(f"{name} drive", self._drives[number].changes(rows))
        self._show_changes(f"{name} link", self._links[number].changes(rows))
        if number == 0:
            # A cycle without SYNC is one of all axes.
            self._show_changes("host", self._host.changes(rows))
        due_at = rows["due_at"]
        read = rows[rows["fate"] == FATE_SAMPLE]
        dropped = rows[rows["fate"] != FATE_SAMPLE]
        came = rows[rows["delay_ns"] != NOTHING]
        error = read["reference_rad_s"] - read["velocity_rad_s"]
        self._plot(f"/{name}/speed/reference", due_at, rows["reference_rad_s"] * RPM_PER_RAD_S)
        self._plot(f"/{name}/speed/measured", read["due_at"], read["velocity_rad_s"] * RPM_PER_RAD_S)
        self._plot(
            f"/{name}/speed/dropped", dropped["due_at"], dropped["estimate_velocity_rad_s"] * RPM_PER_RAD_S
        )
        self._plot(f"/{name}/error/error", read["due_at"], error * RPM_PER_RAD_S)
        torques = np.stack((rows["command_torque_nm"], rows["load_torque_nm"]), axis=1)
        self._plot(f"/{name}/torque/command", due_at, torques)
        self._plot(f"/{name}/torque/measured", read["due_at"], read["torque_nm"])
        delay_us = came["delay_ns"] / NS_PER_US
        self._delay_least_us = min(self._delay_least_us, float(delay_us.min(initial=0.0)))
        self._plot(f"/{name}/delay/delay", came["due_at"], delay_us)
        ends = due_at[[0, -1]]
        self._plot(f"/{name}/delay/deadline", ends, np.full(2, self._plan.deadline / NS_PER_US))
        self._plot(f"/{name}/delay/dropped", dropped["due_at"], np.zeros(dropped.size))
        doubtful = rows[rows["certain"] == 0]
        at_us = np.where(doubtful["delay_ns"] == NOTHING, 0, doubtful["delay_ns"]) / NS_PER_US
        self._plot(f"/{name}/delay/uncertain", doubtful["due_at"], at_us)
        self._show_commands(name, rows)
        self._show_clock(number, name, rows)
        for place, channel in enumerate(self._plan.channels.get(name, ())):
            self._plot(f"/{name}/controller/{channel}", due_at, rows[f"channel_{place}"])

    def _show_commands(self, name: str, rows: Rows) -> None:
        """From handing a command over until it was on the bus, and until it acted at the latest."""
        for series, instant in (("on_bus", "command_on_bus_at"), ("acting", "command_acts_by")):
            known = rows[rows[instant] != NOTHING]
            way_us = (known[instant] - known["command_handed_at"]) / NS_PER_US
            self._plot(f"/{name}/commands/{series}", known["due_at"], way_us)
        computed = rows[rows["compute_ns"] != NOTHING]
        compute_us = computed["compute_ns"] / NS_PER_US
        self._plot(f"/{name}/commands/computing", computed["due_at"], compute_us)
        lost = rows[rows["command_fate"] == _LOST]
        self._plot(f"/{name}/commands/lost", lost["due_at"], np.zeros(lost.size))

    def _show_clock(self, number: int, name: str, rows: Rows) -> None:
        """The offset of the drive's clock since the run began, and between what bounds it is known."""
        told = rows[rows["clock_offset_ns"] != NOTHING]
        if not told.size:
            return
        origin_ns = self._offset_origin_ns[number]
        if origin_ns is None:
            origin_ns = self._offset_origin_ns[number] = int(told["clock_offset_ns"][0])
        offset_us = (told["clock_offset_ns"] - origin_ns) / NS_PER_US
        error_us = told["clock_error_ns"] / NS_PER_US
        self._plot(f"/{name}/clock/offset", told["due_at"], offset_us)
        bounds_us = np.stack((offset_us - error_us, offset_us + error_us), axis=1)
        self._plot(f"/{name}/clock/bounds", told["due_at"], bounds_us)

    def _plot(self, path: str, due_at: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """One wide column; values: (n,) or (n, series)."""
        if due_at.size:
            self._stream.send_columns(path, self._times(due_at), rr.Scalars.columns(scalars=values))

    def _show_changes(self, track: str, changes: Sequence[LabelChange]) -> None:
        kept: list[LabelChange] = []
        for at, text in changes:
            label = text[:1].upper() + text[1:]
            if self._labels.get(track) != label:
                self._labels[track] = label
                kept.append(LabelChange(at, label))
        if kept:
            times = np.array([change.at for change in kept])
            states = rr.StateChange.columns(state=[change.label for change in kept])
            self._stream.send_columns(self._track_path(track), self._times(times), states)

    def _track_path(self, track: str) -> str:
        """Tracks are laid out by name, so each gets a number by its order of appearance."""
        if track not in self._tracks:
            self._tracks[track] = f"{STATE_ROOT}/{len(self._tracks) + 1}_{track.replace(' ', '_')}"
        return self._tracks[track]

    def _name_tracks(self) -> None:
        drive = {state.value.capitalize(): color for state, color in _STATE_COLORS.items()}
        for name in self._axes:
            self._color_track(f"{name} drive", drive)
        self._color_track("phase", _PHASE_COLORS)
        for name in self._axes:
            self._color_track(f"{name} link", _LINK_COLORS)
        self._color_track("host", _HOST_COLORS)

    def _color_track(self, track: str, colors: dict[str, int]) -> None:
        values = list(colors)
        styled = rr.StateConfiguration(
            values=values, labels=values, colors=np.array(list(colors.values()), np.uint32)
        )
        self._stream.log(self._track_path(track), styled, static=True)

    def _name_series(self) -> None:
        shapes = rr.components.MarkerShape
        cross, down, diamond = shapes.Cross, shapes.Down, shapes.Diamond
        for name in self._axes:
            self._line(f"/{name}/speed/reference", ["reference"], [_GREY])
            self._line(f"/{name}/speed/measured", ["measured"], [_BLUE], width=1.6)
            self._marks(f"/{name}/speed/dropped", "dropout", down)
            self._line(f"/{name}/error/error", ["reference - measured"], [_ORANGE])
            self._line(f"/{name}/torque/command", ["command", "load"], [_GREY, _VIOLET])
            self._line(f"/{name}/torque/measured", ["measured"], [_GREEN], width=1.4)
            self._line(f"/{name}/delay/delay", ["delay"], [_YELLOW])
            self._line(f"/{name}/delay/deadline", ["deadline"], [_CORAL])
            self._marks(f"/{name}/delay/dropped", "dropout", cross)
            self._marks(f"/{name}/delay/uncertain", "uncertain", diamond, _VIOLET)
            self._line(f"/{name}/commands/on_bus", ["on the bus"], [_BLUE])
            self._line(f"/{name}/commands/acting", ["acting, at the latest"], [_GREEN])
            self._line(f"/{name}/commands/computing", ["computing"], [_ORANGE])
            self._marks(f"/{name}/commands/lost", "lost", cross)
            self._line(f"/{name}/clock/bounds", ["at least", "at most"], [_GREY, _GREY])
            self._line(f"/{name}/clock/offset", ["offset"], [_VIOLET])
            for place, channel in enumerate(self._plan.channels.get(name, ())):
                color = _CHANNEL_COLORS[place % len(_CHANNEL_COLORS)]
                self._line(f"/{name}/controller/{channel}", [channel], [color])

    def _line(
        self, path: str, names: list[str], colors: list[tuple[int, int, int]], width: float = 1.0
    ) -> None:
        series = rr.SeriesLines(
            names=names,
            colors=colors,
            widths=[width] * len(names),
            # The default averages neighbours where there are more points than pixels, and hides the peaks.
            aggregation_policy="MinMax",
        )
        self._stream.log(path, series, static=True)

    def _marks(
        self,
        path: str,
        name: str,
        marker: rr.components.MarkerShape,
        color: tuple[int, int, int] = _RED,
    ) -> None:
        series = rr.SeriesPoints(names=name, colors=color, markers=marker, marker_sizes=3.0)
        self._stream.log(path, series, static=True)

    def _show_verdict(self, summary: Summary | None) -> None:
        text = verdict_markdown(self._plan, summary)
        page = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._stream.log(VERDICT, page, static=True)
        if summary is not None:
            whole = json.dumps(summary.as_json(), indent=2)
            self._stream.log(SUMMARY, rr.TextDocument(whole), static=True)


def _end_event(at: Instant, summary: Summary) -> TextEvent:
    verdict = summary.verdict
    kept = sum(check.result is LimitResult.KEPT for check in verdict.limits)
    text = f"run ended: {verdict.outcome}, {kept} of {len(verdict.limits)} limits kept"
    level = "ERROR" if verdict.exit_status else "INFO"
    return TextEvent(at, level, f"{text}; {verdict.reason}".rstrip("; "))


def _round_width(width_ns: float) -> int:
    """The next of 1, 2, 5 times a power of ten us that is not smaller."""
    power = 10.0 ** math.floor(math.log10(max(width_ns / NS_PER_US, 1.0)))
    factor = next(factor for factor in (1, 2, 5, 10) if factor * power * NS_PER_US >= width_ns)
    return int(factor * power) * NS_PER_US
