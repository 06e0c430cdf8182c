"""When the next cycle is due, and what becomes of ticks for which the host came too late.

    grid      0     1     2     3     4     5
    cycles    |--|   |--|  |-------------|  |--|
    SYNC      0      1     2                5         ticks 3 and 4 were missed: skipped, the grid kept

A cycle that wakes late by no more than half a period runs at once. Later than that its SYNC would come
closer than half a period to the next one, and tell the drive a false time: the tick is missed. Nothing is
made up for.
"""

from drivers.timebase import Duration, Instant


def ticks_missed(due_at: Instant, period: Duration, now: Instant) -> int:
    """How many ticks, from the one at ``due_at`` on, are more than half a period over at ``now``."""
    late = now - due_at - period // 2
    return -(-late // period) if late > 0 else 0


def ticks_passed(due_at: Instant, period: Duration, handed_at: Instant) -> int:
    """How many ticks, from the one at ``due_at`` on, have whole periods behind them at ``handed_at``."""
    return max(0, handed_at - due_at) // period
