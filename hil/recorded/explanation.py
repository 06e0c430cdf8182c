"""Why a run did not pass: for each broken limit, fault and burst of dropouts the guilty cycles, what was
injected or seen just before, and the cycles and frames around.

The figures are those of the verdict and of the review; nothing is judged here.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from servobench.drivers.errors import BadInput, printable
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US
from servobench.hil.loop.cycle_record import COLUMNS, COMMAND_FATES, FATE_SAMPLE, NOTHING
from servobench.hil.recorded.recorded_run import RecordedRun
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.frame_columns import LogWindow
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.reviewing.trace.trace_entry import TraceEntry
from servobench.hil.rows.events import ACTIVE, INJECTED_TRACK, PARTS, QUIET, read_events
from servobench.hil.rows.records import Rows
from servobench.hil.rows.records_file import read_records, read_some
from servobench.hil.rows.run_files import EVENTS_FILE, RECORDS_FILE
from servobench.hil.verdict.metrics import metric_title
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import Check, LimitResult, VerdictKind

AROUND_NS: Final = 50 * NS_PER_MS
"""Of cycles and frames, before and behind."""
BEFORE_NS: Final = 500 * NS_PER_MS
"""So long before something counts as just before."""
PLACES_MAX: Final = 5
"""That are shown in full; what comes first is told first."""
_EVENTS_MAX: Final = 8
_BURSTS_MAX: Final = 3
"""Of each axis, the longest."""
_BURST_CYCLES: Final = 3
"""Fewer in a row are no burst, unless a limit speaks of dropouts."""
_OF_DROPOUTS: Final = ("dropouts_percent_max", "losses_in_a_row_max", "missed_percent_max")
_OF_DELAYS: Final = ("delay_p99_us_max", "certified_action_delay_us")
_OF_TIMES: Final = ("settling_time_ms_max", "recovery_time_ms_max")
"""What is too long goes on behind its instant for so long: what was injected meanwhile is a cause."""
_LOOKED_AT: Final = ("sequence", "axis", "due_at", "fate", "delay_ns")
_FATES: Final = next(column.codes for column in COLUMNS if column.name == "fate")
_BY_LIMITS: Final = (VerdictKind.NOT_PASSED, VerdictKind.NOT_MEASURED)
_WORTH: Final = ("WARN", "ERROR", "CRITICAL")


class LostInARow(NamedTuple):
    """Cycles in a row of one axis without a usable reading."""

    axis: str
    first: int
    """Its number."""
    last: int
    begin_ns: int
    """When the first was due, run time."""
    end_ns: int
    fates: Mapping[str, int]
    """How many of each cause."""

    @property
    def cycles(self) -> int:
        return self.last - self.first + 1

    def __str__(self) -> str:
        causes = ", ".join(f"{count} {cause}" for cause, count in self.fates.items())
        which = f"cycle {self.first}" if self.cycles == 1 else f"cycles {self.first} to {self.last}"
        return f"{self.axis}: no reading in {which} ({causes})"


class Bursts:
    """The longest bursts of each axis, and its longest delay; add all rows in their order."""

    def __init__(self, axes: Sequence[str]) -> None:
        self._axes = axes
        self._open: list[list[tuple[int, int, int]]] = [[] for _ in axes]
        """Number, instant and fate of the dropouts in a row that came last."""
        self._longest: list[list[LostInARow]] = [[] for _ in axes]
        self.delayed: dict[str, tuple[int, int, int]] = {}
        """By axis the longest delay, ns, with the number of its cycle and when that was due."""
        self.batches: list[tuple[int, int]] = []
        """From when to when the cycles of each call were due, run time; an end before its begin: none."""

    def add(self, rows: Rows) -> None:
        """(n,), with the columns of :data:`_LOOKED_AT` at least: the next batch of the file, in run time."""
        due_at = rows["due_at"]
        self.batches.append((int(due_at.min()), int(due_at.max())) if rows.size else (0, -1))
        for number, name in enumerate(self._axes):
            mine = rows if len(self._axes) == 1 else rows.compress(rows["axis"] == number)
            if mine.size:
                self._add(number, name, mine)

    def found(self) -> list[LostInARow]:
        """In order of time."""
        for number in range(len(self._axes)):
            self._close(number)
        return sorted((burst for each in self._longest for burst in each), key=lambda burst: burst.begin_ns)

    def _add(self, number: int, name: str, mine: Rows) -> None:
        known = np.flatnonzero(mine["delay_ns"] != NOTHING)
        if known.size:
            row = mine[known[np.argmax(mine["delay_ns"][known])]]
            told = int(row["delay_ns"]), int(row["sequence"]), int(row["due_at"])
            self.delayed[name] = max(told, self.delayed.get(name, told))
        lost = mine.compress(mine["fate"] != FATE_SAMPLE)
        for sequence, due_at, fate in zip(
            lost["sequence"].tolist(), lost["due_at"].tolist(), lost["fate"].tolist(), strict=True
        ):
            if self._open[number] and self._open[number][-1][0] != sequence - 1:
                self._close(number)
            self._open[number].append((sequence, due_at, fate))
        if self._open[number] and self._open[number][-1][0] != int(mine["sequence"][-1]):
            self._close(number)

    def _close(self, number: int) -> None:
        rows, self._open[number] = self._open[number], []
        if rows:
            fates = [_FATES[fate] for _, _, fate in rows]
            counts = {cause: fates.count(cause) for cause in dict.fromkeys(fates)}
            burst = LostInARow(self._axes[number], rows[0][0], rows[-1][0], rows[0][1], rows[-1][1], counts)
            longest = [*self._longest[number], burst]
            self._longest[number] = sorted(longest, key=lambda each: -each.cycles)[:_BURSTS_MAX]


@dataclass(slots=True)
class GuiltyPlace:
    """A stretch of a run in which something went wrong."""

    spans: list[tuple[int, int]]
    """From when to when, run time, each with both ends."""
    told: list[str]
    """What, each in words."""
    axes: list[str] = field(default_factory=list)
    before: list[str] = field(default_factory=list)
    """What was injected or seen just before and within, the latest last."""
    goes_on_to_ns: int = 0
    """Until when that counts, run time, where it is later than the last span."""
    cycles: list[dict[str, Any]] = field(default_factory=list)
    frames: list[TraceEntry] = field(default_factory=list)

    @property
    def begin_ns(self) -> int:
        return min(begin for begin, _ in self.spans)

    @property
    def end_ns(self) -> int:
        return max(end for _, end in self.spans)

    def is_guilty(self, at_ns: int) -> bool:
        """Return whether an instant is of one of its spans."""
        return any(begin <= at_ns <= end for begin, end in self.spans)

    def as_json(self, zero_ns: int) -> dict[str, Any]:
        """``zero_ns``: the first cycle as the stamps of frames count."""
        return {
            "begin_s": self.begin_ns / NS_PER_S,
            "end_s": self.end_ns / NS_PER_S,
            "told": self.told,
            "axes": self.axes,
            "before": self.before,
            "cycles": self.cycles,
            "frames": [entry.as_json(zero_ns) for entry in self.frames],
        }


@dataclass(frozen=True, slots=True)
class Explanation:
    """Of one run."""

    places: tuple[GuiltyPlace, ...]
    """The gravest, in order of time."""
    elsewhere: tuple[str, ...]
    """What went wrong at no one instant, or is not known to have been at one."""
    notes: tuple[str, ...] = ()
    """What could not be shown, and why."""
    more: int = 0
    """Places beyond those that are shown."""
    zero_ns: int = 0


def brief(summary: Summary, folder: Path) -> Explanation:
    """What the summary and the events tell, without the rows: for the end of a run."""
    events = list(read_events(folder / EVENTS_FILE))
    places, elsewhere = _places(summary, events, [], {})
    shown = _shown(places, events)
    return Explanation(tuple(shown), tuple(elsewhere), more=len(places) - len(shown))


def explain(run: RecordedRun, summary: Summary) -> Explanation:
    """With the cycles and the frames around; ``summary``: the run's own, or by other limits.

    Of each cycle a few columns are read, of those around all.
    """
    notes, bursts = list[str](), Bursts(run.axes)
    for rows in read_records(run.folder / RECORDS_FILE, columns=_LOOKED_AT):
        bursts.add(rows)
    events = list(read_events(run.folder / EVENTS_FILE))
    places, elsewhere = _places(summary, events, bursts.found(), bursts.delayed)
    shown = _shown(places, events)
    for place in shown:
        begin, end = place.begin_ns - AROUND_NS, place.end_ns + AROUND_NS
        numbers = [n for n, (first, last) in enumerate(bursts.batches) if begin <= last and first <= end]
        for rows in read_some(run.folder / RECORDS_FILE, numbers):
            near = rows.compress((rows["due_at"] >= begin) & (rows["due_at"] <= end))
            place.cycles += [_cycle(row, run.axes) for row in near]
    zero_ns = 0
    try:
        bus = RecordedBus(run.folder)
        known, zero_ns = bus.known([]), bus.zero_ns or 0
        notes += [*bus.notes, *bus.log.notes()]
        for place in shown:
            window = LogWindow(zero_ns + place.begin_ns - AROUND_NS, zero_ns + place.end_ns + AROUND_NS)
            entries = decode(bus.of_window(window, run.sealed), known, window.end_ns)
            place.frames = [each for each in entries if _within(each.at_ns, window)]
    except BadInput as error:
        notes.append(f"no frames: {error}")
    return Explanation(tuple(shown), tuple(elsewhere), tuple(notes), len(places) - len(shown), zero_ns)


def _shown(places: Sequence[GuiltyPlace], events: Sequence[Mapping[str, Any]]) -> list[GuiltyPlace]:
    """The gravest, in order of time, with what was before them."""
    shown = sorted(places[:PLACES_MAX], key=lambda place: place.begin_ns)
    for place in shown:
        place.before = _before(events, place)
    return shown


def _within(at_ns: int | None, window: LogWindow) -> bool:
    return at_ns is not None and window.begin_ns <= at_ns <= window.end_ns


def _places(
    summary: Summary,
    events: Sequence[Mapping[str, Any]],
    bursts: Sequence[LostInARow],
    delayed: Mapping[str, tuple[int, int, int]],
) -> tuple[list[GuiltyPlace], list[str]]:
    """Each place once, in order of time; then what has none."""
    found, elsewhere, of_dropouts = list[GuiltyPlace](), list[str](), list[str]()
    for finding in summary.verdict.findings:
        if summary.verdict.limits and finding.outcome in _BY_LIMITS:
            continue
        text = f"{finding.outcome}: {finding.text}"
        at_ns = _instant_of(finding.text, events)
        if at_ns is None:
            elsewhere.append(text)
        else:
            found.append(GuiltyPlace([(at_ns, at_ns)], [text]))
    for check in summary.verdict.limits:
        if check.result is LimitResult.KEPT:
            continue
        text, at_ns = _check_text(check), check.at_ns
        if check.metric in _OF_DELAYS and delayed:
            axis, (longest, sequence, at_ns) = max(delayed.items(), key=lambda each: each[1])
            text += f"; the longest {longest / NS_PER_US:.0f} us, {axis} in cycle {sequence}"
        if check.metric in _OF_DROPOUTS and bursts:
            of_dropouts.append(text)
        elif at_ns is None or check.result is LimitResult.NOT_MEASURED:
            elsewhere.append(text)
        else:
            place = GuiltyPlace([(at_ns, at_ns)], [text], [check.axis] if check.axis else [])
            if check.metric in _OF_TIMES and check.value is not None and math.isfinite(check.value):
                place.goes_on_to_ns = at_ns + round(check.value * NS_PER_MS)
            found.append(place)
    for number, burst in enumerate(sorted(bursts, key=lambda each: -each.cycles)):
        if of_dropouts or burst.cycles >= _BURST_CYCLES:
            told = [*(of_dropouts if number == 0 else ()), str(burst)]
            found.append(GuiltyPlace([(burst.begin_ns, burst.end_ns)], told, [burst.axis]))
    return _merged(found), elsewhere


def _check_text(check: Check) -> str:
    value = "not measured" if check.value is None else f"{check.value:.4g}"
    text = f"{metric_title(check.metric)}: {value}, at most {check.limit:g}"
    text = f"{check.axis}: {text}" if check.axis else text
    return text if check.result is LimitResult.BROKEN else f"{text} ({check.result})"


def _merged(found: Sequence[GuiltyPlace]) -> list[GuiltyPlace]:
    """Places that are no further apart than what is shown around them are one."""
    places: list[GuiltyPlace] = []
    for one in found:
        for place in places:
            if one.begin_ns <= place.end_ns + AROUND_NS and place.begin_ns <= one.end_ns + AROUND_NS:
                place.spans += one.spans
                place.goes_on_to_ns = max(place.goes_on_to_ns, one.goes_on_to_ns)
                place.told += [text for text in one.told if text not in place.told]
                place.axes += [axis for axis in one.axes if axis not in place.axes]
                break
        else:
            places.append(one)
    return places


def _instant_of(text: str, events: Sequence[Mapping[str, Any]]) -> int | None:
    """Return when the event was that tells the same as a finding, or part of it; None: none does."""
    for event in events:
        told = str(event.get("text", ""))
        if event.get("level") in _WORTH and (told in text or text in told):
            return int(event["at_ns"])
    return None


def _before(events: Sequence[Mapping[str, Any]], place: GuiltyPlace) -> list[str]:
    """What the events say of the time just before a place and within, and which faults were active then."""
    active: dict[str, tuple[int, str]] = {}
    told = list[tuple[int, str]]()
    for event in sorted(events, key=lambda each: int(each["at_ns"])):
        at_ns = int(event["at_ns"])
        if at_ns > max(place.end_ns, place.goes_on_to_ns):
            break
        track = str(event.get("track", ""))
        if track.startswith(INJECTED_TRACK):
            if event.get("state") == ACTIVE:
                active[track] = at_ns, f"{track}, active"
            else:
                active.pop(track, None)
        elif track.rpartition(" ")[2] in PARTS:
            active.pop(track, None)
            if (state := str(event.get("state"))) != QUIET:
                active[track] = at_ns, f"{track}: {state}"
        elif "text" in event and at_ns >= place.begin_ns - BEFORE_NS and (at_ns >= 0 or place.begin_ns < 0):
            told.append((at_ns, str(event["text"])))
    since = [
        (at_ns, f"{text} since then") for at_ns, text in active.values() if at_ns < place.begin_ns - BEFORE_NS
    ]
    lines = [*since, *told[-_EVENTS_MAX:]]
    return [f"{at_ns / NS_PER_S:.6f} s  {printable(text)}" for at_ns, text in lines]


def _cycle(row: np.void, axes: Sequence[str]) -> dict[str, Any]:
    """What a reader wants of a row; None where there is nothing."""

    def real(name: str) -> float | None:
        value = float(row[name])
        return None if np.isnan(value) else value

    def whole(name: str, of: float) -> float | None:
        return None if row[name] == NOTHING else int(row[name]) / of

    command = int(row["command_fate"])
    return {
        "axis": axes[int(row["axis"])],
        "sequence": int(row["sequence"]),
        "due_s": int(row["due_at"]) / NS_PER_S,
        "fate": _FATES[int(row["fate"])],
        "delay_us": whole("delay_ns", 1e3),
        "reference_rad_s": real("reference_rad_s"),
        "velocity_rad_s": real("velocity_rad_s"),
        "command_torque_nm": real("command_torque_nm"),
        "command": None if command == NOTHING else COMMAND_FATES[command].value,
        "lateness_us": None
        if row["woke_at"] == NOTHING
        else (int(row["woke_at"]) - int(row["due_at"])) / 1e3,
    }
