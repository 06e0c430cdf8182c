"""What a controller is asked for after its drive did not follow: the way from where the shaft is to the
reference, so that nothing jumps and nothing is made up for faster than the run goes anyway.

    away        the reference is the shaft itself: its speed, or its position, going on at its speed
    speeds      from s, at which the drive came back, to the reference r in a time T, and never beyond both:
                s + (r - s) t / T
    positions   a path of limited speed and acceleration; what was missed is caught up with by at most
                CATCH_UP of the highest speed that was asked for
"""

import math
from typing import Final

from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.loop.protocol import Context
from servobench.hil.loop.safety import PositionPath
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.scenario import Quantity, ReferenceProfile

WAY_S: Final = 0.2
"""T, and what a path takes to its full speed. A loop that crosses over at 15 rad/s or more sees a ramp of at
least three of its time constants, and hardly overshoots at its end."""
WAY_PERIODS: Final = 200
"""T at the least: loops cross over at a hundredth of their sampling rate or more."""
CATCH_UP: Final = 0.02
"""Of the speed. A position loop over csv overshoots such a path by 2.2 %: an overspeed stays below 5 %, with
room for a softer loop."""
JERK: Final = 1.25
"""Of the reference's speed: one reading may show so much of a drive that takes positions as they arrive. A
shaft that is faster as the drive leaves is on its way after a step."""
SLOWEST: Final = 0.05
"""Of the highest speed that set-points may have: a path goes as fast, however slow the reference is."""
ACCELERATION: Final = 0.25
"""Of the greatest that set-points may have. They are asked for up to two periods ahead, and a corner of the
path changes them by three times its acceleration there: they shall pass the limit as they are."""
_CORNER: Final = 0.1
"""Of the highest speed: a greater change of the rate within a cycle is a corner, and no acceleration."""


class WayBack(ReferenceProfile):
    """In place of ``reference`` while :attr:`active`. Speeds and positions; a torque is what it is."""

    def __init__(
        self,
        reference: ReferenceProfile,
        period: Duration,
        rate_max_rad_s: float,
        acceleration_max_rad_s2: float | None,
    ) -> None:
        """``rate_max_rad_s``, ``acceleration_max_rad_s2``: of positions; None: without a limit."""
        super().__init__((), reference.quantity)
        self.active = False
        self._reference = reference
        self._period_s = period / NS_PER_S
        self._way_s = max(WAY_S, WAY_PERIODS * self._period_s)
        self._slowest = SLOWEST * rate_max_rad_s
        acceleration = math.inf if acceleration_max_rad_s2 is None else acceleration_max_rad_s2
        self._acceleration_max = ACCELERATION * acceleration
        self._path = PositionPath(rate_max_rad_s, None, self._period_s)
        self._positions = reference.quantity is Quantity.POSITION
        self._follows = False
        self._at_s = 0.0
        """The time of the last cycle; of speeds, on the way, of the first one that is followed."""
        self._level = self._rate = 0.0
        """Then: a position and its speed, or the speed at which the drive came back."""
        self._rate_asked = self._rate_last = self._swing = 0.0

    def lead(self, context: Context, time_s: float) -> None:
        """A cycle begins, at ``time_s``, in which the drive does not follow, or which is on the way back."""
        if context.follows:
            self._go(time_s)
        elif context.newest is not None and self.quantity is not Quantity.TORQUE:
            self._stay(time_s, context.due_at, context.newest)
        context.ask(self if self.active else self._reference)
        if self.active and self._positions:
            context.reference_rad, context.reference_rad_s = self._level, self._rate
        elif self.active:
            context.reference_rad_s = self.value(time_s)

    def _stay(self, time_s: float, now: int, newest: Sample) -> None:
        speed = newest.reading.velocity_rad_s
        self._at_s, self._level, self._rate = time_s, speed, 0.0
        if self._positions:
            if not self.active:
                self._rate_last, self._swing = self._reference.rate(time_s), 0.0
                self._rate_asked = abs(speed) if abs(speed) > JERK * abs(self._rate_last) else 0.0
            self._note_rate(time_s)
            turned_rad = speed * (now - newest.sampled_at) / NS_PER_S
            self._level, self._rate = newest.reading.position_rad + turned_rad, speed
            self._path.start_from(self._level, speed)
        self.active, self._follows = True, False

    def _go(self, time_s: float) -> None:
        if not self._positions:
            if not self._follows:
                self._follows, self._at_s = True, time_s
            self.active = time_s < self._at_s + self._way_s
            return
        self._note_rate(time_s)
        fastest = (1.0 + CATCH_UP) * max(self._rate_asked, self._slowest)
        change = max(fastest, abs(self._rate)) / self._way_s
        self._path.limit(fastest, min(max(change, self._swing), self._acceleration_max))
        asked = self._reference.value(time_s)
        level = self._path.towards(asked)
        self._rate = (level - self._level) / (time_s - self._at_s)
        self._at_s, self._level = time_s, level
        self.active = level != asked

    def value(self, time_s: float) -> float:
        after_s = time_s - self._at_s
        if self._positions or not self._follows:
            return self._level + self._rate * after_s
        return self._level + self._share(after_s) * (self._reference.value(time_s) - self._level)

    def rate(self, time_s: float) -> float:
        if self._positions or not self._follows:
            return self._rate
        share, gap = self._share(time_s - self._at_s), self._reference.value(time_s) - self._level
        return share * self._reference.rate(time_s) + (gap / self._way_s if 0.0 < share < 1.0 else 0.0)

    def _share(self, after_s: float) -> float:
        """Of the reference, in a speed that is asked for so long after the drive came back."""
        return min(max(after_s / self._way_s, 0.0), 1.0)

    def _note_rate(self, time_s: float) -> None:
        """The highest speed since the drive left, and how fast it changes."""
        rate = self._reference.rate(time_s)
        self._rate_asked = max(self._rate_asked, abs(rate))
        change = abs(rate - self._rate_last)
        self._rate_last = rate
        if change < _CORNER * self._rate_asked:
            self._swing = max(self._swing, change / self._period_s)
