"""A host that stands still within a run: its process stopped, or the whole machine suspended.

The ticks of that time are missed, whichever it was. A suspended machine's own clock stands still too, so that
no tick looks late: only the drives tell that they were left alone.
"""

from collections.abc import Callable
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, suspended
from servobench.hil.execution.world import World
from servobench.hil.loop.loop import PROGRESS_EVERY

STOOD_STILL: Final = Duration(100 * NS_PER_MS)
"""Longer than anything holds up a process on a machine that serves for a bench; drives wait for their
master's heartbeat at least so long."""
JUST_BEFORE: Final = Duration(NS_PER_S)
"""What ends a run so soon after a standstill, it has ended: drives tell at once what it did to them."""


class Standstill:
    """Of the host of one world, where time passes by itself."""

    def __init__(
        self,
        world: World,
        period: Duration,
        tell: Callable[[str, str], None],
        asleep: Callable[[], Duration] = suspended,
    ) -> None:
        """``period``: of the cycles, between which somebody attends. ``tell``: takes text and level of an
        event. ``asleep``: for how long the machine has been suspended so far."""
        self._clock, self._real_time, self._tell = world.clock, world.real_time, tell
        self._every = max(PROGRESS_EVERY, period)
        self._attended_at: Instant | None = None
        self._asleep = asleep
        self._suspended = asleep()
        self._told_at, self._told = Instant(0), ""

    def attend(self) -> None:
        """Tell for how long nobody could, since the last time; from the first one on."""
        if not self._real_time:
            return
        now, asleep = self._clock.now(), self._asleep()
        since = self._attended_at or Instant(now - self._every)
        still, slept = now - since - self._every, asleep - self._suspended
        self._attended_at, self._suspended = now, asleep
        if max(still, slept) > STOOD_STILL:
            self._told_at = now
            self._told = f"this host stood still for {still / NS_PER_S:.2f} s"
            if slept > STOOD_STILL:
                self._told = f"this machine was suspended for {slept / NS_PER_S:.2f} s"
            self._tell(f"{self._told}: nothing was sent meanwhile", "WARN")

    def cure(self) -> str:
        """What keeps it from standing still again, if it did so just before; else empty."""
        self.attend()
        if not self._told or self._clock.now() - self._told_at > JUST_BEFORE:
            return ""
        return f"{self._told}: keep it from being suspended or stopped, and its processor free for the bench"
