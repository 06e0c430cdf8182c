"""Whether a drive's clock was set: the ways to place readings whose stamps, or delays, put the question.

The readings of a clock that runs on lie on one line, a SYNC each. Shifted by whole periods they do so again:

    SYNC ends      1       2       3       4       5
    as it runs             :d1     :d2     :d3             cost 0: nothing has happened
    set back                       :d1     :d2     :d3     cost of a step, and of a reading that was lost

Each way has the cost of what must have happened for it.
"""

from typing import Final, NamedTuple

from drivers.timebase import Duration, Instant
from hil.loop.clock_map import ClockMap
from hil.loop.syncs import SURPLUS, SyncLog, SyncMark

STEP_COST: Final = 3
"""That a clock was set,"""
DELAY_COST: Final = 3
"""that the smallest delay changed by more than half a period,"""
LOSS_COST_MAX: Final = 2
"""and that readings were lost just then, one each up to this: a step and a change of delay are as rare as one
another, while losses are common and come in bursts."""
DRIFT_WITHIN: Final = 2e-3
"""Rates up to 2000 ppm off the old one are looked for among suspects."""
DELAYS_WATCHED: Final = 256
"""Readings of which the smallest and the largest delay stand for the present network."""


class Suspect:
    """A reading that came while it is open whether the clock was set."""

    def __init__(self, device_ns: int, received_at: Instant, second: bool) -> None:
        self.device_ns = device_ns
        self.received_at = received_at
        self.second = second
        """Whether it lies on a SYNC that has another stamp already."""
        self.guess = SURPLUS
        """The cycle in which it was placed, uncertain."""


class Line(NamedTuple):
    """A way to place the last suspects."""

    cost: int
    delay_change: int
    """By how much the smallest delay would have changed, ns; it decides between equals, but not at once."""
    marks: tuple[SyncMark, ...]
    """The SYNC of each."""
    steps: bool
    """Whether the clock was set."""


class DelayWindow:
    """Smallest and largest delay of the last readings."""

    def __init__(self) -> None:
        self.low = self.high = self._low = self._high = -1
        self._count = self._seen = 0

    def add(self, delay: int) -> None:
        if self._count == 0:
            self._low = self._high = delay
        self._low, self._high = min(self._low, delay), max(self._high, delay)
        if self.low < 0 or delay < self.low:
            self.low = delay
        self.high = max(self.high, delay)
        self._count += 1
        self._seen = min(self._seen + 1, DELAYS_WATCHED)
        if self._count == DELAYS_WATCHED // 2:
            self.low, self.high, self._count = self._low, self._high, 0

    def spreads(self, over: int) -> bool:
        """Whether they spread over so much or more."""
        return self.high - self.low >= over

    def slack(self) -> int:
        """How far beyond what was seen the next delay of the same network may well lie.

        Of n values drawn evenly the smallest is an (n+1)-th of their spread above the least possible one on
        the average, and hardly ever four times that.
        """
        return 4 * (self.high - self.low) // max(self._seen, 1)


class ClockQuestion:
    """What is known while the question is open, and the ways out of it."""

    def __init__(
        self, syncs: SyncLog, clock: ClockMap, period: Duration, transit: Duration, match_ns: int
    ) -> None:
        """``transit``: shortest time of a reading's frame. ``match_ns``: how far a stamp may be off."""
        self.stamps: dict[int, int] = {}
        """Of each SYNC answered, by its number: the stamp."""
        self.delays = DelayWindow()
        self.revoked: list[tuple[SyncMark, int]] = []
        """Placements just before the question that it touches, and their stamps."""
        self.since = 0
        """Number of the newest SYNC answered when the question was put."""
        self.twice = 0
        """Readings that came twice since the last one that raised no question."""
        self._syncs = syncs
        self._clock = clock
        self._transit = transit
        self._match_ns = match_ns
        self._half = period // 2

    def lines(self, last: list[Suspect]) -> list[Line]:
        """Every way to place the last suspects on SYNCs, all of them on one line."""
        received_at = last[0].received_at
        placements = []
        for mark in self._syncs.marks:
            on_bus_at = mark.on_bus_at
            if on_bus_at is not None and on_bus_at <= received_at - self._transit + self._match_ns:
                line = self._line(last, mark)
                if line is not None:
                    placements.append(line)
        return placements

    def _line(self, last: list[Suspect], first: SyncMark) -> Line | None:
        """How they are placed if the first answers ``first``; None if they cannot be.

        Readings that seemed to come twice just before may have been the first after a step by whole periods.
        """
        origin_at = first.on_bus_at
        assert origin_at is not None
        origin_ns, rate = last[0].device_ns, 1.0 + self._clock.rate
        marks: list[SyncMark] = []
        used: set[int] = set()
        smallest = -1
        drifted = 0
        for suspect in last:
            at = Instant(origin_at + drifted + round((suspect.device_ns - origin_ns) * rate))
            mark = self._syncs.nearest(at)
            if mark is None or mark.on_bus_at is None or mark.number in used or mark.sequence == SURPLUS:
                return None
            miss = mark.on_bus_at - at
            delay = suspect.received_at - mark.on_bus_at
            if (
                abs(miss) > self._match_ns + DRIFT_WITHIN * self._half
                or delay < self._transit - self._match_ns
            ):
                return None
            if self.stamps.get(mark.number, suspect.device_ns) != suspect.device_ns:
                return None
            drifted += miss
            used.add(mark.number)
            marks.append(mark)
            smallest = delay if smallest < 0 else min(smallest, delay)
        unmoved_at = self._clock.place(origin_ns)
        steps = abs(unmoved_at - origin_at) > self._match_ns + self._clock.error_ns
        if steps and self.revoked:
            unmoved = self._syncs.nearest(unmoved_at)
            if unmoved is not None and not self._agrees(used, first.number - unmoved.number):
                return None
        lost = self._lost_before(min(used))
        if steps:
            cost = STEP_COST + min(max(0, lost - self.twice), LOSS_COST_MAX)
        else:
            cost = min(lost + self.twice, LOSS_COST_MAX)
        change = abs(smallest - self.delays.low)
        if change > self._half + self.delays.slack():
            # The smallest of many delays that spread is sooner believed than losses.
            cost += DELAY_COST + (LOSS_COST_MAX + 1 if self.delays.spreads(self._half) else 0)
        return Line(cost, change, tuple(marks), steps)

    def _agrees(self, used: set[int], moved: int) -> bool:
        """Whether the readings before the suspects can be placed as well, if the clock was set among them.

        Those since then lie ``moved`` SYNCs from where they were placed; no two may lie on one SYNC.
        """
        numbers = [mark.number for mark, _ in self.revoked]
        for split in range(len(numbers) + 1):
            placed = numbers[:split] + [number + moved for number in numbers[split:]]
            taken = used.union(placed)
            if len(taken) == len(used) + len(placed) and not taken.intersection(self.stamps):
                return True
        return False

    def _lost_before(self, number: int) -> int:
        """SYNCs of cycles after the last certainly answered one and before ``number``."""
        return sum(
            self.since < mark.number < number and mark.on_bus_at is not None for mark in self._syncs.marks
        )
