"""Which SYNC a reading answers, and when it was taken.

A drive with a clock stamps each sample. The map of its clock puts the stamp on the host's axis, and the SYNC
whose end on the bus lies there is the one it answers:

    SYNC ends      1          2          3          4
    stamps         :d1        :d2                   : d4            d3 was lost
    lateness       0          0                     +              d4: the SYNC came late to the drive

The bench sends no SYNC within half a period of another; so a stamp within a quarter of a period of one can be
that one's only. How far stamps lie from their SYNCs is measured (:mod:`hil.loop.residuals`), and with it what
counts as lying on one, and the bound of each sample. *Lateness* is the stamp's instant minus that of the SYNC
on the bus, less the smallest one: what the SYNC took behind its echo, or, on a bus without echoes, what it
waited in front of the bus. A constant delay of the SYNC behind its echo cannot be told from the offset of the
clock.

Where a stamp lies off all SYNCs, or on one that has another stamp, or where the delay leaves what it was by
more than half a period, the drive's clock may have been set. While that is open, readings are marked
uncertain. It is settled when :data:`AGREEING` of them lie on one line on which each has a SYNC of its own and
came no sooner than a frame can. Of several such lines, whole periods apart, the one is taken that needs least
to have happened: no step rather than a step, the same smallest delay rather than another, and no losses.
"""

from collections import deque
from typing import Final

from drivers.exchange import Reading
from drivers.timebase import NS_PER_US, Duration, Instant
from hil.loop.attribution import Health, Question, Tell
from hil.loop.clock_map import STAMP_RESOLUTION, ClockMap, residuals_of, step_of
from hil.loop.clock_question import LOSS_COST_MAX, STEP_COST, ClockQuestion, Line, Suspect
from hil.loop.residuals import Extremes, Residuals
from hil.loop.samples import Sample
from hil.loop.syncs import REMEMBERED, STAMPED_LATE, SURPLUS, SyncLog, SyncMark

MATCH_NS: Final = 3 * NS_PER_US
"""A stamp of 1 us so near to a SYNC is its own: a step of the stamp and two of rounding. A coarser one may be
off by as much more as its step is longer."""
AGREEING: Final = 8
"""Readings that must agree before it is settled: fewer could be chance under a jittering SYNC."""
AGREEING_SPREAD: Final = 32
"""The same where delays spread over more than half a period, so that only the smallest of many is telling."""
REVOKED: Final = 12
"""Where delays spread, a reading after a step lies on a SYNC that has none yet about every second time:
twelve in a row are one chance in four thousand."""
SUSPECTS_MAX: Final = 48
"""After so many it is settled for the clock as it was."""
LEARNED_MIN: Final = 8
"""Fewer than so many say little of how far residuals reach."""
LEARNED_MAX: Final = 64
"""Readings of a calibration that are remembered: as many as it has SYNCs at the most."""
STAMPS_MAX: Final = 512
"""Stamps kept before those of forgotten SYNCs are dropped."""


class StampAttribution:
    """Places readings by their stamps."""

    def __init__(
        self,
        syncs: SyncLog,
        period: Duration,
        transit: Duration,
        tell: Tell,
        resolution: Duration = STAMP_RESOLUTION,
    ) -> None:
        """``transit``: the shortest time that a reading's frame takes on the wire. ``tell``: takes events.
        ``resolution``: of a stamp."""
        self.health = Health()
        self.question = Question()
        self.clock = clock = ClockMap(resolution)
        self.doubtful_error_ns = REMEMBERED * period
        """Of a reading of uncertain place: any SYNC that is remembered may be its own."""
        self._syncs = syncs
        self._quarter = period // 4
        self._half = period // 2
        self._transit = transit
        self._tell = tell
        echo_error = syncs.error_ns
        self._echo_error = echo_error
        self.resolution = resolution
        """Of a stamp: as told, or as its steps have shown while learning."""
        self._match_ns = self._match_of(resolution)
        self._echoes_late = syncs.basis in STAMPED_LATE
        self._variance = float(echo_error) ** 2 / 9.0
        self._residuals = Residuals(echo_error / 3.0)
        self._case = ClockQuestion(syncs, clock, self._residuals, period, transit, self._match_ns)
        self._learned: deque[tuple[int, Instant]] = deque(maxlen=LEARNED_MAX)
        """Stamps and SYNCs of a calibration."""
        self._handed: deque[tuple[int, Instant]] = deque(maxlen=LEARNED_MAX)
        """Its stamps, and when their SYNCs were handed over, which no adapter stamps."""
        self._answered = 0
        """Number of the newest SYNC answered."""
        self._suspects: list[Suspect] = []
        self._early = False
        """Whether a suspect would have come before its SYNC, which no network can do."""
        self._recent: deque[SyncMark] = deque(maxlen=REVOKED)

    @property
    def spread(self) -> bool:
        """Whether delays spread over more than half a period, so that a clock that was set by whole periods
        may not show with the first reading: a placement is final only :data:`REVOKED` readings later."""
        return self._case.delays.spreads(self._half)

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        device_ns, on_bus_at = reading.device_time_ns, mark.on_bus_at
        if device_ns is not None and on_bus_at is not None:
            residuals, learned = self._residuals, self._learned
            self.clock.observe(device_ns, on_bus_at, self._variance)
            learned.append((device_ns, on_bus_at))
            self._handed.append((device_ns, mark.handed_at))
            if len(learned) >= LEARNED_MIN:
                pairs = list(learned)
                self._coarsen(step_of(self._handed))
                residuals.learn(residuals_of(pairs), self._match_ns)
                if residuals.spread:
                    self.clock.start_anew(pairs, residuals.variance_ns2)
            self._answer(mark, device_ns)
            self._case.delays.add(reading.received_at - on_bus_at)

    def _coarsen(self, step: int) -> None:
        """Stamps advance by ``step`` at a time; one of a maker is known to be of that resolution at least."""
        if step > self.resolution:
            self.resolution = Duration(step)
            self.clock.set_resolution(self.resolution)
            self._match_ns = self._case.match_ns = self._match_of(self.resolution)

    def _match_of(self, resolution: Duration) -> int:
        return MATCH_NS + resolution - STAMP_RESOLUTION + self._echo_error

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
        residual = at - mark.on_bus_at
        match_ns = self._match_ns + self.clock.error_ns
        fits = self._fits(residual, match_ns)
        known = self._case.stamps.get(mark.number) if fits else None
        if known == device_ns:
            self.health.duplicates += 1
            self._case.twice += 1
            return None
        free = fits and known is None
        if free and self._usual(mark, reading.received_at - mark.on_bus_at):
            if self._suspects:
                self._exonerate_free()
                self._acquit()
            self._case.twice = 0
            return self._matched(reading, device_ns, mark, residual, match_ns)
        return self._suspect(reading, device_ns, mark if free else None, at, known is not None)

    def _fits(self, residual: int, match_ns: int) -> bool:
        """Whether a stamp lies on its SYNC: as near as others do, within a quarter of a period.

        The map may have moved by a part of the spread since they came, so a little further is near too.
        """
        residuals = self._residuals
        least = match_ns + residuals.spread // 4
        most = max(match_ns, self._quarter)
        return -min(least + residuals.early, most) <= residual <= min(least + residuals.late, most)

    def _usual(self, mark: SyncMark, delay: int) -> bool:
        """Whether a reading on a free SYNC raises no question, and answers the one that may be open."""
        bearable = self._half + self._case.delays.slack()
        if not self._case.delays.low - bearable <= delay <= self._case.delays.high + bearable:
            return False
        if not self._suspects:
            return True
        # A clock set back makes every delay longer by what it was set, at least a period.
        return mark.number > self._case.since and not self._early and delay < 4 * self._quarter

    def _matched(
        self, reading: Reading, device_ns: int, mark: SyncMark, residual: int, match_ns: int
    ) -> Sample | None:
        health = self.health
        on_bus_at = mark.on_bus_at
        assert on_bus_at is not None
        self._answer(mark, device_ns)
        residuals = self._residuals
        lateness = max(0, residual - residuals.least) if residuals.spread else residual
        # A SYNC that was late by less than can be told moves the map by as much, so the bound is twice that.
        sampled_at, error_ns = on_bus_at, 2 * match_ns + residuals.slack
        if self._echoes_late:
            # What is early and late cannot be told apart: either may be all of it.
            error_ns = max(error_ns + residuals.early + residuals.late, match_ns + mark.late_ns)
        elif residuals.early or residuals.late or lateness > match_ns:
            # Late to the drive: the stamp knows better. Nothing but the SYNC itself excludes that it was not.
            sampled_at, error_ns = Instant(on_bus_at + lateness), lateness + match_ns + residuals.slack
        self._follow(device_ns, on_bus_at, residual, match_ns)
        if mark.sequence == SURPLUS:
            health.unmatched += 1
            return None
        health.placed += 1
        self._judge(reading.received_at - sampled_at, error_ns)
        self._case.delays.add(reading.received_at - sampled_at)
        self._recent.append(mark)
        return Sample(mark.sequence, reading, sampled_at, error_ns, True)

    def _answer(self, mark: SyncMark, device_ns: int) -> None:
        """``mark`` has its reading."""
        self._case.stamps[mark.number] = device_ns
        self._answered = max(self._answered, mark.number)
        if len(self._case.stamps) > STAMPS_MAX:
            oldest = self._syncs.marks[0].number
            for number in [number for number in self._case.stamps if number < oldest]:
                del self._case.stamps[number]

    def _judge(self, delay: int, error_ns: int) -> None:
        """What cannot be is an alarm."""
        health = self.health
        if delay < self._transit - error_ns:
            health.below_transit += 1
            if delay < 0:
                health.before_sync += 1
        if error_ns > health.error_ns_max:
            health.error_ns_max = error_ns

    def _follow(self, device_ns: int, on_bus_at: Instant, residual: int, match_ns: int) -> None:
        """Let map and residuals follow a reading that lies on its SYNC."""
        residuals = self._residuals
        on_map = Instant(on_bus_at + residual - residuals.cut(residual, match_ns))
        self.clock.observe(device_ns, on_map, max(self._variance, residuals.variance_ns2))
        residuals.add(residual, match_ns)

    @property
    def map_error_ns(self) -> int:
        """How far an instant that the map places may be off, a delay that all SYNCs have aside."""
        return self.clock.error_ns + self._residuals.reach

    # ---- clocks that were set -----------------------------------------------------------------------------

    def _exonerate_free(self) -> None:
        """The clock is as it was: suspects alone on a SYNC of their own are certain after all."""
        placed: list[tuple[Suspect, SyncMark]] = []
        match_ns = self._match_ns + self.clock.error_ns
        for suspect in self._suspects:
            at = self.clock.place(suspect.device_ns)
            mark = self._syncs.nearest(at)
            if mark is None or mark.on_bus_at is None:
                continue
            if self._fits(at - mark.on_bus_at, match_ns):
                placed.append((suspect, mark))
        self.question.cleared = self._exonerate(placed)

    def _exonerate(self, placed: list[tuple[Suspect, SyncMark]]) -> bool:
        """Suspects that had been placed where they are known to be now, and none beside them there, are
        certain after all; whether all are."""
        guesses = [suspect.guess for suspect in self._suspects]
        match_ns = self._match_ns + self.clock.error_ns
        proved = 0
        for suspect, mark in placed:
            if suspect.guess == mark.sequence and guesses.count(suspect.guess) == 1:
                self._answer(mark, suspect.device_ns)
                self.question.amend(suspect.guess, True, 2 * match_ns + self._residuals.spread)
                proved += 1
        return proved == len(guesses)

    def _acquit(self) -> None:
        """The clock is as it was: a second stamp for a SYNC has no explanation then."""
        for suspect in self._suspects:
            if suspect.second:
                self.health.two_stamps += 1
            else:
                self._note_residual(suspect)
        for mark, stamp in self._case.revoked:
            self.question.withdraw(mark.sequence)
            self._case.stamps.setdefault(mark.number, stamp)
        self._close()

    def _note_residual(self, suspect: Suspect) -> None:
        """It lies off its SYNC though the clock is as it was: others may too."""
        at = self.clock.place(suspect.device_ns)
        mark = self._syncs.nearest(at)
        if mark is not None and mark.on_bus_at is not None and abs(at - mark.on_bus_at) <= self._quarter:
            self._residuals.add(at - mark.on_bus_at, self._match_ns + self.clock.error_ns)

    def _close(self) -> None:
        """The question is answered."""
        self._suspects.clear()
        self._case.revoked.clear()
        self._early = False
        self.question.open = False
        self.question.since = None

    def _suspect(
        self,
        reading: Reading,
        device_ns: int,
        free: SyncMark | None,
        at: Instant,
        second: bool,
    ) -> Sample | None:
        """A reading that puts the question, or came while it is open; ``free``: the SYNC it lies on."""
        suspects = self._suspects
        if any(known.device_ns == device_ns for known in suspects):
            self.health.duplicates += 1
            return None
        if not suspects:
            self._case.since = self._answered
            if self.spread:
                self._revoke()
        self._early = (
            self._early or at > reading.received_at - self._transit + self._match_ns + self._residuals.spread
        )
        suspects.append(Suspect(device_ns, reading.received_at, second))
        self.question.open = True
        guess = self._guess(reading, free)
        if guess is not None:
            suspects[-1].guess = guess.sequence
        self._settle()
        return guess

    def _revoke(self) -> None:
        """The last placements may have been wrong already: their SYNCs are free again."""
        for mark in self._recent:
            stamp = self._case.stamps.pop(mark.number, None)
            if stamp is not None:
                self._case.revoked.append((mark, stamp))
                self.question.amend(mark.sequence, False, self.doubtful_error_ns)
        if self._recent:
            self.question.since = self._recent[0].sequence
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
            and mark.number not in self._case.stamps
            and mark.sequence != SURPLUS
        ]
        if not open_marks:
            self.health.unmatched += 1
            return None
        mark = free if free is not None and free in open_marks else open_marks[-1]
        assert mark.on_bus_at is not None
        self.health.placed += 1
        return Sample(mark.sequence, reading, mark.on_bus_at, self.doubtful_error_ns, False)

    def _settle(self) -> None:
        """Close the question if the last suspects leave one answer."""
        agreeing = AGREEING_SPREAD if self.spread else AGREEING
        count = len(self._suspects)
        if count < agreeing or (count - agreeing) % (AGREEING // 2):
            return
        last = self._suspects[-agreeing:]
        lines = sorted(self._case.lines(last), key=lambda line: (line.cost, line.steps, line.delay_change))
        lines = [line for line in lines if line.cost <= STEP_COST + LOSS_COST_MAX]
        if lines and (len(lines) == 1 or lines[0].cost < lines[1].cost or count > SUSPECTS_MAX // 2):
            self._take(lines[0], last)
        elif count > SUSPECTS_MAX:
            self._acquit()

    def _take(self, line: Line, last: list[Suspect]) -> None:
        pairs: list[tuple[int, Instant]] = []
        for suspect, mark in zip(last, line.marks, strict=True):
            assert mark.on_bus_at is not None
            pairs.append((suspect.device_ns, mark.on_bus_at))
        if line.steps:
            step_us = (self.clock.place(pairs[0][0]) - pairs[0][1]) / NS_PER_US
            self._tell(
                f"its clock was set by {step_us:+.0f} us, which {len(self._suspects)} readings have shown"
            )
            pairs.sort()
            self.clock.move_to(pairs, self._residuals.variance_ns2)
            if self._residuals.spread:  # from here on they lie about another line
                self._residuals.learn(residuals_of(pairs), self._match_ns)
            self.health.steps += 1
        else:
            self._case.delays = Extremes()
        all_proved = self._exonerate(list(zip(last, line.marks, strict=True)))
        self.question.cleared = all_proved and not (line.steps and self._case.revoked)
        if line.steps:
            self._close()
        else:
            self._acquit()
        self._case.twice = 0
        for suspect, mark in zip(last, line.marks, strict=True):
            self._answer(mark, suspect.device_ns)
            assert mark.on_bus_at is not None
            self._case.delays.add(suspect.received_at - mark.on_bus_at)
