"""Which SYNC a reading answers, and when it was taken.

A drive with a clock stamps each sample. The map of its clock puts the stamp on the host's axis, and the SYNC
whose end on the bus lies there is the one it answers:

    SYNC ends      1          2          3          4
    stamps         :d1        :d2                   : d4            d3 was lost
    lateness       0          0                     +              d4: the SYNC came late to the drive

The bench sends no SYNC within half a period of another; so a stamp within a quarter of a period of one can be
that one's only. *Lateness* is the stamp's instant minus that of the SYNC on the bus. It is never negative but
for the errors of stamp and map; a positive one is what the SYNC took behind its echo, or, on a bus without
echoes, what it waited in front of the bus. The smallest lateness counts as none: a constant delay of the SYNC
behind its echo cannot be told from the offset of the clock.

Where a stamp lies off all SYNCs, or on one that has another stamp, or where the delay leaves what it was by
more than half a period, the drive's clock may have been set. While that is open, readings are marked
uncertain. It is settled when :data:`AGREEING` of them lie on one line on which each has a SYNC of its own and
came no sooner than a frame can. Of several such lines, whole periods apart, the one is taken that needs least
to have happened: no step rather than a step, the same smallest delay rather than another, and no losses.

A drive without a clock is placed by order alone (:class:`OrderAttribution`).
"""

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from drivers.exchange import Reading
from drivers.frame_port import EchoBasis
from drivers.timebase import NS_PER_US, Duration, Instant
from hil.clock_map import ClockMap
from hil.samples import Observation, Sample, new_sample
from hil.syncs import REMEMBERED, SURPLUS, SyncLog, SyncMark

ECHO_ERROR: Final = {
    EchoBasis.BUS: 0,
    EchoBasis.HARDWARE: NS_PER_US,
    EchoBasis.KERNEL: 30 * NS_PER_US,
    EchoBasis.RECEIPT: 100 * NS_PER_US,
    EchoBasis.NONE: 30 * NS_PER_US,
}
"""How far the instant of an echo may lie from the end of its frame: none where it is computed, a tick of the
adapter's clock, the latency of an interrupt, that of a wake-up. Without echoes: jitter of the hand-over."""
MATCH_NS: Final = 3 * NS_PER_US
"""A stamp so near to a SYNC is its own: two steps of the stamp's resolution and one of rounding."""
AGREEING: Final = 8
"""Readings that must agree before it is settled: fewer could be chance under a jittering SYNC."""
AGREEING_SPREAD: Final = 32
"""The same where delays spread over more than half a period, so that only the smallest of many is telling."""
REVOKED: Final = 12
"""Where delays spread, a reading after a step lies on a SYNC that has none yet about every second time:
twelve in a row are one chance in four thousand."""
HELD_MAX: Final = 64
"""Cycles for which a row waits for the answer to a question: longer than one stays open."""
SUSPECTS_MAX: Final = 48
"""After so many it is settled for the clock as it was."""
STEP_COST: Final = 3
"""That a clock was set,"""
DELAY_COST: Final = 3
"""that the smallest delay changed by more than half a period,"""
LOSS_COST_MAX: Final = 2
"""and that readings were lost just then, one each up to this: a step and a change of delay are as rare as one
another, while losses are common and come in bursts."""
DRIFT_WITHIN: Final = 2e-3
"""Rates up to 2000 ppm off the old one are looked for among suspects."""
LATE_KEPT: Final = 0.97
"""Weight of the past in the mean change of lateness: it forgets within some thirty readings."""
STAMPS_MAX: Final = 512
"""Stamps kept before those of forgotten SYNCs are dropped."""
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
        "unmatched",
    )

    def __init__(self) -> None:
        self.placed = 0
        """Readings placed."""
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


class Question:
    """What is held back while it is open which SYNCs the last readings answer.

    A reading that comes meanwhile is marked uncertain at first. With the answer its mark is taken back, or
    stays; the rows of a run wait for that (:attr:`HELD_MAX` cycles at most).
    """

    __slots__ = ("_amended", "cleared", "open")

    def __init__(self) -> None:
        self.open = False
        self.cleared = False
        """Whether a question ended without leaving a reading uncertain, since this was last set back."""
        self._amended: dict[int, tuple[bool, int]] = {}

    def amend(self, sequence: int, certain: bool, error_ns: int) -> None:
        """What the row of a cycle is to say after all."""
        self._amended[sequence] = (certain, error_ns)

    def withdraw(self, sequence: int) -> None:
        """The row stays as it is."""
        self._amended.pop(sequence, None)

    def applied(self, observation: Observation) -> Observation:
        """The observation with what became known since; it is then forgotten."""
        amended = self._amended.pop(observation.sequence, None)
        if amended is None:
            return observation
        certain, error_ns = amended
        if isinstance(observation, Sample):
            return observation._replace(certain=certain, sampled_at_error_ns=error_ns)
        return observation._replace(certain=certain)


class _Suspect:
    """A reading that came while it is open whether the clock was set."""

    __slots__ = ("device_ns", "guess", "received_at", "second")

    def __init__(self, device_ns: int, received_at: Instant, second: bool) -> None:
        self.device_ns = device_ns
        self.received_at = received_at
        self.second = second
        """Whether it lies on a SYNC that has another stamp already."""
        self.guess = SURPLUS
        """The cycle in which it was placed, uncertain."""


class _Line(NamedTuple):
    """A way to place the last suspects."""

    cost: int
    delay_change: int
    """By how much the smallest delay would have changed, ns; it decides between equals, but not at once."""
    marks: tuple[SyncMark, ...]
    """The SYNC of each."""
    steps: bool
    """Whether the clock was set."""


class _DelayWindow:
    """Smallest and largest delay of the last readings."""

    __slots__ = ("_count", "_high", "_low", "_seen", "high", "low")

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

    def slack(self) -> int:
        """How far beyond what was seen the next delay of the same network may well lie.

        Of n values drawn evenly the smallest is an (n+1)-th of their spread above the least possible one on
        the average, and hardly ever four times that.
        """
        return 4 * (self.high - self.low) // max(self._seen, 1)


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
        self.question = Question()
        self.clock = clock
        self.doubtful_error_ns = REMEMBERED * period
        """Of a reading of uncertain place: any SYNC that is remembered may be its own."""
        self._syncs = syncs
        self._quarter = period // 4
        self._half = period // 2
        self._transit = transit
        self._tell = tell
        echo_error = ECHO_ERROR[syncs.echoes]
        self._match_ns = MATCH_NS + echo_error
        self._variance = float(echo_error) ** 2 / 9.0
        self._late_ns = 0.0
        self._lateness = 0
        self._unanchored = 0
        self._least_late = 0
        self._stamps: dict[int, int] = {}
        """Of each SYNC answered, by its number: the stamp."""
        self._answered = 0
        """Number of the newest SYNC answered."""
        self._suspects: list[_Suspect] = []
        self._suspects_from = 0
        """``_answered`` when the question was put."""
        self._twice = 0
        """Readings that came twice since the last one that raised no question."""
        self._early = False
        """Whether a suspect would have come before its SYNC, which no network can do."""
        self._delays = _DelayWindow()
        self._recent: deque[SyncMark] = deque(maxlen=REVOKED)
        self._revoked: list[tuple[SyncMark, int]] = []
        """Placements and their stamps that the open question touches."""

    @property
    def spread(self) -> bool:
        """Whether delays spread over more than half a period, so that a clock that was set by whole periods
        may not show with the first reading: a placement is final only :data:`REVOKED` readings later."""
        return self._delays.high - self._delays.low >= self._half

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        device_ns, on_bus_at = reading.device_time_ns, mark.on_bus_at
        if device_ns is not None and on_bus_at is not None:
            self.clock.observe(device_ns, on_bus_at, self._variance)
            self._answer(mark, device_ns)
            self._delays.add(reading.received_at - on_bus_at)

    def place(self, reading: Reading) -> Sample | None:
        device_ns = reading.device_time_ns
        if device_ns is None or not self.clock.ready:
            self.health.unmatched += 1
            return None
        at = self.clock.place(device_ns)
        mark = self._syncs.nearest(at)
        if mark is None or mark.on_bus_at is None:
            self.health.unmatched += 1
            return None
        lateness = at - mark.on_bus_at
        match_ns = self._match_ns + self.clock.error_ns
        late_max = min(int(4.0 * self._late_ns), self._quarter)
        fits = -match_ns <= lateness <= (match_ns if match_ns > late_max else late_max)
        known = self._stamps.get(mark.number) if fits else None
        if known == device_ns:
            self.health.duplicates += 1
            self._twice += 1
            return None
        free = fits and known is None
        if free and self._usual(mark, reading.received_at - mark.on_bus_at):
            if self._suspects:
                self._exonerate_free()
                self._acquit()
            self._twice = 0
            return self._matched(reading, device_ns, mark, at, lateness, match_ns)
        return self._suspect(reading, device_ns, mark if free else None, at, lateness, known is not None)

    def _usual(self, mark: SyncMark, delay: int) -> bool:
        """Whether a reading on a free SYNC raises no question, and answers the one that may be open."""
        bearable = self._half + self._delays.slack()
        if not self._delays.low - bearable <= delay <= self._delays.high + bearable:
            return False
        if not self._suspects:
            return True
        # A clock set back makes every delay longer by what it was set, at least a period.
        return mark.number > self._suspects_from and not self._early and delay < 4 * self._quarter

    def _matched(
        self, reading: Reading, device_ns: int, mark: SyncMark, at: Instant, lateness: int, match_ns: int
    ) -> Sample | None:
        health = self.health
        on_bus_at = mark.on_bus_at
        assert on_bus_at is not None
        self._answer(mark, device_ns)
        # A SYNC that was late by less than can be told moves the map by as much, so the bound is twice that.
        sampled_at, error_ns = on_bus_at, 2 * match_ns
        if lateness > match_ns:
            # Late to the drive: the stamp knows better. Nothing but the SYNC itself excludes that it was not.
            sampled_at, error_ns = at, lateness + match_ns
        self._follow(device_ns, on_bus_at, lateness, match_ns)
        if mark.sequence == SURPLUS:
            health.unmatched += 1
            return None
        health.placed += 1
        self._judge(reading.received_at - sampled_at, error_ns)
        self._delays.add(reading.received_at - sampled_at)
        self._recent.append(mark)
        return new_sample(mark.sequence, reading, sampled_at, error_ns, True)

    def _answer(self, mark: SyncMark, device_ns: int) -> None:
        """``mark`` has its reading."""
        self._stamps[mark.number] = device_ns
        self._answered = max(self._answered, mark.number)
        if len(self._stamps) > STAMPS_MAX:
            oldest = self._syncs.marks[0].number
            self._stamps = {number: stamp for number, stamp in self._stamps.items() if number >= oldest}

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
        late = lateness > match_ns
        self._note_lateness(lateness if late else 0)
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

    def _note_lateness(self, lateness: int) -> None:
        """Follow how much lateness changes from reading to reading; a clock that was set changes it once."""
        change = abs(lateness - self._lateness)
        self._lateness = lateness
        self._late_ns = LATE_KEPT * self._late_ns + (1.0 - LATE_KEPT) * change

    # ---- clocks that were set -----------------------------------------------------------------------------

    def _exonerate_free(self) -> None:
        """The clock is as it was: suspects alone on a SYNC of their own are certain after all."""
        guesses = [suspect.guess for suspect in self._suspects]
        proved = 0
        match_ns = self._match_ns + self.clock.error_ns
        for suspect in self._suspects:
            at = self.clock.place(suspect.device_ns)
            mark = self._syncs.nearest(at)
            if mark is None or mark.on_bus_at is None or abs(at - mark.on_bus_at) > match_ns:
                continue
            if mark.sequence == suspect.guess and guesses.count(suspect.guess) == 1:
                self._answer(mark, suspect.device_ns)
                self.question.amend(suspect.guess, True, 2 * match_ns)
                proved += 1
        self.question.cleared = proved == len(guesses)

    def _acquit(self) -> None:
        """The clock is as it was: a second stamp for a SYNC has no explanation then."""
        for suspect in self._suspects:
            if suspect.second:
                self.health.two_stamps += 1
        for mark, stamp in self._revoked:
            self.question.withdraw(mark.sequence)
            self._stamps.setdefault(mark.number, stamp)
        self._close()

    def _close(self) -> None:
        """The question is answered."""
        self._suspects.clear()
        self._revoked.clear()
        self._early = False
        self.question.open = False

    def _suspect(
        self,
        reading: Reading,
        device_ns: int,
        free: SyncMark | None,
        at: Instant,
        lateness: int,
        second: bool,
    ) -> Sample | None:
        """A reading that puts the question, or came while it is open; ``free``: the SYNC it lies on."""
        suspects = self._suspects
        if any(known.device_ns == device_ns for known in suspects):
            self.health.duplicates += 1
            return None
        if not suspects:
            self._suspects_from = self._answered
            if self.spread:
                self._revoke()
        if free is None and lateness > 0:
            self._note_lateness(min(lateness, self._quarter))
        self._early = self._early or at > reading.received_at - self._transit + self._match_ns
        suspects.append(_Suspect(device_ns, reading.received_at, second))
        self.question.open = True
        guess = self._guess(reading, free)
        if guess is not None:
            suspects[-1].guess = guess.sequence
        self._settle()
        return guess

    def _revoke(self) -> None:
        """The last placements may have been wrong already: their SYNCs are free again."""
        for mark in self._recent:
            stamp = self._stamps.pop(mark.number, None)
            if stamp is not None:
                self._revoked.append((mark, stamp))
                self.question.amend(mark.sequence, False, self.doubtful_error_ns)
        self._recent.clear()

    def _guess(self, reading: Reading, free: SyncMark | None) -> Sample | None:
        """A reading's most likely place, marked uncertain."""
        received_at = reading.received_at
        latest = Instant(received_at - self._transit)
        open_marks = [
            mark
            for mark in self._syncs.marks
            if mark.on_bus_at is not None
            and mark.on_bus_at <= latest
            and mark.number not in self._stamps
            and mark.sequence != SURPLUS
        ]
        if not open_marks:
            self.health.unmatched += 1
            return None
        mark = free if free is not None and free in open_marks else open_marks[-1]
        assert mark.on_bus_at is not None
        self.health.placed += 1
        return new_sample(mark.sequence, reading, mark.on_bus_at, self.doubtful_error_ns, False)

    def _settle(self) -> None:
        """Close the question if the last suspects leave one answer."""
        agreeing = AGREEING_SPREAD if self.spread else AGREEING
        count = len(self._suspects)
        if count < agreeing or (count - agreeing) % (AGREEING // 2):
            return
        last = self._suspects[-agreeing:]
        lines = sorted(self._lines(last), key=lambda line: (line.cost, line.delay_change))
        if lines and (len(lines) == 1 or lines[0].cost < lines[1].cost or count > SUSPECTS_MAX // 2):
            self._take(lines[0], last)
        elif count > SUSPECTS_MAX:
            self._acquit()

    def _take(self, line: _Line, last: list[_Suspect]) -> None:
        pairs: list[tuple[int, Instant]] = []
        for suspect, mark in zip(last, line.marks, strict=True):
            assert mark.on_bus_at is not None
            pairs.append((suspect.device_ns, mark.on_bus_at))
        if line.steps:
            step_us = (self.clock.place(pairs[0][0]) - pairs[0][1]) / NS_PER_US
            self._tell(
                f"its clock was set by {step_us:+.0f} us;"
                f" {len(self._suspects)} readings since then are uncertain"
            )
            self.clock.start_anew(sorted(pairs), self._variance)
            self._late_ns = 0.0
            self.health.steps += 1
        else:
            self._delays = _DelayWindow()
        self._exonerate(last, line)
        if line.steps:
            self._close()
        else:
            self._acquit()
        self._twice = 0
        for suspect, mark in zip(last, line.marks, strict=True):
            self._answer(mark, suspect.device_ns)
            assert mark.on_bus_at is not None
            self._delays.add(suspect.received_at - mark.on_bus_at)

    def _exonerate(self, last: list[_Suspect], line: _Line) -> None:
        """Suspects that had been placed where the answer puts them are certain after all."""
        guesses = [suspect.guess for suspect in self._suspects]
        proved = 0
        for suspect, mark in zip(last, line.marks, strict=True):
            if suspect.guess == mark.sequence and guesses.count(suspect.guess) == 1:
                self.question.amend(suspect.guess, True, 2 * (self._match_ns + self.clock.error_ns))
                proved += 1
        self.question.cleared = proved == len(guesses) and not (line.steps and self._revoked)

    def _lines(self, last: list[_Suspect]) -> list[_Line]:
        """Every way to place these suspects on SYNCs."""
        received_at = last[0].received_at
        found = []
        for mark in self._syncs.marks:
            on_bus_at = mark.on_bus_at
            if on_bus_at is not None and on_bus_at <= received_at - self._transit + self._match_ns:
                line = self._line(last, mark)
                if line is not None:
                    found.append(line)
        return found

    def _line(self, last: list[_Suspect], first: SyncMark) -> _Line | None:
        """How they are placed if the first answers ``first``; None if they cannot be.

        Readings that seemed to come twice just before may have been the first after a step by whole periods.
        """
        origin_at = first.on_bus_at
        assert origin_at is not None
        origin_ns, rate = last[0].device_ns, 1.0 + self.clock.rate
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
            if self._stamps.get(mark.number, suspect.device_ns) != suspect.device_ns:
                return None
            drifted += miss
            used.add(mark.number)
            marks.append(mark)
            smallest = delay if smallest < 0 else min(smallest, delay)
        unmoved_at = self.clock.place(origin_ns)
        steps = abs(unmoved_at - origin_at) > self._match_ns + self.clock.error_ns
        if steps and self._revoked:
            unmoved = self._syncs.nearest(unmoved_at)
            if unmoved is not None and not self._agrees(used, first.number - unmoved.number):
                return None
        lost = self._lost_before(min(used))
        if steps:
            cost = STEP_COST + min(max(0, lost - self._twice), LOSS_COST_MAX)
        else:
            cost = min(lost + self._twice, LOSS_COST_MAX)
        change = abs(smallest - self._delays.low)
        if change > self._half + self._delays.slack():
            # The smallest of many delays that spread is sooner believed than losses.
            cost += DELAY_COST + (LOSS_COST_MAX + 1 if self.spread else 0)
        return _Line(cost, change, tuple(marks), steps)

    def _agrees(self, used: set[int], moved: int) -> bool:
        """Whether the readings before the suspects can be placed as well, if the clock was set among them.

        Those since then lie ``moved`` SYNCs from where they were placed; no two may lie on one SYNC.
        """
        numbers = [mark.number for mark, _ in self._revoked]
        for split in range(len(numbers) + 1):
            placed = numbers[:split] + [number + moved for number in numbers[split:]]
            taken = used.union(placed)
            if len(taken) == len(used) + len(placed) and not taken.intersection(self._stamps):
                return True
        return False

    def _lost_before(self, number: int) -> int:
        """SYNCs of cycles after the last certainly answered one and before ``number``."""
        return sum(
            self._suspects_from < mark.number < number and mark.on_bus_at is not None
            for mark in self._syncs.marks
        )


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
    lost reading. So after a gap readings are uncertain until a *probe*: one SYNC goes out a quarter of a
    period late. A drive that answers in time answers that one as late as itself; a delayed stream stays.
    """

    def __init__(self, syncs: SyncLog, period: Duration, transit: Duration, tell: Tell) -> None:
        self.health = Health()
        self.question = Question()
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
        self._unsure: list[int] = []
        """Cycles whose readings wait for the end of the probe."""

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
            self._find_beyond(mark.number)
            self.health.unmatched += 1
            return None
        if mark.number > self._answered + 1:
            self._sure = False
        self._answered = mark.number
        if mark.number == self._probe:
            self._conclude(age)
        elif not self._sure and self._probe < mark.number and mark.number >= self._next_probe:
            self.wants_probe = True
        self._usual_ns += (age - self._usual_ns) / 4.0
        self.question.open = not (self._sure or self._beyond)
        health = self.health
        health.placed += 1
        if not self._sure:
            if not self._beyond:
                self._unsure.append(mark.sequence)
            error_ns = self._error_ns + received_at - self._oldest_at(mark)
        else:
            error_ns = self._error_ns
            if age < self._transit - error_ns:
                health.below_transit += 1
        health.error_ns_max = max(health.error_ns_max, error_ns)
        return new_sample(mark.sequence, reading, mark.on_bus_at, error_ns, self._sure)

    def _oldest_at(self, mark: SyncMark) -> Instant:
        first = self._syncs.marks[0].on_bus_at
        return first if first is not None else mark.handed_at

    def _conclude(self, age: int) -> None:
        """The SYNC that went out late was answered after ``age``; usual is what the readings before had."""
        if abs(age - self._usual_ns) >= self._period / 8.0:
            self._find_beyond(self._probe)
            return
        self._sure = True
        for sequence in self._unsure:
            self.question.amend(sequence, True, self._error_ns)
        self._unsure.clear()
        self.question.cleared = not self._beyond
        if self._beyond:
            self._beyond = False
            self._tell("its readings answer the SYNC before them again")

    def _find_beyond(self, number: int) -> None:
        """A reading has come later than the SYNC after its own; ``number``: of the SYNC of now."""
        self._sure = False
        self.question.open = False
        self._unsure.clear()
        self.wants_probe = False
        self._next_probe = number + PROBE_AGAIN_AFTER
        if not self._beyond:
            self._beyond = True
            self._tell(
                "its readings come later than the next SYNC; without a stamp of the drive's clock beside the"
                " speed it cannot be told which SYNC they answer: they are marked uncertain"
            )
