"""How late host and drive were, by the frames alone, whose stamps are those of the bus: it is never late."""

from collections.abc import Sequence
from itertools import groupby, pairwise
from statistics import median
from typing import Final

from tests.witness.frames import Frame

SYNC: Final = 0x080
NMT: Final = 0x000
EMCY: Final = 0x080
"""Plus the node (CiA 301 7.3.5)."""
_CYCLES_MIN: Final = 100
"""Fewer tell no period."""
_LATE_BY: Final = 0.75
"""Of a period: the SYNCs by which a loop learns a drive's clock before it begins are 1.5 periods apart."""
_PAUSE: Final = 4.5
"""Periods without SYNC from which on the host has paused: between exercises it asks a drive every five."""
_STANDSTILL: Final = 10.0
"""Periods between two SYNCs without a word of the host from which on it was kept from its work: where it
pauses for longer, to reckon, it asks or commands by SDO or NMT before the next SYNC."""
_ANSWERED_WITHIN: Final = 0.5
"""Of a period: the benches leave loop.deadline_us at 2 ms of their 4. The simulated drive answers in 0.4 of
a period at most on a machine that has time for it; what comes later is late for the bench."""
_SHARE_MAX: Final = 0.002
"""Of the cycles: a machine that has time for all is late in none or two of a thousand."""
_IN_A_ROW: Final = 10
"""Late cycles from which on a motion is not judged, however few they are of all: a bench stops at 26."""
_SILENCE: Final = 15.0
"""Periods without any frame of the host while the drive is to operate: it asks or commands every five, and
every twelve and a half where it has the drive's watch over it run out."""
_ANSWER_S: Final = 0.2
"""After which this product's master asks again by SDO."""
_OPERATION: Final = 0x0F
"""Bits of the controlword of 'enable operation' (CiA 402-2, table 30)."""
_CONTROLWORD: Final = (0x6040).to_bytes(2, "little") + b"\0"
_TPDOS: Final = (3, 5, 7, 9)
"""Function codes of the predefined connection set (CiA 301 7.3.5)."""


def lateness(frames: Sequence[Frame], node: int, pauses: bool = True) -> str:
    """What a machine without time has done to the traffic with a node, in words; empty if nothing.

    ``pauses``: the host stops between exercises, as a commissioning does; a run never stops.
    """
    told = []
    cycles = _late_cycles(frames, node, pauses)
    late, row = sum(cycles), _longest(cycles)
    if late > _SHARE_MAX * len(cycles):
        told.append(f"{late} of {len(cycles)} cycles were late on the bus")
    elif row >= _IN_A_ROW:
        told.append(f"{row} cycles in a row were late on the bus")
    silent_s = _standstill(frames, node)
    if silent_s > 0.0:
        told.append(f"the host said nothing for {1e3 * silent_s:.0f} ms between two SYNCs")
    operating_s = _silence_in_operation(frames, node)
    if operating_s > 0.0:
        told.append(f"the host said nothing for {1e3 * operating_s:.0f} ms while the drive was to operate")
    answer_s = _slowest_answer(frames, node)
    if answer_s > _ANSWER_S:
        told.append(f"an SDO answer took {1e3 * answer_s:.0f} ms")
    return "; ".join(told)


def _late_cycles(frames: Sequence[Frame], node: int, pauses: bool) -> list[bool]:
    """Of each cycle whether its SYNC came late or its reading came behind the deadline or not at all."""
    syncs = [number for number, frame in enumerate(frames) if frame.cob_id == SYNC]
    gaps = [frames[after].at_s - frames[before].at_s for before, after in pairwise(syncs)]
    if len(gaps) < _CYCLES_MIN:
        return []
    period = median(gaps)
    within = [frames[before:after] for before, after in pairwise(syncs)]
    answers = [_answer(each, node) for each in within]
    synchronous = sum(answer is not None for answer in answers) > len(answers) / 2
    late = []
    for gap, cycle, answer in zip(gaps, within, answers, strict=True):
        paused = gap >= _PAUSE * period and (pauses or any(_is_request(each, node) for each in cycle))
        overdue = gap > (1.0 + _LATE_BY) * period and not paused
        late.append(overdue or (synchronous and (answer is None or answer > _ANSWERED_WITHIN * period)))
    return late


def _longest(late: Sequence[bool]) -> int:
    """The most late ones in a row."""
    return max((len(list(row)) for is_late, row in groupby(late) if is_late), default=0)


def _answer(cycle: Sequence[Frame], node: int) -> float | None:
    """The time from a SYNC, the first frame of a cycle, to the node's first TPDO, s; None without one."""
    told = (each.at_s for each in cycle if each.cob_id >> 7 in _TPDOS and each.cob_id & 0x7F == node)
    first = next(told, None)
    return None if first is None else first - cycle[0].at_s


def _is_request(frame: Frame, node: int) -> bool:
    return frame.cob_id in (NMT, 0x600 + node)


def _standstill(frames: Sequence[Frame], node: int) -> float:
    """The longest time between two SYNCs in which the host asked and commanded nothing, s; 0 if short."""
    silences, before = list[float](), None
    for frame in frames:
        if frame.cob_id == SYNC:
            silences += [] if before is None else [frame.at_s - before]
            before = frame.at_s
        elif _is_request(frame, node):
            before = None
    if len(silences) < _CYCLES_MIN or max(silences) < _STANDSTILL * median(silences):
        return 0.0
    return max(silences)


def _silence_in_operation(frames: Sequence[Frame], node: int) -> float:
    """The longest time without a frame of the host while the drive was to operate, s; 0 if short.

    A controlword comes by SDO, or first in RPDO1. A silence that the drive complains of by EMCY is left out:
    a commissioning tries the drive's watch over the host.
    """
    syncs = [frame.at_s for frame in frames if frame.cob_id == SYNC]
    if len(syncs) <= _CYCLES_MIN:
        return 0.0
    period = median(after - before for before, after in pairwise(syncs))
    operates, complained, before, longest = False, False, 0.0, 0.0
    for frame in frames:
        if frame.cob_id == SYNC or _is_request(frame, node) or frame.cob_id == 0x200 + node:
            longest = max(longest, frame.at_s - before if operates and not complained else 0.0)
            before, complained = frame.at_s, False
        complained = complained or frame.cob_id == EMCY + node
        if frame.cob_id == 0x200 + node and frame.data:
            operates = frame.data[0] & _OPERATION == _OPERATION
        elif (
            frame.cob_id == 0x600 + node and frame.data[1:4] == _CONTROLWORD and frame.data[0] & 0xE0 == 0x20
        ):
            operates = frame.data[4] & _OPERATION == _OPERATION
    return longest if longest >= _SILENCE * period else 0.0


def _slowest_answer(frames: Sequence[Frame], node: int) -> float:
    slowest, asked_at = 0.0, None
    for frame in frames:
        if frame.cob_id == 0x600 + node:
            asked_at = frame.at_s if asked_at is None else asked_at
        elif frame.cob_id == 0x580 + node and asked_at is not None:
            slowest, asked_at = max(slowest, frame.at_s - asked_at), None
    return slowest
