"""What of a recording can be fitted: windows of readings of known SYNCs, with commands that acted.

A position or a torque is told in a frame of its own. It is of the SYNC before that frame where the frame came
as late as frames of its kind do and the one before it was in its place too; elsewhere it may be of another
SYNC, and is left out. The position of a row was carried on to the row's own sample by the mean of two speeds
(docs/recording.md); what was added is taken off again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from servobench.drivers.cia402.profile import State, state_of
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.loop.cycle_record import COMMAND_FATES, FATE_SAMPLE, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.rows.records import Rows
from servobench.hil.twin.plant import WARM_UP_S, Array, Instants, RecordedWindow

WINDOW_S: Final = 0.2
"""Two hundred readings at 1 kHz, a hundred for each of its two initial states; what commands come early or
late adds up no longer than that."""
READ_SHARE_MIN: Final = 0.5
"""A window with fewer of its readings says more about the bus than about the drive."""
_LATE_SHARE: Final = 0.1
"""Of a period: what a frame may come earlier or later than frames of its kind do at the median."""
_INTERNAL_LIMIT: Final = 1 << 11
"""Bit of 6041h: the drive made another torque than it was told."""
_ROUNDING_RAD: Final = 1e-8
"""What is left of two equal positions once the way of a period is taken off them; encoders count no finer."""
_WHOLE: Final = 0.1
"""Of a unit: what a told torque may lie off a whole number of those that the set-points were rounded to."""
_SILENT: Final = tuple(
    COMMAND_FATES.index(fate) for fate in (CommandFate.LOST, CommandFate.NOT_SENT, CommandFate.NOT_FOLLOWED)
)
_LOST: Final = COMMAND_FATES.index(CommandFate.LOST)
_OPEN: Final = COMMAND_FATES.index(CommandFate.NOT_IDENTIFIABLE)


@dataclass(frozen=True, slots=True)
class RecordedWindows:
    """The windows of an axis of one recording, and what was left out."""

    windows: list[RecordedWindow]
    left_out: int
    """Windows."""
    torque_unit_nm: float
    """One raw unit of the set-points."""
    position_unit_rad: float
    """The least step of the position that was seen; 0: none was."""


def windows_of(rows: Rows, on_sync: bool, window_s: float = WINDOW_S) -> RecordedWindows:
    """Cut the rows of one axis, in run time, into windows.

    ``on_sync``: set-points act with the SYNC that follows them. Raises ValueError for rows without torque
    set-points.
    """
    sent = (rows["command_raw"] != NOTHING) & np.isfinite(rows["command_torque_nm"])
    if not np.any(sent & (rows["command_raw"] != 0)):
        raise ValueError("no set-points of torque")
    unit_nm = _unit(rows, sent)
    command_at, command_nm, doubtful_at = _commands(rows, sent, unit_nm, on_sync)
    at, outputs, steady = _readings(rows)
    period = float(np.median(np.diff(rows["due_at"])))
    count = max(8, round(window_s * NS_PER_S / period))
    warm_up = round(WARM_UP_S * NS_PER_S)
    windows, left_out = [], 0
    first = math.ceil(1.5 * warm_up / period)
    for low in range(first, len(rows) - count + 1, count):
        part = slice(low, low + count)
        if not steady[part].all() or np.count_nonzero(at[part] != NOTHING) < READ_SHARE_MIN * count:
            left_out += 1
            continue
        instants = _filled(at[part], period)
        begin, end = int(instants[0]) - warm_up, int(instants[-1])
        before, behind = np.searchsorted(command_at, (begin, end))
        if before == 0 or np.any((doubtful_at > begin - period) & (doubtful_at < end)):
            left_out += 1
            continue
        windows.append(
            RecordedWindow(
                instants,
                outputs[0, part],
                outputs[1, part],
                outputs[2, part],
                held_nm=float(command_nm[before - 1]),
                command_at=command_at[before:behind],
                command_nm=command_nm[before:behind],
            )
        )
    return RecordedWindows(windows, left_out, unit_nm, _least_step(outputs[1]))


def _filled(at: Instants, period: float) -> Instants:
    """Return instants for the cycles without a sample too, at even distances between those with one."""
    known = np.flatnonzero(at != NOTHING)
    place = np.arange(len(at))
    behind = period * np.minimum(place - known[0], 0) + period * np.maximum(place - known[-1], 0)
    first = int(at[known[0]])
    between = np.interp(place, known, (at[known] - first).astype(float))
    return np.asarray(first + np.round(between + behind), np.int64)


def _unit(rows: Rows, sent: Instants) -> float:
    """Return N m of one raw unit: told torques are whole numbers of it, set-points were rounded to one."""
    raw = rows["command_raw"][sent].astype(float)
    about = float(raw @ rows["command_torque_nm"][sent] / (raw @ raw))
    told = rows["torque_nm"][np.isfinite(rows["torque_nm"])]
    whole = np.round(told / about)
    if not len(told) or np.any(np.abs(told / about - whole) > _WHOLE) or not np.any(whole):
        return about
    return float(whole @ told / (whole @ whole))


def _least_step(position: Array) -> float:
    """Return the least step between two positions in a row, above what rounding makes."""
    steps = np.abs(np.diff(position[np.isfinite(position)]))
    steps = steps[steps > _ROUNDING_RAD]
    return float(steps.min()) if len(steps) else 0.0


def _commands(rows: Rows, sent: Instants, unit_nm: float, on_sync: bool) -> tuple[Instants, Array, Instants]:
    """Return when those that acted did not act yet at the latest, their torques, and when one of unknown fate
    may have acted."""
    fate, on_bus, after = rows["command_fate"], rows["command_on_bus_at"], rows["command_acts_after"]
    followed = sent & ~np.isin(fate, _SILENT)
    there = followed & (on_bus != NOTHING)
    arrived = on_bus[there]
    if on_sync:
        syncs = rows["sync_on_bus_at"]
        syncs = syncs[syncs != NOTHING]
        place = np.searchsorted(syncs, arrived)
        arrived = np.where(place < len(syncs), syncs[np.minimum(place, len(syncs) - 1)], arrived)
    else:
        arrived = np.maximum(arrived, np.where(after[there] == NOTHING, arrived, after[there]))
    order = np.argsort(arrived, kind="stable")
    arrived, raw = arrived[order], rows["command_raw"][there][order]
    changed = np.concatenate(([True], raw[1:] != raw[:-1]))
    passed_over = bool(np.any((fate == _LOST) & (on_bus != NOTHING)))
    open_at = arrived[(fate[there][order] == _OPEN) & changed & passed_over]
    unseen_at = rows["command_handed_at"][followed & (on_bus == NOTHING)]
    doubtful = np.concatenate((open_at, unseen_at[unseen_at != NOTHING]))
    return arrived, unit_nm * raw, np.sort(doubtful)


def _readings(rows: Rows) -> tuple[Instants, Array, Instants]:
    """Return each cycle's instant of sampling, NOTHING where it is not certain, the outputs, (3, n), of that
    very sample, and whether the drive followed its set-points then without a load."""
    good = (rows["fate"] == FATE_SAMPLE) & (rows["certain"] != 0)
    at = np.where(good, rows["sampled_at"], NOTHING)
    outputs = np.full((3, len(rows)), np.nan)
    outputs[0, good] = rows["velocity_rad_s"][good]
    outputs[1] = _told_apart(rows, at, "position_rad", "position_told_at")
    outputs[2] = _told_apart(rows, at, "torque_nm", "torque_told_at")
    status = rows["statusword"]
    enabled = {code: state_of(int(code)) is State.OPERATION_ENABLED for code in np.unique(status[good])}
    limited = good & ((status & _INTERNAL_LIMIT) != 0)
    idle = good & np.array([not enabled.get(code, False) for code in status.tolist()])
    loaded = np.nan_to_num(rows["load_torque_nm"]) != 0.0
    return at, outputs, ~(limited | idle | loaded)


def _told_apart(rows: Rows, at: Instants, value: str, told_at: str) -> Array:
    """Return the values by the cycle whose SYNC they are of; NaN where that is open."""
    values = np.full(len(rows), np.nan)
    told, good = rows[told_at], at != NOTHING
    new = good & (told > 0) & np.concatenate(([True], told[1:] != told[:-1]))
    same_frame = new & (told == rows["received_at"])
    values[same_frame] = rows[value][same_frame]
    rest = np.flatnonzero(new & ~same_frame)
    if not len(rest):
        return values
    syncs = rows["sync_on_bus_at"].astype(np.int64)
    known = np.flatnonzero(syncs != NOTHING)
    of = known[np.maximum(np.searchsorted(syncs[known], told[rest]) - 1, 0)]
    late = told[rest] - syncs[of]
    period = float(np.median(np.diff(rows["due_at"])))
    usual = np.abs(late - np.median(late)) < _LATE_SHARE * period
    filled = np.zeros(len(rows), bool)
    filled[of[usual]] = True
    for row, cycle, in_place in zip(rest.tolist(), of.tolist(), usual.tolist(), strict=True):
        if not (in_place and cycle > 0 and filled[cycle - 1] and good[cycle]) or row - cycle not in (0, 1):
            continue
        carried = 0.0
        if row > cycle and value == "position_rad":
            speeds = rows["velocity_rad_s"][cycle] + rows["velocity_rad_s"][row]
            carried = 0.5 * float(speeds) * float(at[row] - at[cycle]) / NS_PER_S
        values[cycle] = float(rows[value][row]) - carried
    return values


def octaves_of(parts: Sequence[Array]) -> Array:
    """Return the rms by octaves, the first from one over a window, of parts (n,); no reading counts as 0."""
    count = min(len(part) for part in parts)
    lines = [np.fft.rfft(np.nan_to_num(part[:count])) for part in parts]
    power = np.asarray(np.mean(np.abs(lines) ** 2, axis=0) * 2.0 / count**2)
    edges = [1 << octave for octave in range(max(1, (len(power) - 1).bit_length()))]
    return np.asarray(np.sqrt(np.add.reduceat(power, [edge for edge in edges if edge < len(power)])))
