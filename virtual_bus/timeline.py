"""Simulated time: a heap of events, and the clock that reads it.

Nothing happens between two events, so time jumps from one to the next. Events that fall
on the same instant run in the order in which they were entered; a run therefore depends
on nothing but its input.
"""

from collections.abc import Callable, Sized
from heapq import heappop, heappush
from typing import Final

from drivers.timebase import Instant

Callback = Callable[[Instant], object]

_push: Final = heappush
_pop: Final = heappop
"""As constants of this module: found without a look-up where it is compiled."""


class Event:
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

    def __call__(self, now: Instant) -> None:
        """Run, as the timeline does at the event's instant."""
        callback, self._callback = self._callback, None
        if callback is not None:
            callback(now)


class Timeline:
    """An event heap with a present instant that never runs backwards."""

    __slots__ = ("_entered", "_heap", "now")

    def __init__(self) -> None:
        self.now = Instant(0)
        self._heap: list[tuple[Instant, int, Callback]] = []
        self._entered = 0

    def call_at(self, when: Instant, callback: Callback) -> Event:
        """Run ``callback(now)`` at ``when``; an instant that has passed means: at once, at ``now``."""
        event = Event(callback)
        self.post(when, event)
        return event

    def post(self, when: Instant, callback: Callback) -> None:
        """As ``call_at``, for what is never taken back: cheaper."""
        self._entered = entered = self._entered + 1
        _push(self._heap, (when if when > self.now else self.now, entered, callback))

    def next_at(self) -> Instant | None:
        """The instant of the next event; None if there is none left."""
        heap = self._heap
        while heap:
            when, _, callback = heap[0]
            if not isinstance(callback, Event) or callback.pending:
                return when
            _pop(heap)
        return None

    def step(self) -> bool:
        """Go to the next event and run it; False if there is none left."""
        if self.next_at() is None:
            return False
        when, _, callback = heappop(self._heap)
        self.now = when
        callback(when)
        return True

    def run_until(self, when: Instant) -> None:
        """Run every event up to and including ``when``, then stand at ``when``."""
        heap = self._heap
        while heap and heap[0][0] <= when:
            due, _, callback = _pop(heap)
            self.now = due
            callback(due)
        if when > self.now:
            self.now = when

    def run_until_filled(self, when: Instant, inbox: Sized) -> bool:
        """As ``run_until``, but stop after the event that puts something into ``inbox``.

        True if there is something in it. This is the inner loop of every simulated
        ``recv``: it lets no more time pass than the frame needed.
        """
        heap = self._heap
        while not inbox:
            if not heap or heap[0][0] > when:
                if when > self.now:
                    self.now = when
                return False
            due, _, callback = _pop(heap)
            self.now = due
            callback(due)
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
