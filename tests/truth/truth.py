"""From what the taps saw to what happened in each cycle of one axis."""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.virtual_bus.frame import Frame
from tests.truth.taps import SYNC_ID, Heard, HeardCommand, Passed, PdoLayout, TapLog

SPEED, STAMP = 0x606C, 0x1013
_STEP_LEAST_NS: Final = 2 * NS_PER_US
_DRIFT_MAX: Final = 2e-3
"""A clock that moved further against the bench's than twice the 1000 ppm that a drive may drift, and than two
ticks of 1013h, was stepped."""
_NEVER: Final = 1 << 62


class Reading(NamedTuple):
    """A reading that the loop was given."""

    received_at: Instant
    order: int
    """Its place among all that the loop fetched."""
    heard: Heard


@dataclass(frozen=True, slots=True)
class SyncTruth:
    """A SYNC that the loop handed over, or was given."""

    handed_at: Instant
    on_bus_at: Instant | None
    """Its first end of frame; None if it never was on the bus."""
    reading: Reading | None
    """The first that came in answer; None if none did."""
    overtaken: bool
    """The answer to a later SYNC had come before that."""


@dataclass(frozen=True, slots=True)
class CommandTruth:
    """A set-point that the loop handed over."""

    handed_at: Instant
    on_bus_at: Instant | None
    acts_at: Instant | None
    """From when the drive followed it; None if it was lost on the way, or replaced before it acted."""


@dataclass(frozen=True, slots=True)
class AxisTruth:
    """All that happened to one drive and its readings."""

    layout: PdoLayout
    syncs: tuple[SyncTruth, ...]
    """Of the whole run, those of the calibration too, in the order of their hand-over."""
    place_of: dict[int, int]
    """Instant of a hand-over -> its place in ``syncs``."""
    answered_at: dict[int, list[tuple[int, Heard]]]
    """Instant at which a frame of a reading was given to the loop -> places of the SYNCs it answers."""
    steps_at: tuple[Instant, ...]
    """First SYNCs heard after a step of the drive's clock."""
    commands: dict[int, CommandTruth]
    """By the instant of the hand-over, as far as it is known what became of them."""
    at_once: dict[int, list[CommandTruth]] = field(default_factory=dict)
    """Of instants at which several were handed over, all of them in order: a host that was late may serve two
    cycles in one instant of simulated time."""

    def handed_between(self, begin: int, end: int) -> tuple[SyncTruth, ...]:
        """The SYNCs handed over in [begin, end)."""
        first = bisect_left(self.syncs, begin, key=lambda sync: sync.handed_at)
        last = bisect_left(self.syncs, end, key=lambda sync: sync.handed_at)
        return self.syncs[first:last]


@dataclass(frozen=True, slots=True)
class Passages:
    """What the taps of a segment saw, put in order once for all its drives; frames by their identity."""

    handed: list[Passed]
    """SYNCs, in the order of their hand-over."""
    places: dict[int, int]
    """The place of each in ``handed``."""
    on_bus: dict[int, Instant]
    """When a frame was first on the bus."""
    fetched: dict[int, tuple[int, Instant]]
    """Its place among what the loop fetched, and its stamp there, of the first time."""


def passages(log: TapLog, syncs_heard: bool = False) -> Passages:
    """``syncs_heard``: the loop hands no SYNC over, so the stamp with which it was given one stands for the
    hand-over, and what it was never given is none of its SYNCs."""
    handed = [
        passed
        for passed in (log.fetched_syncs if syncs_heard else log.handed)
        if passed.frame.can_id == SYNC_ID
    ]
    fetched: dict[int, tuple[int, Instant]] = {}
    for order, (at, frame) in enumerate(log.fetched):
        fetched.setdefault(id(frame), (order, at))
    places = {id(passed.frame): place for place, passed in enumerate(handed)}
    return Passages(handed, places, _first(log.on_bus), fetched)


def axis_truth(
    log: TapLog,
    node_id: int,
    reading_is_a_set: bool,
    syncs_heard: bool = False,
    seen: Passages | None = None,
) -> AxisTruth:
    """What happened at the drive of ``node_id``.

    ``reading_is_a_set``: a reading has come with the last of the TPDOs of its SYNC, else with its speed.
    ``syncs_heard``: see :func:`passages`. ``seen``: those of ``log``, for a segment of several drives.
    """
    drive = log.drives[node_id]
    layout = drive.layout
    if layout is None:
        raise ValueError(f"node {node_id} never answered a SYNC")
    awaited = frozenset(layout.each_sync) if reading_is_a_set else frozenset({layout.sent[SPEED].can_id})
    if seen is None:
        seen = passages(log, syncs_heard)
    handed, places, on_bus, fetched = seen.handed, seen.places, seen.on_bus, seen.fetched
    readings: dict[int, list[Reading]] = defaultdict(list)
    answer_to: dict[int, tuple[int, Heard]] = {}
    for heard in drive.syncs:
        place = places.get(id(heard.frame))
        if place is None:
            continue  # a SYNC of somebody else
        frames = [frame for frame in heard.answers if frame.can_id in awaited]
        answer_to.update({id(frame): (place, heard) for frame in frames})
        reading = _reading(heard, frames, fetched)
        if reading is not None:
            readings[place].append(reading)
    first = {place: min(came, key=lambda reading: reading.order) for place, came in readings.items()}
    answered_at: dict[int, list[tuple[int, Heard]]] = defaultdict(list)
    for at, frame in log.fetched:
        answer = answer_to.get(id(frame))
        if answer is not None:
            answered_at[at].append(answer)
    commands = _command_truths(log, node_id, on_bus)
    return AxisTruth(
        layout,
        _sync_truths(handed, on_bus, first),
        {passed.at: place for place, passed in enumerate(handed)},
        answered_at,
        tuple(steps(drive.syncs)),
        {at: together[-1] for at, together in commands.items()},
        {at: together for at, together in commands.items() if len(together) > 1},
    )


def steps(syncs: list[Heard]) -> list[Instant]:
    """When SYNCs were first heard after a step of the clock."""
    found = []
    for last, heard in pairwise(syncs):
        passed = heard.at - last.at
        moved = abs(heard.clock_ns - last.clock_ns - passed)
        if moved > _STEP_LEAST_NS + _DRIFT_MAX * passed:
            found.append(heard.at)
    return found


def spacings_below(instants: list[Instant], least: Duration) -> int:
    """How many follow the one before by less than ``least``."""
    return sum(later - earlier < least for earlier, later in pairwise(instants))


def _first(passed: Iterable[Passed]) -> dict[int, Instant]:
    """By identity of the frame, when it first passed."""
    first: dict[int, Instant] = {}
    for at, frame in passed:
        first.setdefault(id(frame), at)
    return first


def _reading(heard: Heard, frames: list[Frame], fetched: dict[int, tuple[int, Instant]]) -> Reading | None:
    came = [fetched[id(frame)] for frame in frames if id(frame) in fetched]
    if not frames or len(came) < len(frames):
        return None
    order, at = max(came)
    return Reading(at, order, heard)


def _sync_truths(
    handed: list[Passed], on_bus: dict[int, Instant], readings: dict[int, Reading]
) -> tuple[SyncTruth, ...]:
    """From the last to the first, so that it is known what came in answer to later ones."""
    made = []
    earliest_later = _NEVER
    for place in range(len(handed) - 1, -1, -1):
        at, frame = handed[place]
        reading = readings.get(place)
        overtaken = reading is not None and earliest_later < reading.order
        made.append(SyncTruth(at, on_bus.get(id(frame)), reading, overtaken))
        if reading is not None:
            earliest_later = min(earliest_later, reading.order)
    return tuple(reversed(made))


def _command_truths(log: TapLog, node_id: int, on_bus: dict[int, Instant]) -> dict[int, list[CommandTruth]]:
    drive = log.drives[node_id]
    assert drive.layout is not None
    acts = _acting(drive.commands, drive.syncs) if drive.layout.command_is_synchronous else None
    if acts is None:
        acts = _first(Passed(at, frame) for at, frame, _ in drive.commands)
    commands: dict[int, list[CommandTruth]] = defaultdict(list)
    for at, frame in log.handed:
        if drive.layout.is_set_point(frame):
            commands[at].append(CommandTruth(at, on_bus.get(id(frame)), acts.get(id(frame))))
    return commands


def _acting(commands: list[HeardCommand], syncs: list[Heard]) -> dict[int, Instant]:
    """A synchronous RPDO acts at the next SYNC, unless a later one has come by then (CiA 301, 7.2.2.3)."""
    acts: dict[int, Instant] = {}
    last_place = -1
    for _, frame, place in reversed(commands):
        if place < len(syncs) and place != last_place:
            acts[id(frame)] = syncs[place].at
        last_place = place
    return acts
