"""The lanes of states above the plots: which there are, in which order, and in which colours."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from servobench.drivers.cia402.profile import State
from servobench.hil.loop.cycle_record import CAUSES
from servobench.hil.reviewing.envelope import CodeLane, Envelope
from servobench.hil.reviewing.review import Review
from servobench.hil.reviewing.tracking_error import PositionErrorMeter, SpeedErrorMeter, speed_limits
from servobench.hil.rows.events import INJECTED_TRACK, PARTS, QUIET
from servobench.hil.rows.recording_plan import ReviewPlan
from servobench.hil.rows.records import (
    HOST_IN_TIME,
    HOST_MISSED,
    LINK_DEGRADED,
    LINK_DOWN,
    LINK_OK,
    LabelChange,
)
from servobench.hil.verdict.verdict import VerdictKind

if TYPE_CHECKING:
    import rerun as rr
    from rerun.blueprint import Visualizer

STATES: Final = "/state"
"""The entity of all lanes. Each is a component of it, called like its track: what the viewer writes above."""
_VERDICT, _LIMITS, _ERROR, _DROPOUTS, _INJECTED, _PART, _LINK, _HOST, _DRIVE, _PHASE, _OTHER = range(11)
"""The order of the lanes."""
VERDICT_TRACK: Final = "verdict"
"""Track of the whole run's verdict; an axis' track shows its speed error alone."""
LIMITS_TRACK: Final = "limits"
"""Track of a run that goes on: whether all its limits are kept so far."""
DROPOUTS, BY_CYCLE = "dropouts", "readings"
"""Kinds of track of an axis: dropouts in stretches of the whole run; the fate of each cycle's reading, which
takes its place where a part of the run is looked into."""
BROKEN: Final = "BROKEN"
SETTLING, KEPT, BEYOND, LATE, NOT_JUDGED = "Settling", "Kept", "BEYOND", "LATE", "Not judged"
_WINDOWS_MAX: Final = 100
"""Settling windows shown at most; the viewer writes the mere number of states into a lane with more."""
FEW_SHARE: Final = 0.1
"""Share of a stretch's cycles that must drop out before the stretch is shown as a dropout. A stretch of an
hour has 8 s, in which one cycle of a hundred would paint the lane from end to end."""
_WIDTH_LEAST: Final = 400
"""A fault is drawn at least such a part of the run wide, to be seen."""

_NOTHING: Final = 0x00000000
"""Of a state that is not drawn: the viewer's ground is seen, dark or light."""
DIM, GOOD, RED, AMBER = 0x9C9FA4FF, 0x1565C0FF, 0xD7230AFF, 0xFFFA46FF
"""As the viewer draws them, a fifth of each its ground's, dark or light, they are 40 and more (CIELAB) apart
under deuteranopia and protanopia too, and all but grey from the ground. So are the causes of dropouts; few
of a cause are its colour darkened."""
_VERDICT_COLORS: Final = {
    kind.value.capitalize(): RED if kind.exit_status else GOOD if kind is VerdictKind.PASSED else DIM
    for kind in VerdictKind
}
_DRIVE_COLORS: Final = {
    State.NOT_READY: 0x50555CFF,
    State.SWITCH_ON_DISABLED: 0x50555CFF,
    State.READY: 0x8A6D1FFF,
    State.SWITCHED_ON: 0xB8860BFF,
    State.OPERATION_ENABLED: GOOD,
    State.QUICK_STOP: 0xC2571AFF,
    State.FAULT_REACTION: RED,
    State.FAULT: RED,
}
_PART_COLORS: Final = {
    "Limited": RED,
    "Derated": RED,
    "Warned": AMBER,
    "Low": RED,
    "Charged": DIM,
    "Braking resistor": AMBER,
    "Holds": GOOD,
    "Opening": DIM,
    "Closing": AMBER,
}
"""States of a simulated drive's parts that are not as usual; others get a colour of the viewer's choice."""
_PHASE_COLORS: Final = {
    "Connecting": DIM,
    "Configuring": 0x4A4F7AFF,
    "Enabling": 0x6A4FA0FF,
    "Calibrating": 0x1C6F7AFF,
    "Running": 0x2E7D6BFF,
    "Stopping": 0x5A5F66FF,
    "Stopped": DIM,
}
"""Phases that a run goes through; any other gets a colour of the viewer's choice."""
_CAUSES: Final = [cause.value.capitalize() for cause in CAUSES]
_CAUSE_COLORS: Final = {
    **dict(zip(_CAUSES, (RED, AMBER, 0x8778D2FF, 0x1E00FFFF), strict=True)),
    **dict(
        zip(
            (f"{cause}, few" for cause in _CAUSES),
            (0x6B1105FF, 0x807D23FF, 0x443C69FF, 0x0F0080FF),
            strict=True,
        )
    ),
}


def live_tracks(axes: Sequence[str]) -> list[str]:
    """Lanes of a run that still goes on."""
    own = [f"{axis} {kind}" for kind in ("drive", "link") for axis in axes]
    return in_order([LIMITS_TRACK, "phase", "host", *own], axes)


def in_order(tracks: Iterable[str], axes: Sequence[str]) -> list[str]:
    """Lanes from above to below: those that a low screen cuts off tell least."""
    return sorted(tracks, key=lambda track: (_place(track, axes), track))


def lane_column(track: str, labels: Sequence[str | None]) -> "rr.ComponentColumn":
    """The labels of changes, (n,); None: nothing is known from then on."""
    import pyarrow as pa
    import rerun as rr

    return rr.ComponentColumn(track, rr.AnyBatchValue(track, pa.array(labels, pa.string())))


def lane(track: str, colors: Mapping[str, int]) -> "Visualizer":
    """A lane of a view: below the words of its track, in the colours of its labels, as far as they are
    known."""
    import rerun as rr
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    source = VisualizerComponentMapping(
        "StateChange:state", ComponentSourceKind.SourceComponent, source_component=track
    )
    if not colors:
        return rr.StateConfiguration().visualizer(mappings=[source])
    styled = rr.StateConfiguration(
        values=list(colors),
        labels=[" " if label == QUIET else label for label in colors],
        colors=np.array(list(colors.values()), np.uint32),
        visible=[color != _NOTHING for color in colors.values()],
    )
    return styled.visualizer(mappings=[source])


def _place(track: str, axes: Sequence[str]) -> int:
    kinds = {"error": _ERROR, "drive": _DRIVE, "link": _LINK, DROPOUTS: _DROPOUTS, BY_CYCLE: _DROPOUTS}
    kinds |= dict.fromkeys(PARTS, _PART)
    axis, _, kind = track.rpartition(" ")
    if axis in axes and kind in kinds:
        return kinds[kind]
    if track.startswith(INJECTED_TRACK):
        return _INJECTED
    named = {VERDICT_TRACK: _VERDICT, LIMITS_TRACK: _LIMITS, "phase": _PHASE, "host": _HOST}
    return named.get(track, _OTHER)


def lane_colors(track: str, axes: Sequence[str]) -> Mapping[str, int]:
    """By label; empty: the viewer chooses."""
    place = _place(track, axes)
    if place == _INJECTED:
        return {QUIET: _NOTHING, "Injected": AMBER}
    return {
        _VERDICT: {QUIET: _NOTHING, **_VERDICT_COLORS},
        _LIMITS: {KEPT: GOOD, BROKEN: RED},
        _ERROR: {QUIET: _NOTHING, SETTLING: DIM, NOT_JUDGED: DIM, KEPT: GOOD, BEYOND: RED, LATE: RED},
        _DRIVE: {
            **{state.value.capitalize(): color for state, color in _DRIVE_COLORS.items()},
            "Unknown": DIM,
        },
        _PHASE: _PHASE_COLORS,
        _LINK: {LINK_OK: GOOD, LINK_DEGRADED: AMBER, LINK_DOWN: RED},
        _DROPOUTS: {QUIET: _NOTHING, **_CAUSE_COLORS},
        _HOST: {HOST_IN_TIME: GOOD, HOST_MISSED: RED},
        _PART: {QUIET: _NOTHING, **_PART_COLORS},
    }.get(place, {})


def dropout_lane(fates: CodeLane) -> list[LabelChange]:
    """``fates``: of all rows of an axis."""
    labels = (QUIET, *_CAUSES, *(f"{cause}, few" for cause in _CAUSES))
    return [LabelChange(at, labels[code]) for at, code in fates.changes(len(_CAUSES), FEW_SHARE)]


class FaultWindows:
    """When each injected fault was at work, by what the events say."""

    def __init__(self) -> None:
        self._open: dict[str, int] = {}
        self._windows: dict[str, list[tuple[int, int]]] = {}

    def take(self, track: str, label: str, at: int) -> None:
        """``track``: one that begins with INJECTED_TRACK."""
        if label != QUIET:
            self._open.setdefault(track, at)
        elif track in self._open:
            kind = track.removeprefix(INJECTED_TRACK).partition(": ")[0]
            self._windows.setdefault(kind, []).append((self._open.pop(track), at))

    def lanes(self, first: int, last: int) -> dict[str, list[LabelChange]]:
        """By track: one for each kind, with all places together, from ``first`` to ``last``."""
        for track in list(self._open):
            self.take(track, QUIET, last)
        least = (last - first) // _WIDTH_LEAST
        return {
            INJECTED_TRACK + kind: _lane([(start, max(end, start + least)) for start, end in windows], first)
            for kind, windows in sorted(self._windows.items())
        }


def _lane(windows: Iterable[tuple[int, int]], first: int) -> list[LabelChange]:
    """One lane of windows that may overlap."""
    changes = [LabelChange(first, QUIET)]
    until = -math.inf
    for start, end in sorted(windows):
        if start > until:
            if until > -math.inf:
                changes.append(LabelChange(int(until), QUIET))
            changes.append(LabelChange(start, "Injected"))
        until = max(until, end)
    if until > -math.inf:
        changes.append(LabelChange(int(until), QUIET))
    return changes


def _breaches(limited: Iterable[tuple[Envelope, float | None]]) -> CodeLane:
    """Code values against their limits: 1 where a value is judged, 2 where it exceeds its limit, else 0."""
    points = [(*values.points(), limit) for values, limit in limited]
    times = np.concatenate([at for at, _, _ in points])
    codes = [np.zeros(len(at), np.int64) if most is None else 1 + (size > most) for at, size, most in points]
    order, lane = np.argsort(times, kind="stable"), CodeLane()
    if any(most is not None for _, _, most in points):
        lane.add(times[order], np.concatenate(codes)[order])
    return lane


def error_lane(review: Review, plan: ReviewPlan, number: int, begin: int, end: int) -> list[LabelChange]:
    """From when on the error of an axis was kept, beyond its limit, late, or not counted.

    Limits of a step response and of the following error hold while the axis settles, too. ``begin``,
    ``end``: the first and the last cycle.
    """
    speed, steps = review.errors[number], review.steps[number]
    meter: SpeedErrorMeter | PositionErrorMeter = speed
    limits = plan.limits
    limit, percent = speed_limits(speed, limits)[""], limits.after_load_percent_max
    limited = [(speed.counted, limit), (speed.after_load, None if percent is None else percent / 100.0)]
    followed = review.positions[number].following, limits.following_error_peak_rad_max
    if plan.axes[number].quantity == "position":
        meter, limit = review.positions[number], limits.position_error_peak_rad_max
        limited = [(meter.counted, limit)]
    names = NOT_JUDGED, KEPT, BEYOND
    lane = [(begin, NOT_JUDGED if limit is None else KEPT)]
    lane += [(at, names[code]) for at, code in _breaches(limited).changes()]
    if len(meter.settling) <= _WINDOWS_MAX:
        lane = _laid_over(lane, meter.settling, SETTLING, end)
    follows = [*_breaches([followed]).changes(), (end, 0)]
    beyond = [(at, then) for (at, code), (then, _) in pairwise(follows) if names[code] == BEYOND]
    lane = _laid_over(lane, [*beyond, *steps.overshot], BEYOND, end)
    lane = _laid_over(lane, steps.late, LATE, end)
    return [*(LabelChange(at, label) for at, label in lane), LabelChange(end, QUIET)]


_Marks = list[tuple[int, str]]


def _laid_over(lane: _Marks, windows: Sequence[tuple[int, int]], label: str, end: int) -> _Marks:
    """Return the lane with a label in windows apart from each other; behind each it is what it was."""
    starts = [at for at, _ in lane]
    marks = [(at, before) for at, before in lane if not any(a <= at < b for a, b in windows)]
    for start, stop in windows:
        marks.append((start, label))
        if stop < end:
            marks.append((stop, lane[bisect_right(starts, stop) - 1][1]))
    return sorted(marks, key=lambda mark: mark[0])
