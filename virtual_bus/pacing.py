"""Simulated time at the pace of a real clock, for watching a simulated run as it happens."""

from collections.abc import Sized

from drivers.timebase import Clock, Instant
from virtual_bus.timeline import Timeline


class PacedTimeline(Timeline):
    """A timeline whose events wait until ``clock`` has come as far; its own instants stay simulated.

    So a run gives the same records as at full speed, only later. Where the machine
    falls behind, it catches up without skipping anything.
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
        self._clock.sleep_until(Instant(self._origin + when))
