"""Detects a host that stands still within a run: its process stopped, or the whole machine suspended.

The ticks of that time are missed, whichever it was. A suspended machine's own clock stands still too, so that
no tick looks late: only the drives notice that they were left alone.
"""

from collections.abc import Callable
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, suspended
from servobench.hil.execution.world import World
from servobench.hil.loop.loop import PROGRESS_EVERY

STOOD_STILL: Final = Duration(100 * NS_PER_MS)
"""Longer than any delay of a process on a machine fit for a bench; drives wait for their master's heartbeat
at least as long."""
JUST_BEFORE: Final = Duration(NS_PER_S)
"""An end so soon after a standstill is caused by it: drives report its effect at once."""


class Standstill:
    """Standstills of the host of one world, where time passes by itself."""

    def __init__(
        self,
        world: World,
        period: Duration,
        tell: Callable[[str, str], None],
        asleep: Callable[[], Duration] = suspended,
    ) -> None:
        """``period``: of the cycles, between which ``attend`` is called. ``tell``: takes text and level of an
        event. ``asleep``: returns how long the machine has been suspended so far."""
        self._clock, self._real_time, self._tell = world.clock, world.real_time, tell
        self._every = max(PROGRESS_EVERY, period)
        self._attended_at: Instant | None = None
        self._asleep = asleep
        self._suspended = asleep()
        self._told_at, self._told = Instant(0), ""

    def attend(self) -> None:
        """Report how long nothing ran since the last call; from the first one on."""
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
        """Say how to prevent a standstill, if one has just occurred; else empty."""
        self.attend()
        if not self._told or self._clock.now() - self._told_at > JUST_BEFORE:
            return ""
        cure = "prevent it from being suspended or stopped, and keep its processor free for the bench"
        return f"{self._told}: {cure}"
