"""From what a third client of a hub heard to what happened in each cycle of one axis.

No frame is lost on a hub, and a drive answers SYNCs in the order in which it hears them. So the k-th TPDO
with a speed answers the k-th SYNC, whatever the drive's process did in between. When the loop handed a SYNC
over nobody else can see: the rows tell it, and it serves as a label. As all SYNCs are on the bus in the order
in which they were handed over, and the last one belongs to the last row, the order alone decides which.
"""

from collections import defaultdict
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.pdo import EVERY_SYNC, PdoMap, PdoPlan
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.frame import Frame
from tests.truth.hub_listener import FrameTable
from tests.truth.rows import MISSED, NO_INSTANT, READING_IS_A_SET, Told
from tests.truth.taps import SYNC_ID, Field, Heard, PdoLayout, fields_of
from tests.truth.truth import SPEED, AxisTruth, CommandTruth, Reading, SyncTruth

_SYNC: Final = Frame(SYNC_ID)
_ENABLED: Final = b"\x0f\0"
"""The controlword that stands before the set-point."""
ON_BUS_WITHIN: Final = Duration(100 * NS_PER_MS)
"""Longer no process waits for a core, even on a machine that others use too."""

Instants = NDArray[np.int64]


class OutOfOrder(AssertionError):
    """The order of the frames does not tell which answers which."""


@dataclass(frozen=True, slots=True)
class Spacings:
    """SYNCs that follow the last one by less than half a period."""

    handed: int
    on_bus: int
    held_up: int
    """Of those on the bus, those that were handed over with more than that between them: the first one had to
    wait for the bus, or for the process of the hub."""
    too_early: int
    """Those that ended on the bus before they were handed over, by the hub's stamps."""


def layout_of(plan: PdoPlan) -> PdoLayout:
    """Where the objects lie that a drive sends under ``plan``."""
    sent: dict[int, Field] = {}
    for pdo in plan.tpdos:
        sent = {**_fields(pdo), **sent}
    each = tuple(sorted(pdo.cob_id for pdo in plan.tpdos if pdo.transmission_type == EVERY_SYNC))
    command = plan.rpdos[0]
    return PdoLayout(each, sent, command.cob_id, command.synchronous, _fields(command)[0x6040])


def _fields(pdo: PdoMap) -> dict[int, Field]:
    return fields_of(pdo.cob_id, [(entry.index, entry.bits) for entry in pdo.entries])


def hub_truth(
    frames: FrameTable, told: Told, plan: PdoPlan, heard_commands: FrameTable, heard_syncs: bool = False
) -> AxisTruth:
    """What happened to one axis. ``heard_commands``: the RPDOs that its drive heard. ``heard_syncs``: the
    loop makes none, and a SYNC is handed to it with its end on the bus. Raises OutOfOrder."""
    layout = layout_of(plan)
    sync_ends = frames["at"][frames["can_id"] == SYNC_ID]
    handed_at = [Instant(at) for at in sync_ends.tolist()]
    if not heard_syncs:
        handed_at = label_hand_overs(sync_ends, told)
    by_id = {can_id: frames[frames["can_id"] == can_id] for can_id in layout.each_sync}
    firsts = {
        can_id: _first_answered(sync_ends, found["at"]) if heard_syncs else 0
        for can_id, found in by_id.items()
    }
    for can_id, found in by_id.items():
        if heard_syncs:
            continue
        if found.size != sync_ends.size or (found["at"] < sync_ends).any():
            raise OutOfOrder(f"{sync_ends.size} SYNCs and {found.size} frames {can_id:03X}h")
    completing = max(layout.each_sync) if READING_IS_A_SET else layout.sent[SPEED].can_id
    syncs: list[SyncTruth] = []
    answered_at: dict[int, list[tuple[int, Heard]]] = defaultdict(list)
    for place, end in enumerate(sync_ends.tolist()):
        rows = {
            can_id: found[place - firsts[can_id]]
            for can_id, found in by_id.items()
            if 0 <= place - firsts[can_id] < found.size
        }
        heard = Heard(Instant(end), _SYNC, [_frame(row) for row in rows.values()], end)
        if completing not in rows:
            syncs.append(SyncTruth(handed_at[place], Instant(end), None, False))
            continue
        came = Instant(int(rows[completing]["at"]))
        syncs.append(SyncTruth(handed_at[place], Instant(end), Reading(came, place, heard), False))
        answered_at[came].append((place, heard))
    places: dict[int, int] = {sync.handed_at: place for place, sync in enumerate(syncs)}
    commands = _command_truths(layout, frames, heard_commands, told)
    return AxisTruth(layout, tuple(syncs), places, answered_at, (), commands)


def _first_answered(sync_ends: Instants, came: Instants) -> int:
    """The SYNC that the first of a drive's frames answers, where SYNCs come before it is set up and after.

    It answers each SYNC from then on, at some time within the period before the next. So it is the last of
    the SYNCs from which every frame comes behind its own. Raises OutOfOrder if it is none.
    """
    for first in reversed(range(1 + sync_ends.size - came.size)):
        if (came >= sync_ends[first : first + came.size]).all():
            return first
    raise OutOfOrder(f"{sync_ends.size} SYNCs and {came.size} frames that answer them")


def label_hand_overs(sync_ends: Instants, told: Told) -> list[Instant]:
    """Of each SYNC on the bus when it was handed over; of those of the calibration, their end on the bus."""
    handed_at = told["sync_handed_at"][told["fate"] != MISSED]
    before = sync_ends.size - handed_at.size
    if before < 0:
        raise OutOfOrder(f"{handed_at.size} SYNCs handed over, {sync_ends.size} on the bus")
    if (np.abs(sync_ends[before:] - handed_at) > ON_BUS_WITHIN).any():
        raise OutOfOrder("a SYNC was on the bus long before or after it was handed over")
    return [Instant(at) for at in (*sync_ends[:before].tolist(), *handed_at.tolist())]


def sync_spacings(truth: AxisTruth, told: Told, period: Duration) -> Spacings:
    """Of the SYNCs that the rows know."""
    places = [truth.place_of[at] for at in told["sync_handed_at"][told["fate"] != MISSED].tolist()]
    handed_at = np.array([truth.syncs[place].handed_at for place in places])
    ended_at = np.array([truth.syncs[place].on_bus_at for place in places], np.int64)
    handed, on_bus = np.diff(handed_at) < period // 2, np.diff(ended_at) < period // 2
    held_up, too_early = on_bus & ~handed, ended_at < handed_at
    return Spacings(int(handed.sum()), int(on_bus.sum()), int(held_up.sum()), int(too_early.sum()))


def _command_truths(
    layout: PdoLayout, frames: FrameTable, heard: FrameTable, told: Told
) -> dict[int, CommandTruth]:
    """By their set-points, in the order of handing over, which a hub keeps. What that leaves open is left
    out.

    Synchronous commands are left out too: which SYNC the drive's process heard first is not known here.
    """
    if layout.command_is_synchronous:
        return {}
    sent = told[told["command_handed_at"] != NO_INSTANT]
    known = np.ones(sent.size, bool)
    on_bus, acting = (
        _in_order(table[table["can_id"] == layout.command_id], sent, known) for table in (frames, heard)
    )
    return {
        at: CommandTruth(Instant(at), on_bus.get(at), acting.get(at))
        for at in sent["command_handed_at"][known].tolist()
    }


def _in_order(table: FrameTable, sent: Told, known: NDArray[np.bool_]) -> dict[int, Instant]:
    """Instant of a hand-over -> that of its frame.

    Of a frame the first and the last command are sought that it may be, if all frames before it and all
    behind it are to have one too. Where these differ, the commands from the one to the other are not known.
    What is sent to enable the drive before, and to stop it after, is no command of a cycle. Raises OutOfOrder
    if another frame is none of them.
    """
    raws, handed = sent["command_raw"].tolist(), sent["command_handed_at"].tolist()
    if not handed:
        return {}
    instants, set_points = [], []
    for row in table:
        data = _frame(row).data
        if data[:2] == _ENABLED and row["at"] >= handed[0]:
            instants.append(int(row["at"]))
            set_points.append(int.from_bytes(data[2:4], "little", signed=True))
    firsts, place = [], -1
    for set_point in set_points:
        place = next((at for at in range(place + 1, len(raws)) if raws[at] == set_point), len(raws))
        firsts.append(place)
    found: dict[int, Instant] = {}
    place = len(raws)
    for first, set_point, instant in zip(
        reversed(firsts), reversed(set_points), reversed(instants), strict=True
    ):
        fitting = (at for at in range(place - 1, -1, -1) if raws[at] == set_point and handed[at] <= instant)
        place = next(fitting, -1)
        if not first <= place:
            raise OutOfOrder(f"a set-point of {set_point} at {instant} was heard, and not handed over before")
        if first == place:
            found[handed[place]] = Instant(instant)
        else:
            known[first : place + 1] = False
    return found


def _frame(row: np.void) -> Frame:
    data = bytes(row["data"]).ljust(8, b"\0")
    return Frame(int(row["can_id"]), data[: int(row["length"])])
