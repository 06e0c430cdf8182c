"""When the next cycle is due, and what happens to ticks that were missed.

    grid      0     1     2     3     4     5
    cycles    |--|  |--|  |-----------|     |--|
    due       0     1     2           4     5         tick 3 was missed: skipped, counted, the grid kept

A cycle that wakes late by less than a period runs at once; ticks that passed
altogether are skipped rather than made up for, since a burst of SYNCs would tell
the drive a false time.
"""

from drivers.timebase import Duration, Instant


def next_tick(due_at: Instant, period: Duration, now: Instant) -> tuple[Instant, int]:
    """The first tick of the grid after ``due_at`` that is not over by ``now``, and how many were skipped."""
    following = due_at + period
    if now < following + period:
        return Instant(following), 0
    missed = (now - following) // period
    return Instant(following + missed * period), missed
