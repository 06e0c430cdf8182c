"""A run as Rerun shows it: rows in, wide columns out. The one module that writes to Rerun.

Times are on the timeline ``run_time``, zero at the first cycle. A reading's values stand at
the due instant of the cycle that asked for it, so that reference and measurement agree.
"""

import json
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from operator import attrgetter
from textwrap import wrap
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Instant
from servobench.hil.loop.cycle_record import COMMAND_FATES, FATE_MISSED, FATE_SAMPLE
from servobench.hil.loop.samples import CommandFate
from servobench.hil.recording.blueprint import EVENTS, HISTOGRAM, MARKS_MAX, SUMMARY, VERDICT, Whole, layout
from servobench.hil.recording.lanes import (
    BROKEN,
    BY_CYCLE,
    KEPT,
    LIMITS_TRACK,
    STATES,
    VERDICT_TRACK,
    FaultWindows,
    dropout_lane,
    error_lane,
    lane_column,
    live_tracks,
)
from servobench.hil.recording.observed_frames import ObservedFrames
from servobench.hil.recording.page_series import (
    CORAL,
    LIMITS,
    OVERVIEW,
    TIMELINE,
    YELLOW,
    style_of,
    torque_scale,
)
from servobench.hil.recording.row_series import READ_SERIES, first_offset_ns, lines_of, marks_of
from servobench.hil.recording.run_metadata import run_metadata
from servobench.hil.recording.verdict_text import broken_texts, running_markdown, verdict_markdown
from servobench.hil.recording.whole_figures import WholeFigures, in_view
from servobench.hil.recording.wide_rows import cycle_columns, cycles_entity
from servobench.hil.reviewing.envelope import BUCKETS, CodeLane, Envelope, Gaps
from servobench.hil.reviewing.histogram import TimeHistogram, round_width
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import INJECTED_TRACK, QUIET
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import DriveStates, FateStates, HostStates, LabelChange, LinkStates, Rows
from servobench.hil.rows.run_files import RERUN_FILE
from servobench.hil.rows.side_rows import BeginEvent, LoadEvent, RunEvent, StateEvent, TextEvent, drives_of
from servobench.hil.verdict.summary import Summary, checks_so_far
from servobench.hil.verdict.verdict import LimitResult

_LOST = COMMAND_FATES.index(CommandFate.LOST)
_BARS_MAX = 44
_LATEST = 2**62
"""Beyond every instant, and the time between it and one that a clock shows still has 64 bits."""
_FLUSH_MAX_S = 10.0
_EVENT_COLUMNS = 64
"""A longer text goes on in the next line: so much a list at the right of a screen of 1920 shows."""
_BEFORE_MAX, _AFTER_MAX = 0.1, 0.5
"""Shares of the cycles shown on opening before the first one, and after the last one while a drive coasts."""
_APPLICATION = "servobench"
_PROPERTIES = "run"


class Telemetry:
    """One recording stream of one run: into the file, or to a live viewer."""

    def __init__(
        self,
        plan: RecordingPlan,
        recording_id: str,
        sink: rr.FileSink | rr.GrpcServerSink,
        *,
        live: bool = False,
    ) -> None:
        """``live``: a viewer follows; there are no envelopes. Error: OSError if the sink cannot be opened."""
        self._plan = plan
        self._live = live
        self._stream = rr.RecordingStream(_APPLICATION, recording_id=recording_id)
        try:
            self._stream.set_sinks(sink)
        except (RuntimeError, ValueError) as error:
            raise OSError(f"{RERUN_FILE}: {error}") from error
        self._stream.send_recording_name(f"{plan.name} seed {plan.seed}")
        self._stream.send_blueprint(layout(plan))
        self.metadata: Mapping[str, str] = {}
        """Metadata shown in place of the plan's and this machine's, if any."""
        self._told: Mapping[str, str] = {}
        self._origin: int | None = None
        self._held: list[RunEvent] = []
        self._first_at, self._last_at = _LATEST, -_LATEST
        self._last_cycle = 0
        self._axes = [axis.name for axis in plan.review.axes]
        self._scales = [torque_scale(axis)[0] for axis in plan.review.axes]
        self._drives = [DriveStates() for _ in self._axes]
        self._links = [LinkStates() for _ in self._axes]
        self._dropouts = [CodeLane() for _ in self._axes]
        self._fates = [FateStates() for _ in self._axes]
        self._gaps = {name: Gaps() for name in self._axes}
        self._host = HostStates()
        self._missed = False
        self._faults = FaultWindows()
        self._offset_origin_ns: list[int | None] = [None] * len(self._axes)
        """Offset of each axis' clock in the first row that has one."""
        self._shown: dict[str, list[LabelChange]] = {}
        """By track, in order of time: rows and events report a state twice, and either may come first."""
        self._styled: set[str] = set()
        self._envelopes: dict[str, Envelope] = {}
        self.observed = ObservedFrames(plan.observed)
        """It is given the frames; what they tell is shown with the next rows."""
        self._rows = 0
        self._marks = dict.fromkeys(self._axes, 0)
        self._broken: set[str] = set()
        """Limits that were broken so far."""
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
            mine = rows if len(self._axes) == 1 else rows.compress(rows["axis"] == number)
            if mine.size:
                self._show_axis(number, name, mine)
        self._show_observed()

    def _show_observed(self) -> None:
        for path, times, values in self.observed.drain():
            self._plot(path, times, values)

    def show_histograms(self, delays: Sequence[TimeHistogram]) -> None:
        """The delays so far, by axis; the last bar holds all that lies beyond it."""
        for name, delay in zip(self._axes, delays, strict=True):
            p99, largest = delay.quantile_ns(0.99), delay.largest_ns
            if p99 is None or largest is None:
                continue
            width = round_width(min(float(largest), 2.0 * p99) / _BARS_MAX)
            count = min(_BARS_MAX, largest // width + 1)
            counts = delay.bars(width, count)
            bars = rr.BarChart(
                counts,
                abscissa=(np.arange(count) + 0.5) * width / NS_PER_US,
                widths=np.full(count, width / NS_PER_US),
                color=YELLOW,
            )
            self._stream.log(f"{HISTOGRAM}/{name}/delay", bars, static=True)
            if in_view(self._plan.deadline, float(largest)):
                self._mark_deadline(name, int(counts.max()), width)

    def _mark_deadline(self, name: str, height: int, width: int) -> None:
        """A thin bar as high as the highest."""
        line = rr.BarChart(
            np.array([height]),
            abscissa=np.array([self._plan.deadline / NS_PER_US]),
            widths=np.array([0.3 * width / NS_PER_US]),
            color=CORAL,
        )
        self._stream.log(f"{HISTOGRAM}/{name}/deadline", line, static=True)

    def show_running(self, review: Review) -> None:
        """Show the run's result so far, and which limits are broken by now."""
        self.show_histograms(review.delays)
        figures = review.figures()
        checks = checks_so_far(figures, self._plan.review.limits)
        text = running_markdown(self._plan, figures, checks, self._told)
        self._stream.log(VERDICT, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
        if not checks or not self._rows:
            return
        now, broken = Instant(self._last_cycle), broken_texts(checks)
        self._show_changes(LIMITS_TRACK, [LabelChange(now, BROKEN if broken else KEPT)])
        for metric in broken.keys() - self._broken:
            self._broken.add(metric)
            self._show_event(TextEvent(now, "ERROR", broken[metric]))

    def flush(self) -> None:
        """Error: OSError if what was sent cannot be written; a full disk shows only here."""
        try:
            self._stream.flush(timeout_sec=_FLUSH_MAX_S)
        except (RuntimeError, ValueError) as error:
            raise OSError(f"the telemetry cannot be written: {error}") from error

    def finish(self, summary: Summary, review: Review) -> None:
        """Envelopes, limits, verdict and final layout; ends the stream. Error: OSError as of ``flush``."""
        if self._origin is None:
            self._start_at(self._held[0].at if self._held else 0)
        self._show_observed()
        self.show_histograms(review.delays)
        whole = None
        if self._last_at >= self._first_at:
            self._show_event(_end_event(Instant(self._last_at), summary))
            enveloped = self._show_envelopes()
            self._show_end_lanes(summary, review)
            figures = WholeFigures(self._plan, self._envelopes, review)
            self._show_limits(figures)
            whole = self._whole(figures, enveloped)
        self._show_verdict(summary)
        self._stream.send_blueprint(layout(self._plan, whole))
        self.flush()
        self._stream.disconnect()

    def _whole(self, figures: WholeFigures, enveloped: bool) -> Whole:
        assert self._origin is not None
        begin, end = self._first_at - self._origin, self._last_at - self._origin
        if (lasted := self._last_cycle - self._origin) > 0:
            begin = max(begin, -int(_BEFORE_MAX * lasted))
            end = min(end, lasted + int(_AFTER_MAX * lasted))
        margin = (end - begin) // 50
        return Whole(
            begin_s=(begin - margin) / NS_PER_S,
            end_s=(end + margin) / NS_PER_S,
            tracks={
                track: next((name for name in self._axes if track.rpartition(" ")[0] == name), "")
                for track, shown in self._shown.items()
                if shown and not track.endswith(" link") and (track != "host" or self._missed)
            },
            enveloped=enveloped,
            ranges=figures.ranges(),
            remarks=figures.remarks(),
            few_marks=frozenset(name for name, count in self._marks.items() if count <= MARKS_MAX),
        )

    def _show_envelopes(self) -> bool:
        """Show the envelopes. Returns False if there are none: a run with fewer rows than envelopes is shown
        as it is."""
        if self._live or self._rows <= 2 * BUCKETS:
            return False
        for path, envelope in self._envelopes.items():
            _, axis, below = path.split("/", 2)
            points = envelope.points()
            if below in READ_SERIES:
                points = self._gaps[axis].interrupt(points, self._last_cycle)
            self._send(OVERVIEW + path, *points)
        return True

    def _show_end_lanes(self, summary: Summary, review: Review) -> None:
        """Show what is known at the end only: verdict, dropouts by cause, what was judged, and injected
        faults."""
        first = self._origin or 0
        outcome = LabelChange(first, summary.verdict.outcome.value)
        self._show_changes(VERDICT_TRACK, [outcome, LabelChange(max(self._last_cycle, first), QUIET)])
        for number, name in enumerate(self._axes):
            causes = dropout_lane(self._dropouts[number])
            if any(cause.label != QUIET for cause in causes):
                self._show_changes(f"{name} dropouts", [*causes, LabelChange(self._last_cycle, QUIET)])
                self._send_changes(f"{name} {BY_CYCLE}", [LabelChange(self._last_cycle + 1, QUIET)])
            if causes:
                judged = error_lane(review, self._plan.review, number, first, self._last_cycle)
                self._show_changes(f"{name} error", judged)
        for track, changes in self._faults.lanes(self._first_at, self._last_at).items():
            self._show_changes(track, changes)

    def _show_limits(self, figures: WholeFigures) -> None:
        first = self._origin or 0
        for path, points in figures.limit_lines(first, max(self._last_cycle, first)).items():
            self._send(LIMITS + path, *points)

    def _start_at(self, origin: int) -> None:
        self._origin = origin
        held, self._held = self._held, []
        told: dict[str, Any] = dict(
            self.metadata or run_metadata(self._plan, Instant(origin), drives_of(held))
        )
        self._stream.send_property(_PROPERTIES, rr.AnyValues(**told))
        self._told = told
        before = np.array([min([origin, *(event.at for event in held)]) - NS_PER_S])
        for track in live_tracks(self._axes):  # a view complains of a lane that is not there yet
            self._stream.send_columns(STATES, self._times(before), [lane_column(track, [None])])
        self.take_events(held)

    def _note_instants(self, first_at: int, last_at: int) -> None:
        self._first_at, self._last_at = min(self._first_at, first_at), max(self._last_at, last_at)

    def _times(self, instants: NDArray[np.int64]) -> list[rr.TimeColumn]:
        assert self._origin is not None
        return [rr.TimeColumn(TIMELINE, duration=(instants - self._origin).astype("timedelta64[ns]"))]

    def _show_event(self, event: RunEvent) -> None:
        if isinstance(event, TextEvent):
            assert self._origin is not None
            # an entry shows one line alone, and the column of its time is too narrow for all of its digits
            text = f"{(event.at - self._origin) / NS_PER_S:.3f} s  {event.text}"
            lines = wrap(text, _EVENT_COLUMNS, subsequent_indent="    ")
            self._stream.send_columns(
                EVENTS,
                self._times(np.full(len(lines), event.at)),
                rr.TextLog.columns(text=lines, level=[event.level] * len(lines)),
            )
        elif isinstance(event, StateEvent):
            if event.track.startswith(INJECTED_TRACK):
                self._faults.take(event.track, event.label, event.at)
            else:
                self._show_changes(event.track, [LabelChange(event.at, event.label)])
        elif isinstance(event, LoadEvent):
            self._show_load(event)

    def _show_load(self, event: LoadEvent) -> None:
        scale = self._scales[self._axes.index(event.axis)] if event.axis in self._axes else 1.0
        self._plot(f"/{event.axis}/torque/brake", np.array([event.at]), np.array([scale * event.torque_nm]))

    def _show_axis(self, number: int, name: str, rows: Rows) -> None:
        self._show_changes(f"{name} drive", self._drives[number].changes(rows))
        self._show_changes(f"{name} link", self._links[number].changes(rows))
        self._dropouts[number].add(rows["due_at"], rows["fate"])
        self._send_changes(f"{name} {BY_CYCLE}", self._fates[number].changes(rows))
        self._gaps[name].add(rows["due_at"], rows["fate"] != FATE_SAMPLE)
        if number == 0:
            # A cycle without SYNC is one of all axes.
            self._show_changes("host", self._host.changes(rows))
            self._missed |= bool((rows["fate"] == FATE_MISSED).any())
        due_at = rows["due_at"]
        self._last_cycle = max(self._last_cycle, int(due_at[-1]))
        if self._offset_origin_ns[number] is None:
            self._offset_origin_ns[number] = first_offset_ns(rows)
        positions = self._plan.review.axes[number].quantity == "position"
        lines = dict(lines_of(rows, self._scales[number], self._offset_origin_ns[number], positions))
        for place, channel in enumerate(self._plan.channels.get(name, ())):
            lines[f"controller/{channel}"] = rows[f"channel_{place}"]
        self._stream.send_columns(cycles_entity(name), self._times(due_at), cycle_columns(lines))
        for path, values in lines.items():
            self._envelop(f"/{name}/{path}", due_at, values)
        for path, times, values in marks_of(rows):
            self._send(f"/{name}/{path}", times, values)
        self._marks[name] += int((rows["fate"] != FATE_SAMPLE).sum())
        if self._live:
            ends = due_at[[0, -1]]
            self._send(f"{LIMITS}/{name}/delay/deadline", ends, np.full(2, self._plan.deadline / NS_PER_US))
        if number == 0:
            self._rows += rows.size

    def _plot(self, path: str, due_at: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Points of a line that has other instants than the cycles, and its envelope; values: (n,)."""
        self._send(path, due_at, values)
        self._envelop(path, due_at, values)

    def _envelop(self, path: str, due_at: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        if due_at.size and not self._live:
            self._envelopes.setdefault(path, Envelope()).add(due_at, values)

    def _send(self, path: str, due_at: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        if not due_at.size:
            return
        if path not in self._styled:
            self._styled.add(path)
            self._stream.log(path, style_of(self._plan, path), static=True)
        self._stream.send_columns(path, self._times(due_at), rr.Scalars.columns(scalars=values))

    def _show_changes(self, track: str, changes: Sequence[LabelChange]) -> None:
        shown, kept = self._shown.setdefault(track, []), list[LabelChange]()
        for at, text in changes:
            change = LabelChange(at, text[:1].upper() + text[1:])
            place = bisect_right(shown, at, key=attrgetter("at"))
            if not place or shown[place - 1].label != change.label:
                shown.insert(place, change)
                kept.append(change)
        self._send_changes(track, kept)

    def _send_changes(self, track: str, changes: Sequence[LabelChange]) -> None:
        if changes:
            times, labels = zip(*changes, strict=True)
            self._stream.send_columns(STATES, self._times(np.array(times)), [lane_column(track, labels)])

    def _show_verdict(self, summary: Summary | None) -> None:
        text = verdict_markdown(self._plan, summary, self._told)
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
