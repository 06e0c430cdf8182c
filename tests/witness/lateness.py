"""How late host and drive were, by the frames alone, whose stamps are those of the bus: it is never late."""

from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import Final

from tests.witness.frames import Frame

SYNC: Final = 0x080
NMT: Final = 0x000
_CYCLES_MIN: Final = 100
"""Fewer tell no period."""
_LATE_BY: Final = 0.75
"""Of a period: the SYNCs by which a loop learns a drive's clock before it begins are 1.5 periods apart."""
_PAUSE: Final = 4.5
"""Periods without SYNC from which on the host has paused: between exercises it asks a drive every five."""
_STANDSTILL: Final = 10.0
"""Periods between two SYNCs without a word of the host from which on it was kept from its work: where it
pauses for longer, to reckon, it asks or commands by SDO or NMT before the next SYNC."""
_SHARE_MAX: Final = 0.002
"""Of the cycles: a machine that has time for all is late in none or two of a thousand."""
_ANSWER_S: Final = 0.2
"""After which this product's master asks again by SDO."""
_TPDOS: Final = (3, 5, 7, 9)
"""Function codes of the predefined connection set (CiA 301 7.3.5)."""


def lateness(frames: Sequence[Frame], node: int) -> str:
    """What a machine without time has done to the traffic with a node, in words; empty if nothing."""
    told = []
    cycles, late = _late_cycles(frames, node)
    if late > _SHARE_MAX * cycles:
        told.append(f"{late} of {cycles} cycles were late on the bus")
    silent_s = _standstill(frames, node)
    if silent_s > 0.0:
        told.append(f"the host said nothing for {1e3 * silent_s:.0f} ms between two SYNCs")
    answer_s = _slowest_answer(frames, node)
    if answer_s > _ANSWER_S:
        told.append(f"an SDO answer took {1e3 * answer_s:.0f} ms")
    return "; ".join(told)


def _late_cycles(frames: Sequence[Frame], node: int) -> tuple[int, int]:
    """Cycles, and those whose SYNC came late or whose reading came behind the next SYNC."""
    syncs = [number for number, frame in enumerate(frames) if frame.cob_id == SYNC]
    gaps = [frames[after].at_s - frames[before].at_s for before, after in pairwise(syncs)]
    if len(gaps) < _CYCLES_MIN:
        return 0, 0
    period = median(gaps)
    answered = [
        any(frame.cob_id >> 7 in _TPDOS and frame.cob_id & 0x7F == node for frame in frames[before:after])
        for before, after in pairwise(syncs)
    ]
    synchronous = sum(answered) > len(answered) / 2
    late = sum(
        (1.0 + _LATE_BY) * period < gap < _PAUSE * period or (synchronous and not told)
        for gap, told in zip(gaps, answered, strict=True)
    )
    return len(gaps), late


def _standstill(frames: Sequence[Frame], node: int) -> float:
    """The longest time between two SYNCs in which the host asked and commanded nothing, s; 0 if short."""
    silences, before = list[float](), None
    for frame in frames:
        if frame.cob_id == SYNC:
            silences += [] if before is None else [frame.at_s - before]
            before = frame.at_s
        elif frame.cob_id in (NMT, 0x600 + node):
            before = None
    if len(silences) < _CYCLES_MIN or max(silences) < _STANDSTILL * median(silences):
        return 0.0
    return max(silences)


def _slowest_answer(frames: Sequence[Frame], node: int) -> float:
    slowest, asked_at = 0.0, None
    for frame in frames:
        if frame.cob_id == 0x600 + node:
            asked_at = frame.at_s if asked_at is None else asked_at
        elif frame.cob_id == 0x580 + node and asked_at is not None:
            slowest, asked_at = max(slowest, frame.at_s - asked_at), None
    return slowest
