"""Which SYNC a reading answers, and when it was taken.

A drive with a clock stamps each sample. The map of its clock puts the stamp on the host's axis, and the SYNC
whose end on the bus lies there is the one it answers:

    SYNC ends      1          2          3          4
    stamps         :d1        :d2                   : d4            d3 was lost
    lateness       0          0                     +              d4: the SYNC came late to the drive

The bench sends no SYNC within half a period of another, so a stamp within a quarter of a period of a SYNC can
be that one's only. *Lateness* is the stamp's instant minus that of the SYNC on the bus. It is never negative
but for the errors of stamp and map; a positive one is what the SYNC took behind its echo, or, on a bus without
echoes, what it waited in front of the bus. The smallest lateness counts as none: a constant delay of the SYNC
behind its echo cannot be told from the offset of the clock.

A stamp off all SYNCs has another cause, that the drive's clock was set. While that is open, its readings are
marked uncertain. It is settled when :data:`AGREEING` of them in a row lie on one line at which each has a SYNC
of its own and came no sooner than a frame can; of the lines whole periods apart, it is the one at which the
smallest delay is what it was before.

A drive without a clock is placed by order alone (:class:`OrderAttribution`).
"""

from collections.abc import Callable
from typing import Final, Protocol

from drivers.exchange import Reading
from drivers.frame_port import EchoBasis
from drivers.timebase import NS_PER_US, Duration, Instant
from hil.clock_map import ClockMap
from hil.samples import Sample
from hil.syncs import SURPLUS, SyncLog, SyncMark

ECHO_ERROR: Final = {
    EchoBasis.BUS: 0,
    EchoBasis.HARDWARE: NS_PER_US,
    EchoBasis.KERNEL: 30 * NS_PER_US,
    EchoBasis.RECEIPT: 100 * NS_PER_US,
    EchoBasis.NONE: 30 * NS_PER_US,
}
"""How far the instant of an echo may lie from the end of its frame: none where it is computed, a tick of the
adapter's clock, the latency of an interrupt, that of a wake-up. Without echoes: the jitter of the hand-over."""
MATCH_NS: Final = 3 * NS_PER_US
"""A stamp so near to a SYNC is its own: two steps of the stamp's resolution and one of rounding."""
AGREEING: Final = 8
"""Stamps that must agree before a clock counts as set: fewer could be chance under a jittering SYNC."""
AGREEING_SPREAD: Final = 32
"""The same where delays spread over more than half a period, so that only the smallest of many is telling."""
SUSPECTS_KEPT: Final = 48
"""Within so many readings the question is decided, or put anew without the oldest."""
DRIFT_WITHIN: Final = 2e-3
"""Rates up to 2000 ppm off the old one are looked for among suspects."""
LATE_KEPT: Final = 0.97
"""Weight of the past in the mean lateness: it forgets within some thirty readings."""
DELAYS_WATCHED: Final = 256
"""Readings of which the smallest and the largest delay stand for the present network."""

Tell = Callable[[str], None]


class Health:
    """What was seen that a run must be judged by."""

    __slots__ = (
        "before_sync",
        "below_transit",
        "duplicates",
        "error_ns_max",
        "placed",
        "steps",
        "two_stamps",
        "uncertain",
        "unmatched",
    )

    def __init__(self) -> None:
        self.placed = 0
        """Readings placed."""
        self.uncertain = 0
        """Of those: which SYNC they answer is not decided by the data."""
        self.duplicates = 0
        """Readings that came twice."""
        self.unmatched = 0
        """Readings that answer no SYNC of this bench that is remembered."""
        self.steps = 0
        """Times that the drive's clock was found to be set."""
        self.below_transit = 0
        """Readings, placed for certain, that would have come sooner than their frame takes on the wire."""
        self.before_sync = 0
        """Readings, placed for certain, that would have come before their SYNC."""
        self.two_stamps = 0
        """SYNCs with two different stamps, in readings that were placed for certain."""
        self.error_ns_max = 0
        """Largest error bound of a reading placed for certain."""


class Attribution(Protocol):
    """Places readings of one axis."""

    health: Health

    def place(self, reading: Reading) -> Sample | None:
        """The reading as a sample; None for a duplicate, or one that answers no SYNC of a cycle."""
        ...


class _Suspect:
    """A reading whose stamp lies off all SYNCs."""

    __slots__ = ("device_ns", "received_at", "second")

    def __init__(self, device_ns: int, received_at: Instant, second: bool) -> None:
        self.device_ns = device_ns
        self.received_at = received_at
        self.second = second
        """Whether it lies on a SYNC that has another stamp already."""


class _DelayWindow:
    """Smallest and largest delay of the last readings."""

    __slots__ = ("_count", "_high", "_low", "high", "low")

    def __init__(self) -> None:
        self.low = self.high = self._low = self._high = -1
        self._count = 0

    def add(self, delay: int) -> None:
        if self._count == 0:
            self._low = self._high = delay
        self._low, self._high = min(self._low, delay), max(self._high, delay)
        if self.low < 0 or delay < self.low:
            self.low = delay
        self.high = max(self.high, delay)
        self._count += 1
        if self._count == DELAYS_WATCHED // 2:
            self.low, self.high, self._count = self._low, self._high, 0


class StampAttribution:
    """Places readings by their stamps."""

    def __init__(
        self,
        syncs: SyncLog,
        clock: ClockMap,
        period: Duration,
        transit: Duration,
        tell: Tell,
    ) -> None:
        """``transit``: the shortest time that a reading's frame takes on the wire. ``tell``: takes events."""
        self.health = Health()
        self.clock = clock
        self._syncs = syncs
        self._quarter = period // 4
        self._half = period // 2
        self._transit = transit
        self._tell = tell
        echo_error = ECHO_ERROR[syncs.echoes]
        self._match_ns = MATCH_NS + echo_error
        self._variance = float(echo_error) ** 2 / 9.0
        self._late_ns = 0.0
        self._unanchored = 0
        self._least_late = 0
        self._stamps: dict[int, int] = {}
        """Of each SYNC answered, by its number: the stamp."""
        self._suspects: list[_Suspect] = []
        self._delays = _DelayWindow()

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        device_ns, on_bus_at = reading.device_time_ns, mark.on_bus_at
        if device_ns is not None and on_bus_at is not None:
            self.clock.observe(device_ns, on_bus_at, self._variance)
            self._delays.add(reading.received_at - on_bus_at)

    def place(self, reading: Reading) -> Sample | None:
        device_ns = reading.device_time_ns
        if device_ns is None or not self.clock.ready:
            self.health.unmatched += 1
            return None
        at = self.clock.place(device_ns)
        mark = self._syncs.nearest(at)
        if mark is None:
            self.health.unmatched += 1
            return None
        on_bus_at = mark.on_bus_at
        assert on_bus_at is not None
        lateness = at - on_bus_at
        match_ns = self._match_ns + self.clock.error_ns
        late_max = min(int(4.0 * self._late_ns), self._quarter)
        if -match_ns <= lateness <= (match_ns if match_ns > late_max else late_max):
            known = self._stamps.get(mark.number)
            if known is None:
                return self._matched(reading, device_ns, mark, at, lateness, match_ns)
            if known == device_ns:
                self.health.duplicates += 1
                return None
            return self._suspect(reading, device_ns, at, lateness, True)
        return self._suspect(reading, device_ns, at, lateness, False)

    def _matched(
        self, reading: Reading, device_ns: int, mark: SyncMark, at: Instant, lateness: int, match_ns: int
    ) -> Sample | None:
        health = self.health
        on_bus_at = mark.on_bus_at
        assert on_bus_at is not None
        if self._suspects:
            self._acquit()
        self._stamps[mark.number] = device_ns
        if len(self._stamps) > 2 * len(self._syncs.marks) + 64:
            oldest = self._syncs.marks[0].number
            self._stamps = {number: stamp for number, stamp in self._stamps.items() if number >= oldest}
        sampled_at, error_ns = on_bus_at, match_ns
        if lateness > match_ns:
            # Late to the drive: the stamp knows better. Nothing but the SYNC itself excludes that it was not.
            sampled_at, error_ns = at, lateness + match_ns
        self._follow(device_ns, on_bus_at, lateness, match_ns)
        if mark.sequence == SURPLUS:
            health.unmatched += 1
            return None
        certain = mark.sure
        health.placed += 1
        if certain:
            self._judge(reading.received_at - sampled_at, error_ns)
        else:
            health.uncertain += 1
        self._delays.add(reading.received_at - sampled_at)
        return Sample(mark.sequence, reading, sampled_at, error_ns, certain)

    def _judge(self, delay: int, error_ns: int) -> None:
        """What cannot be is an alarm."""
        health = self.health
        if delay < self._transit - error_ns:
            health.below_transit += 1
            if delay < 0:
                health.before_sync += 1
        if error_ns > health.error_ns_max:
            health.error_ns_max = error_ns

    def _follow(self, device_ns: int, on_bus_at: Instant, lateness: int, match_ns: int) -> None:
        """Let the map follow a SYNC that was not late; anchor it anew if none was for long."""
        late = lateness if lateness > match_ns else 0
        self._late_ns = LATE_KEPT * self._late_ns + (1.0 - LATE_KEPT) * late
        if not late:
            self.clock.observe(device_ns, on_bus_at, self._variance)
            self._unanchored = 0
            return
        if self._unanchored == 0 or lateness < self._least_late:
            self._least_late = lateness
        self._unanchored += 1
        if self._unanchored >= DELAYS_WATCHED:
            self.clock.shift(-self._least_late)
            self._unanchored = 0

    # ---- clocks that were set -----------------------------------------------------------------------------

    def _acquit(self) -> None:
        """The clock is as it was: a second stamp for a SYNC has no explanation then."""
        for suspect in self._suspects:
            if suspect.second:
                self.health.two_stamps += 1
        self._suspects.clear()

    def _suspect(
        self, reading: Reading, device_ns: int, at: Instant, lateness: int, second: bool
    ) -> Sample | None:
        """A stamp off all SYNCs: the clock was set, or this SYNC came late to the drive."""
        suspects = self._suspects
        if any(known.device_ns == device_ns for known in suspects):
            self.health.duplicates += 1
            return None
        if lateness > 0:
            self._late_ns = LATE_KEPT * self._late_ns + (1.0 - LATE_KEPT) * min(lateness, self._quarter)
        suspects.append(_Suspect(device_ns, reading.received_at, second))
        if len(suspects) >= AGREEING and self._relearn():
            return self.place(reading)
        if len(suspects) > SUSPECTS_KEPT:
            del suspects[0]
        return self._guess(reading, at)

    def _guess(self, reading: Reading, at: Instant) -> Sample | None:
        """A reading's most likely place, marked uncertain; its interval holds every SYNC that is open."""
        received_at = reading.received_at
        latest = Instant(received_at - self._transit)
        mark = self._syncs.newest_before(min(at, latest) if at <= latest else latest)
        while mark is not None and (mark.number in self._stamps or mark.sequence == SURPLUS):
            mark = self._later_open(mark, latest)
        if mark is None:
            mark = self._syncs.newest_before(latest)
        if mark is None or mark.on_bus_at is None or mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        self.health.placed += 1
        self.health.uncertain += 1
        sampled_at = mark.on_bus_at
        first = self._syncs.marks[0].on_bus_at
        earliest = next(
            (
                open_mark.on_bus_at
                for open_mark in self._syncs.marks
                if open_mark.on_bus_at is not None and open_mark.number not in self._stamps
            ),
            first if first is not None else sampled_at,
        )
        error_ns = max(received_at - sampled_at, sampled_at - earliest)
        return Sample(mark.sequence, reading, sampled_at, error_ns, False)

    def _later_open(self, after: SyncMark, latest: Instant) -> SyncMark | None:
        """The next SYNC that nothing answered yet."""
        for mark in self._syncs.marks:
            on_bus_at = mark.on_bus_at
            if mark.number > after.number and on_bus_at is not None and on_bus_at <= latest:
                return mark
        return None

    def _relearn(self) -> bool:
        """Find the line on which the suspects lie; whether one was found, and is followed from now on."""
        spread = self._delays.high - self._delays.low
        if len(self._suspects) < (AGREEING if spread < self._half else AGREEING_SPREAD):
            return False
        best: list[SyncMark] = []
        least = self._half
        received_at = self._suspects[0].received_at
        # A network that also grew slower by more than half a period at that very instant is not looked for.
        earliest = received_at - self._delays.high - self._half
        for mark in self._syncs.marks:
            on_bus_at = mark.on_bus_at
            if on_bus_at is None or not earliest <= on_bus_at <= received_at - self._transit + self._match_ns:
                continue
            fit = self._fit(mark)
            if fit is None:
                continue
            marks, smallest = fit
            miss = abs(smallest - self._delays.low)
            if miss < least:
                best, least = marks, miss
        if not best:
            return False
        old_ns = self.clock.place(self._suspects[0].device_ns)
        pairs = []
        for suspect, mark in zip(self._suspects, best, strict=True):
            assert mark.on_bus_at is not None
            pairs.append((suspect.device_ns, mark.on_bus_at))
        step_us = (old_ns - pairs[0][1]) / NS_PER_US
        uncertain = len(pairs)
        self.clock.start_anew(sorted(pairs), self._variance)
        # The last suspect is being placed now, by the new line.
        for (device_ns, _), mark in zip(pairs[:-1], best[:-1], strict=True):
            self._stamps[mark.number] = device_ns
        self._suspects.clear()
        self._late_ns = 0.0
        self.health.steps += 1
        self._tell(
            f"its clock was set by {step_us:+.0f} us; {uncertain} readings in between are marked uncertain"
        )
        return True

    def _fit(self, first: SyncMark) -> tuple[list[SyncMark], int] | None:
        """The SYNCs of all suspects if the first one answers ``first``, and the smallest delay then."""
        suspects = self._suspects
        origin_at = first.on_bus_at
        if origin_at is None or first.sequence == SURPLUS:
            return None
        origin = suspects[0]
        marks: list[SyncMark] = []
        used: set[int] = set()
        smallest = -1
        offset = 0.0
        rate = 1.0 + self.clock.rate
        for suspect in suspects:
            passed = suspect.device_ns - origin.device_ns
            at = Instant(origin_at + round(passed * rate + offset))
            mark = self._syncs.nearest(at)
            if mark is None or mark.on_bus_at is None or mark.number in used:
                return None
            miss = mark.on_bus_at - at
            delay = suspect.received_at - mark.on_bus_at
            if abs(miss) > self._match_ns + DRIFT_WITHIN * self._half or delay < self._transit - self._match_ns:
                return None
            offset += miss
            used.add(mark.number)
            marks.append(mark)
            smallest = delay if smallest < 0 else min(smallest, delay)
        return marks, smallest


# ---- drives without a clock -----------------------------------------------------------------------------

PROBE_AGAIN_AFTER: Final = 100
"""SYNCs from a probe that failed until the next one."""


class OrderAttribution:
    """Places readings by the order in which SYNCs and readings passed the bus.

        SYNC ends      1       2       3          4                 5
        readings         |r      |r                 |r       |?
        placed           1       2                  4        not in order: 4 was answered already

    A reading answers the SYNC before it, as long as the drive answers before the next one. That cannot be
    seen from readings that come regularly: one period more of delay, which begins with a gap, looks like one
    lost reading. So after a gap readings are uncertain until a *probe*: one SYNC goes out a quarter of a period
    late. A drive that answers in time answers that one as late as itself; a delayed stream does not move.
    """

    def __init__(self, syncs: SyncLog, period: Duration, transit: Duration, tell: Tell) -> None:
        self.health = Health()
        self.wants_probe = False
        """Whether the next SYNC is to go out a quarter of a period late."""
        self._syncs = syncs
        self._period = period
        self._transit = transit
        self._tell = tell
        self._error_ns = ECHO_ERROR[syncs.echoes]
        self._answered = 0
        """Number of the last SYNC that has its reading."""
        self._probe = 0
        """Number of the SYNC that went out late; 0: none is out."""
        self._sure = True
        self._beyond = False
        self._usual_ns = 0.0
        self._next_probe = 0

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        if mark.on_bus_at is not None:
            self._usual_ns = float(reading.received_at - mark.on_bus_at)
            self._answered = mark.number

    def probed(self, mark: SyncMark) -> None:
        """The SYNC of ``mark`` has gone out late."""
        self._probe = mark.number
        self.wants_probe = False

    def place(self, reading: Reading) -> Sample | None:
        received_at = reading.received_at
        mark = self._syncs.newest_before(received_at)
        if mark is None or mark.on_bus_at is None or mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        age = received_at - mark.on_bus_at
        if mark.number <= self._answered:
            # The second answer to a SYNC: this one, or the one before, was late by a period or more.
            self._doubt(mark)
            self.health.unmatched += 1
            return None
        if mark.number > self._answered + 1:
            self._doubt(mark)
        self._answered = mark.number
        if mark.number == self._probe:
            self._conclude(age)
        elif mark.number > self._probe > 0:
            self._probe = 0
            self.wants_probe = True
        certain = self._sure and mark.sure
        self._usual_ns += (age - self._usual_ns) / 4.0
        health = self.health
        health.placed += 1
        error_ns = self._error_ns
        if not certain:
            health.uncertain += 1
            error_ns += received_at - self._oldest_at(mark)
        elif age < self._transit - error_ns:
            health.below_transit += 1
        health.error_ns_max = max(health.error_ns_max, error_ns)
        return Sample(mark.sequence, reading, mark.on_bus_at, error_ns, certain)

    def _oldest_at(self, mark: SyncMark) -> Instant:
        first = self._syncs.marks[0].on_bus_at
        return first if first is not None else mark.handed_at

    def _doubt(self, mark: SyncMark) -> None:
        self._sure = False
        if not self._probe and mark.number >= self._next_probe:
            self.wants_probe = True

    def _conclude(self, age: int) -> None:
        """The SYNC that went out late was answered after ``age``; usual is what the readings before had."""
        number, self._probe = self._probe, 0
        if abs(age - self._usual_ns) < self._period / 8.0:
            if self._beyond:
                self._beyond = False
                self._tell("its readings answer the SYNC before them again")
            self._sure = True
            return
        self._next_probe = number + PROBE_AGAIN_AFTER
        if not self._beyond:
            self._beyond = True
            self._tell(
                "its readings come later than the next SYNC; without a stamp of the drive's clock beside the"
                " speed it cannot be told which SYNC they answer: they are marked uncertain"
            )
