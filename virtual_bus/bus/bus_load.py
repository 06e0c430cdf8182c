"""Bus load over any past interval, from a bounded number of checkpoints.

Busy is every bit from a start of frame to the end of the intermission after it, so that a
bus on which frames follow each other without pause has a load of 100 %.
"""

from bisect import bisect_left
from typing import Final

from drivers.timebase import Duration, Instant

CHECKPOINTS_MAX: Final = 4_096
"""Ends of frames, 32 kB: a second of a full bus at 500 kbit/s is in them frame by frame."""


class BusLoad:
    """Cumulated busy time, remembered at the end of every ``stride``-th frame.

    When the checkpoints are full every second one is dropped and the stride doubles: an
    interval's busy time is exact for the first ``CHECKPOINTS_MAX`` frames and later good to
    the frames between two checkpoints, at worst one in 2048 of the whole run.
    """

    __slots__ = ("_busy", "_countdown", "_ends", "_stride", "busy_ns")

    def __init__(self) -> None:
        self.busy_ns = Duration(0)
        self._ends: list[int] = []
        self._busy: list[int] = []
        self._stride = 1
        self._countdown = 1

    def add(self, duration: int, end: Instant) -> None:
        """The bus was busy for ``duration`` ns up to ``end``; ends never decrease."""
        self.busy_ns += duration  # type: ignore[assignment]
        self._countdown -= 1
        if not self._countdown:
            self._mark(end)

    def _mark(self, end: Instant) -> None:
        self._ends.append(end)
        self._busy.append(self.busy_ns)
        if len(self._ends) >= CHECKPOINTS_MAX:
            del self._ends[::2], self._busy[::2]
            self._stride *= 2
        self._countdown = self._stride

    def busy_until(self, when: Instant) -> int:
        """Cumulated busy time at ``when``, ns; a busy spell lies at the end of its interval."""
        ends, busy = self._ends, self._busy
        index = bisect_left(ends, when)
        if index == len(ends):
            return self.busy_ns
        before = busy[index - 1] if index else 0
        return max(before, busy[index] - (ends[index] - when))

    def percent(self, since: Instant, until: Instant) -> float:
        """Load between two instants, percent; 0 for an empty interval."""
        if until <= since:
            return 0.0
        return 100.0 * (self.busy_until(until) - self.busy_until(since)) / (until - since)
