"""A commissioning as Rerun shows it: what was done, how the shaft moved, and what came of each step.

It is made from the recorded frames, so from what was on the bus: set-points and actual values as the PDOs of
that moment carried them, in the units that were found in the end. A commissioning that was killed has its
page, too, in the units that the drive tells.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from servobench.drivers.bounded_file import NoSuchFile, parse_json, read_text
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.written_file import written
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.hil.recording.lanes import AMBER, DIM, GOOD, RED, STATES, lane, lane_colors, lane_column
from servobench.hil.recording.page_series import BLUE, GREEN, GREY, Color
from servobench.hil.recording.plot_scale import (
    COLUMN_PX,
    LANE_GUTTER,
    about,
    fitted,
    gutter,
    lanes_px,
    plot_heights,
)
from servobench.hil.recording.rerun_page import (
    event_list,
    framed,
    from_zero,
    plot,
    run_times,
    send_line,
    stream_into,
)
from servobench.hil.reviewing.envelope import Envelope
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.node_objects import KnownNodes
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.reviewing.trace.trace_entry import TraceEntry
from servobench.hil.rows.events import read_events
from servobench.hil.rows.run_files import (
    COMMISSIONED_FILE,
    COMMISSIONING_FIGURES,
    COMMISSIONING_RECORDING,
    EVENTS_FILE,
    FRAMES_FILE,
    FRAMES_LOG,
    RERUN_FILE,
)
from servobench.hil.verdict.plain_values import from_plain

_APPLICATION: Final = "servobench commissioning"
_ZERO: Final = re.compile(r"0 ns is \((\d+)\.(\d{6})\)")
"""How the first event tells where the events' time begins in the stamps of frames."""
_STEP, _DRIVE = "step", "drive"
"""Lanes."""
_EVENTS, _FIGURES = "/events", "/figures"
_STEP_COLORS: Final = {"done": GOOD, "failed": RED, "skipped": DIM, "left out": DIM, "not done": DIM}
"""By verdict; a step whose verdict nobody has written down was under way."""


class _Signal(NamedTuple):
    plot: str
    name: str
    color: Color
    scale: float
    """From SI to the plot's unit."""


_SIGNALS: Final = {
    Object.TARGET_VELOCITY: _Signal("speed", "set-point 60FFh", GREY, RPM_PER_RAD_S),
    Object.VELOCITY_ACTUAL_VALUE: _Signal("speed", "actual 606Ch", BLUE, RPM_PER_RAD_S),
    Object.TARGET_POSITION: _Signal("position", "set-point 607Ah", GREY, 1.0 / (2.0 * np.pi)),
    Object.POSITION_ACTUAL_VALUE: _Signal("position", "actual 6064h", BLUE, 1.0 / (2.0 * np.pi)),
    Object.TARGET_TORQUE: _Signal("torque", "set-point 6071h", GREY, 1.0),
    Object.TORQUE_ACTUAL_VALUE: _Signal("torque", "actual 6077h", GREEN, 1.0),
}


@dataclass(frozen=True, slots=True)
class _Quantity:
    name: str
    value: float
    uncertainty: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class _Step:
    """Figures of a step in figures.json, as far as the page shows them."""

    name: str
    title: str
    verdict: str
    quantities: tuple[_Quantity, ...]
    faults: tuple[str, ...]
    reason: str
    headline: str


@dataclass(frozen=True, slots=True)
class _Figures:
    """The same of a commissioning."""

    steps: tuple[_Step, ...]
    header: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None


_RESULT_COLUMNS: Final = 52
"""A cell shows one line alone: so much a table at the right of a screen of 1920 shows beside the titles."""
_PLOTS: Final = {"speed": "Speed [r/min]", "position": "Position [turns]", "torque": "Torque [N m]"}


def is_commissioning(folder: Path) -> bool:
    """Return True if ``hil commission`` wrote the folder."""
    recording = folder / COMMISSIONING_RECORDING
    return any((recording / name).is_file() for name in (FRAMES_FILE, FRAMES_LOG))


def commissioning_page(folder: Path) -> Path:
    """The page of a commissioning, made if it is not there yet or older than what it is made from.

    Raises BadInput for a folder that cannot be read or written to.
    """
    recording = folder / COMMISSIONING_RECORDING
    page = recording / RERUN_FILE
    sources = [recording / FRAMES_FILE, recording / FRAMES_LOG, folder / COMMISSIONING_FIGURES]
    newest = max((path.stat().st_mtime_ns for path in sources if path.exists()), default=0)
    if not page.exists() or page.stat().st_mtime_ns < newest:
        _write(folder, page)
    return page


@dataclass(frozen=True, slots=True)
class _Lane:
    """What a lane shows from when on, and in which colours."""

    track: str
    times: list[int]
    labels: list[str]
    colors: Mapping[str, int]


def _write(folder: Path, page: Path) -> None:
    figures = _figures(folder)
    events = list(read_events(folder / COMMISSIONING_RECORDING / EVENTS_FILE))
    zero_ns = next((at_ns for event in events if (at_ns := _zero_ns(event)) is not None), None)
    bus = _Bus(RecordedBus(page.parent), _known(folder), zero_ns)
    end_ns = max([bus.end_ns, *(event["at_ns"] for event in events)])
    with written("RUN", page) as part, stream_into(part, _APPLICATION) as stream:
        lanes = [each for each in (_steps(events, figures), _drive(bus)) if each.times]
        for each in lanes:
            stream.send_columns(STATES, run_times(each.times), [lane_column(each.track, each.labels)])
        _send_texts(stream, _told(events))
        _send_bus(stream, bus)
        text = rr.TextDocument(_markdown(folder, figures), media_type=rr.MediaType.MARKDOWN)
        stream.log(_FIGURES, text, static=True)
        stream.send_blueprint(_layout(bus, lanes, end_ns / NS_PER_S))


def _figures(folder: Path) -> _Figures:
    """Read figures.json; a commissioning that was killed has none."""
    path, what = folder / COMMISSIONING_FIGURES, "what hil commission wrote"
    try:
        plain = parse_json(read_text(path, "commissioning"), str(path), what)
    except NoSuchFile:
        return _Figures(())
    try:
        return from_plain(_Figures, plain)
    except ValueError as error:
        raise BadInput(str(path), "", str(error), what) from None


def _known(folder: Path) -> KnownNodes:
    """The drive with the units that were found; with its own if none were."""
    path = folder / COMMISSIONED_FILE
    if not path.exists():
        return KnownNodes()
    drive = load_drive_file(path)
    return KnownNodes((), {("", drive.drive.node): drive.override})


def _zero_ns(event: Mapping[str, Any]) -> int | None:
    match = _ZERO.search(str(event.get("text", "")))
    return None if match is None else int(match[1]) * NS_PER_S + int(match[2]) * 1000


class _Bus:
    """Signals of the frames, and the drive's states."""

    def __init__(self, recorded: RecordedBus, known: KnownNodes, zero_ns: int | None) -> None:
        self.signals: dict[Object, Envelope] = {}
        self.states: list[tuple[int, str]] = []
        self.emergencies: list[tuple[int, str]] = []
        self.end_ns = 0
        self._zero_ns = zero_ns
        held: dict[Object, list[tuple[int, float]]] = {index: [] for index in _SIGNALS}
        for entry in decode(iter(recorded), known):
            if entry.at_ns is not None:
                self._take(entry, entry.at_ns, held)
        for index, points in held.items():
            if points:
                times, values = zip(*points, strict=True)
                self.signals[index] = envelope = Envelope()
                envelope.add(np.array(times, np.int64), np.array(values))

    def ends(self, plot: str) -> Iterator[float]:
        """Least and largest value of each signal in a plot."""
        for index, envelope in self.signals.items():
            if _SIGNALS[index].plot == plot:
                yield from envelope.ends() or ()

    def _take(self, entry: TraceEntry, stamp_ns: int, held: Mapping[Object, list[tuple[int, float]]]) -> None:
        if self._zero_ns is None:
            self._zero_ns = stamp_ns
        at_ns = self.end_ns = stamp_ns - self._zero_ns
        if entry.kind == "emcy":
            self.emergencies.append((at_ns, entry.text))
        if entry.kind not in ("pdo", "sdo"):
            return
        for value in entry.values:
            if value.index == Object.STATUSWORD and value.words:
                label = value.words[:1].upper() + value.words[1:]
                if not self.states or self.states[-1][1] != label:
                    self.states.append((at_ns, label))
            elif entry.kind == "pdo" and value.index in held and value.si is not None:
                index = Object(value.index)
                held[index].append((at_ns, value.si * _SIGNALS[index].scale))


def _steps(events: list[dict[str, Any]], figures: _Figures) -> _Lane:
    named = {step.name: step.title for step in figures.steps}
    begun = [event for event in events if event.get("track") == "step" and "state" in event]
    titles = [named.get(str(event["state"]), str(event["state"])) for event in begun]
    verdicts = {step.title: step.verdict for step in figures.steps}
    labels = list(dict.fromkeys(titles))
    colors = [_STEP_COLORS.get(verdicts.get(label, ""), AMBER) for label in labels]
    times = [event["at_ns"] for event in begun]
    return _Lane(_STEP, times, titles, dict(zip(labels, colors, strict=True)))


def _drive(bus: _Bus) -> _Lane:
    times, labels = [at for at, _ in bus.states], [label for _, label in bus.states]
    return _Lane(_DRIVE, times, labels, lane_colors("axis drive", ["axis"]))


def _told(events: list[dict[str, Any]]) -> list[tuple[int, str, str]]:
    told = [event for event in events if "text" in event and "level" in event]
    return [(each["at_ns"], str(each["level"]), str(each["text"])) for each in told]


def _send_bus(stream: rr.RecordingStream, bus: _Bus) -> None:
    counts = Counter(text for _, text in bus.emergencies)
    firsts = {text: at for at, text in reversed(bus.emergencies)}
    told = [
        (at, "WARN", f"{text}, {counts[text]} times in all" if counts[text] > 1 else text)
        for text, at in sorted(firsts.items(), key=lambda each: each[1])
    ]
    _send_texts(stream, told)
    for index, envelope in bus.signals.items():
        send_line(stream, _path(index), envelope.points(), _SIGNALS[index].name, _SIGNALS[index].color)


def _send_texts(stream: rr.RecordingStream, told: list[tuple[int, str, str]]) -> None:
    if told:
        texts = [f"{at / NS_PER_S:.3f} s  {text}" for at, _, text in told]
        rows = rr.TextLog.columns(text=texts, level=[level for _, level, _ in told])
        stream.send_columns(_EVENTS, run_times([at for at, _, _ in told]), rows)


def _path(index: Object) -> str:
    return f"/{_SIGNALS[index].plot}/{index:04X}h"


def _markdown(folder: Path, figures: _Figures) -> str:
    """Summarize the result of each step, as report.md has it."""
    parts = [f"# Commissioning · {folder.name}"]
    origin = [str(told) for key in ("date", "tool", "adapter") if (told := figures.header.get(key))]
    parts += [", ".join(origin)] if origin else []
    if not figures.steps:
        parts.append("It did not come to its end: nothing but frames and events is there.")
    if figures.error:
        parts.append(f"**{figures.error}**")
    rows = [
        f"| {each.title} | {each.verdict} | {line} |" if place == 0 else f"| | | {line} |"
        for each in figures.steps
        for place, line in enumerate(_result(each))
    ]
    parts.append("\n".join(["| step | | |", "|:--|:--|:--|", *rows]))
    return "\n\n".join(parts) + "\n"


def _result(step: _Step) -> list[str]:
    """In lines, as a cell shows one alone."""
    told = []
    for each in step.quantities:
        half = f" +- {each.uncertainty:.2g}" if each.uncertainty is not None else ""
        told.append(f"{each.name} {each.value:.5g}{half} {each.unit}".strip())
    faults = [f"**{line}**" for fault in step.faults for line in _cells(fault)]
    if not told and not faults:
        told = [step.reason or step.headline]
    return [*faults, *_cells("; ".join(told))] or [""]


def _cells(text: str) -> list[str]:
    return wrap(text.replace("|", "/"), _RESULT_COLUMNS)


def _layout(bus: _Bus, told: Sequence[_Lane], end_s: float) -> rrb.Blueprint:
    there = [name for name in _PLOTS if any(_SIGNALS[index].plot == name for index in bus.signals)]
    states_px = lanes_px(2)
    widest = [about(bus.ends(name)) for name in there]
    ranges = dict(zip(there, fitted(widest, COLUMN_PX - states_px), strict=True))
    plots = [
        plot("/", [f"+ /{name}/**"], _PLOTS[name], from_zero(end_s, gutter(ranges[name])), ranges[name])
        for name in there
    ]
    lanes = rrb.StateTimelineView(
        origin="/",
        contents=[f"+ {STATES}"],
        name="Steps and states",
        time_view=from_zero(end_s, LANE_GUTTER),
        overrides={STATES: [lane(each.track, each.colors) for each in told]},
    )
    right = rrb.Vertical(
        rrb.TextDocumentView(origin=_FIGURES, name="What came of it"),
        event_list(_EVENTS),
        row_shares=[6.5, 3.5],
    )
    spare = [1.0 / len(plots)] * len(plots) if plots else []
    heights = plot_heights([ranges[name] for name in there], COLUMN_PX - states_px, spare)
    content = rrb.Vertical(lanes, *plots, row_shares=[states_px, *heights])
    return framed(rrb.Horizontal(content, right, column_shares=[6.5, 3.5]))
