"""Why rows are in doubt: what befell each of them, or the readings just before it, as the taps saw it.

Of several causes the first in :data:`CAUSES` counts. The bench tells none of them.
"""

from bisect import bisect_left
from collections import Counter
from statistics import median
from typing import Any, Final

import numpy as np

from tests.truth.judge import Timing
from tests.truth.rows import LOST, MISSED, NO_INSTANT, Told, each_row
from tests.truth.truth import AxisTruth

NEAR: Final = 64
"""SYNCs before a row whose readings may have put it in doubt: a row waits for as many."""
OUTLYING: Final = 8
"""One of so many delays may be an outlier, to either side half of them."""
CAUSES: Final = (
    "its SYNC was not seen on the bus",
    "SYNCs closer than half a period",
    "lost, or on its way at the end",
    "the clock was set",
    "delays spread over a period",
    "delays spread over half a period",
    "delays spread over a quarter of one",
    "the delay changed",
    "it was held up or overtaken",
    "one before was held up",
    "one before came twice",
    "one before is missing",
    "it is missing",
    "another cause",
)


def doubts(told: Told, truth: AxisTruth, timing: Timing, undecidable: set[int]) -> Counter[tuple[str, bool]]:
    """The rows of one axis that are in doubt, by cause and whether nobody could decide them."""
    found: Counter[tuple[str, bool]] = Counter()
    if told.size:
        look = _Look(truth, timing, int(told["sequence"][-1]))
        for row in each_row(told[told["certain"] == 0]):
            found[look.cause(row), int(row["sync_handed_at"]) in undecidable] += 1
    return found


class _Look:
    def __init__(self, truth: AxisTruth, timing: Timing, last: int) -> None:
        self._truth, self._timing, self._last = truth, timing, last
        self._ends = [sync.on_bus_at for sync in truth.syncs]
        self._delays = [
            None if sync.reading is None or end is None else sync.reading.received_at - end
            for sync, end in zip(truth.syncs, self._ends, strict=True)
        ]
        came = Counter(place for heard in truth.answered_at.values() for place, _ in heard)
        self._twice = sorted(place for place, count in came.items() if count > 1)

    def cause(self, row: Any) -> str:
        """The first that applies to a row."""
        place = self._truth.place_of.get(int(row["sync_handed_at"]))
        if place is None or row["fate"] == MISSED or row["sync_on_bus_at"] == NO_INSTANT:
            return CAUSES[0]
        end, half = self._ends[place], self._timing.period // 2
        if end is None:
            return CAUSES[0]
        beside = self._ends[max(0, place - 1) : place + 2]
        ends = [other for other in beside if other is not None]
        if any(0 < abs(other - end) < half for other in ends):
            return CAUSES[1]
        if row["fate"] == LOST and row["sequence"] > self._last - self._timing.horizon:
            return CAUSES[2]
        if any(end - NEAR * self._timing.period <= at <= end for at in self._truth.steps_at):
            return CAUSES[3]
        return self._cause_of_delays(place)

    def _cause_of_delays(self, place: int) -> str:
        period = self._timing.period
        first = max(0, place - NEAR)
        before = [delay for delay in self._delays[first:place] if delay is not None]
        behind = [delay for delay in self._delays[place : place + NEAR] if delay is not None]
        if not before or not behind:
            return CAUSES[-1]
        low, high = np.percentile(before, [50 / OUTLYING, 100 - 50 / OUTLYING])
        own, usual = self._delays[place], median(before)
        came_twice = bisect_left(self._twice, place) > bisect_left(self._twice, first)
        applies = (
            high - low >= period,
            high - low >= period // 2,
            high - low >= period // 4,
            abs(median(behind) - usual) >= period // 4,
            own is not None and (own - high >= period // 4 or self._truth.syncs[place].overtaken),
            any(delay - high >= period // 4 for delay in before),
            came_twice,
            len(before) < place - first,
            own is None,
            True,
        )
        return CAUSES[4 + applies.index(True)]
