"""Simulated time: the heap of events (core/timeline.c), the clock that reads it, and its run at the pace of a
real clock.

Nothing happens between two events, so time jumps from one to the next. Events that fall
on the same instant run in the order in which they were entered; a run therefore depends
on nothing but its input.
"""

from collections.abc import Callable, Sized
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, Clock, Duration, Instant
from servobench.virtual_bus.core.native import Event as Event
from servobench.virtual_bus.core.native import SimulatedClock as SimulatedClock
from servobench.virtual_bus.core.native import Timeline as Timeline

Callback = Callable[[Instant], object]

CATCH_UP_MAX: Final = Duration(50 * NS_PER_MS)
"""A longer lag, of a machine that stood still, is not made up: the run would follow at full speed."""


class PacedTimeline(Timeline):
    """For watching: events wait until ``clock`` has come as far; the timeline's own instants stay simulated.

    So a run gives the same records as at full speed, only later. A lag of up to
    :data:`CATCH_UP_MAX` is made good, as a late wake-up leaves one; a longer one is
    not, since it would be followed by a run at full speed.
    """

    __slots__ = ("_clock", "_origin")

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._origin = clock.now()

    def step(self) -> bool:
        due = self.next_at()
        if due is not None:
            self._wait(due)
        return super().step()

    def run_until(self, when: Instant) -> None:
        while (due := self.next_at()) is not None and due <= when:
            self.step()
        self._wait(when)
        super().run_until(when)

    def run_until_filled(self, when: Instant, inbox: Sized) -> bool:
        while not inbox:
            due = self.next_at()
            if due is None or due > when:
                self._wait(when)
                return super().run_until_filled(when, inbox)
            self.step()
        return True

    def _wait(self, when: Instant) -> None:
        lag = self._clock.now() - self._origin - when
        if lag > CATCH_UP_MAX:
            self._origin = Instant(self._origin + lag)
        elif lag < 0:
            self._clock.sleep_until(Instant(self._origin + when))
