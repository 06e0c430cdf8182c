"""Simulated time: a heap of events, the clock that reads it, and its run at the pace of a real clock.

Nothing happens between two events, so time jumps from one to the next. Events that fall
on the same instant run in the order in which they were entered; a run therefore depends
on nothing but its input.
"""

from collections.abc import Callable, Sized
from typing import Final

from drivers.timebase import NS_PER_MS, Clock, Duration, Instant
from virtual_bus.event_heap import Action, HeapEntry, pop, push

Callback = Callable[[Instant], object]


class _Call(Action):
    """A callback as an action."""

    __slots__ = ("_callback",)

    def __init__(self, callback: Callback) -> None:
        self._callback = callback

    def happen(self, now: Instant) -> None:
        self._callback(now)


class Event(Action):
    """An entry of a timeline that can be taken back; it runs once or never."""

    __slots__ = ("_callback",)

    def __init__(self, callback: Callback) -> None:
        self._callback: Callback | None = callback

    def cancel(self) -> None:
        """Take the event back; no effect once it has run."""
        self._callback = None

    @property
    def pending(self) -> bool:
        """Whether the event is still to run."""
        return self._callback is not None

    @property
    def wanted(self) -> bool:
        return self._callback is not None

    def happen(self, now: Instant) -> None:
        callback, self._callback = self._callback, None
        if callback is not None:
            callback(now)


class Timeline:
    """An event heap with a present instant that never runs backwards."""

    __slots__ = ("_entered", "_heap", "now")

    def __init__(self) -> None:
        self.now = Instant(0)
        self._heap: list[HeapEntry] = []
        self._entered = 0

    def call_at(self, when: Instant, callback: Callback) -> Event:
        """Run ``callback(now)`` at ``when``; an instant that has passed means: at once, at ``now``."""
        event = Event(callback)
        self.enter(when, event)
        return event

    def post(self, when: Instant, callback: Callback) -> None:
        """As ``call_at``, for what is never taken back."""
        self.enter(when, _Call(callback))

    def enter(self, when: Instant, action: Action) -> None:
        """Let ``action`` happen at ``when``; it may be entered several times. The cheapest way."""
        self._entered = entered = self._entered + 1
        push(self._heap, HeapEntry(when if when > self.now else self.now, entered, action))

    def next_at(self) -> Instant | None:
        """The instant of the next event; None if there is none left."""
        heap = self._heap
        while heap:
            first = heap[0]
            if first.action.wanted:
                return first.when
            pop(heap)
        return None

    def step(self) -> bool:
        """Go to the next event and run it; False if there is none left."""
        if self.next_at() is None:
            return False
        entry = pop(self._heap)
        self.now = entry.when
        entry.action.happen(entry.when)
        return True

    def run_until(self, when: Instant) -> None:
        """Run every event up to and including ``when``, then stand at ``when``."""
        heap = self._heap
        while heap and heap[0].when <= when:
            entry = pop(heap)
            self.now = entry.when
            entry.action.happen(entry.when)
        if when > self.now:
            self.now = when

    def run_until_filled(self, when: Instant, inbox: Sized) -> bool:
        """As ``run_until``, but stop after the event that puts something into ``inbox``.

        True if there is something in it. This is the inner loop of every simulated
        ``recv``: it lets no more time pass than the frame needed.
        """
        heap = self._heap
        while not inbox:
            if not heap or heap[0].when > when:
                if when > self.now:
                    self.now = when
                return False
            entry = pop(heap)
            self.now = entry.when
            entry.action.happen(entry.when)
        return True


class SimulatedClock:
    """The bench's clock on a timeline: to sleep is to let the events happen."""

    __slots__ = ("timeline",)

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline

    def now(self) -> Instant:
        """The present instant of the timeline, ns."""
        return self.timeline.now

    def sleep_until(self, when: Instant) -> None:
        """Run the timeline up to ``when``; at once if it has passed."""
        self.timeline.run_until(when)


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
