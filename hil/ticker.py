"""When the next cycle is due, and what becomes of ticks for which the host came too late.

    grid      0     1     2     3     4     5
    cycles    |--|   |--|  |-------------|  |--|
    SYNC      0      1     2                5         ticks 3 and 4 were missed: skipped, the grid kept

A cycle that wakes late by no more than half a period runs at once. Later than that its SYNC would come
closer than half a period to the next one, and tell the drive a false time: the tick is missed. Nothing is
made up for.
"""

from typing import NamedTuple

from drivers.timebase import Duration, Instant


class Due(NamedTuple):
    """The tick to be served next."""

    at: Instant
    missed: int
    """Ticks of the grid skipped before it."""


def next_due(due_at: Instant, period: Duration, now: Instant) -> Due:
    """The first tick from ``due_at`` on that is no more than half a period over at ``now``."""
    late = now - due_at - period // 2
    if late <= 0:
        return Due(due_at, 0)
    missed = -(-late // period)
    return Due(Instant(due_at + missed * period), missed)
