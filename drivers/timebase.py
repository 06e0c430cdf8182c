"""Time on the whole bench: integer nanoseconds on one monotonic axis.

This is the one file that may import ``time``. Everything else is handed a
:class:`Clock` or an :data:`Instant`, so that the same code runs on a real bus
and in simulated time.
"""

import time
from typing import Final, NewType, Protocol

Instant = NewType("Instant", int)
"""A point on a clock's axis, ns since that clock's origin."""

Duration = NewType("Duration", int)
"""A difference of two instants, ns."""

NS_PER_US: Final = 1_000
NS_PER_MS: Final = 1_000_000
NS_PER_S: Final = 1_000_000_000
US_PER_S: Final = 1_000_000.0
NS_PER_100_US: Final = 100_000
"""The unit of CANopen's inhibit times (CiA 301, 7.5.2.18 and 7.5.2.37)."""
NEVER: Final = Instant((1 << 62) - 1)
"""146 years: later than every instant, and by half the range of 64 bits, so that sums do not overflow.
One more would be an object for each comparison: compiled code holds 63 bits without one."""


class Clock(Protocol):
    """The loop's view of time. Only ``sleep_until`` and ``bus.recv`` let time pass."""

    def now(self) -> Instant:
        """Return the present instant, ns."""
        ...

    def sleep_until(self, when: Instant) -> None:
        """Return at ``when`` or later; at once if it has passed."""
        ...


_monotonic_ns: Final = time.monotonic_ns
"""Compiled, a constant of a module is found without a look-up."""


class MonotonicClock:
    """CLOCK_MONOTONIC, shared by all processes of one machine."""

    def now(self) -> Instant:
        return Instant(_monotonic_ns())

    def sleep_until(self, when: Instant) -> None:
        remaining_ns = when - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns / NS_PER_S)


def instant_after(start: Instant, elapsed_s: float) -> Instant:
    """Return the instant ``elapsed_s`` seconds after ``start``, rounded to the nearest ns."""
    return Instant(start + round(elapsed_s * NS_PER_S))


def duration_s(seconds: float) -> Duration:
    """Convert seconds to the nearest ns."""
    return Duration(round(seconds * NS_PER_S))


def suspended() -> Duration:
    """Return how long this machine has been suspended since it booted: boot time goes on meanwhile, monotonic
    time does not. An interruption between the two readings counts as well."""
    monotonic = time.monotonic_ns()
    return Duration(time.clock_gettime_ns(time.CLOCK_BOOTTIME) - monotonic)


def wall_between() -> tuple[Instant, int, Instant]:
    """Read the wall clock, ns, between two readings of the monotonic clock; their distance bounds the
    error."""
    before = time.monotonic_ns()
    wall = time.time_ns()
    return Instant(before), wall, Instant(time.monotonic_ns())


def wall_clock_offset() -> Duration:
    """Return wall clock minus monotonic clock, ns: the tightest of several bracketed readings.

    Kernel receive stamps (SO_TIMESTAMPNS) are wall clock; this maps them to the
    bench's axis at the edge.
    """
    best_width, best_offset = None, 0
    for _ in range(8):
        before, wall, after = wall_between()
        width = after - before
        if best_width is None or width < best_width:
            best_width, best_offset = width, wall - (before + after) // 2
    return Duration(best_offset)


def utc_stamp() -> str:
    """Return the wall clock as ``YYYYmmddTHHMMSSZ``: it names run folders and never enters a record."""
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
