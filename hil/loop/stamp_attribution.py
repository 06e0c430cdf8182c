"""Which SYNC a reading answers, and when it was taken.

A drive with a clock stamps each sample. The map of its clock puts the stamp on the host's axis, and the SYNC
whose end on the bus lies there is the one it answers:

    SYNC ends      1          2          3          4
    stamps         :d1        :d2                   : d4            d3 was lost
    lateness       0          0                     +              d4: the SYNC came late to the drive

The bench sends no SYNC within half a period of another; so a stamp within a quarter of a period of one can be
that one's only. SYNCs that waited in front of a bus may come closer: a stamp that lies on two of them is
uncertain. How far stamps lie from their SYNCs is measured (:mod:`servobench.hil.loop.residuals`), and with it
what counts as lying on one, and the bound of each sample. *Lateness* is the stamp's instant minus the SYNC's
on the bus, less the smallest one: what the SYNC took behind its echo; without echoes, what it waited too.

Where a stamp lies off all SYNCs, or on one that has another stamp, or where the delay leaves what it was by
more than half a period, the drive's clock may have been set. While that is open, readings are marked
uncertain. It is settled when :data:`AGREEING` of them lie on one line on which each has a SYNC of its own and
came no sooner than a frame can. Of several such lines, whole periods apart, the one is taken that needs least
to have happened: no step rather than a step, the same smallest delay rather than another, and no losses.
"""

from collections import deque
from typing import Final

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.hil.loop.attribution import Health, Question, Tell
from servobench.hil.loop.clock_map import STAMP_RESOLUTION
from servobench.hil.loop.clock_question import AGREEING, SUSPECTS_MAX, ClockQuestion
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.late_drive import LateDrive
from servobench.hil.loop.period_doubt import PeriodDoubt, Placing
from servobench.hil.loop.residuals import DelayExtremes
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.suspects import Line, Suspect, note_copy
from servobench.hil.loop.syncs import REMEMBERED, STAMPED_LATE, SURPLUS, SyncLog, SyncMark

REVOKED: Final = 12
"""Where delays spread, a reading after a step lies on a SYNC that has none yet about every second time:
twelve in a row are one chance in four thousand."""


class StampAttribution:
    """Places readings by their stamps."""

    def __init__(
        self,
        syncs: SyncLog,
        period: Duration,
        transit: Duration,
        tell: Tell,
        resolution: Duration = STAMP_RESOLUTION,
        at_arrival: bool = False,
    ) -> None:
        """``transit``: the shortest time that a reading's frame takes on the wire. ``tell``: takes events.
        ``resolution``: of a stamp. ``at_arrival``: it is latched when the SYNC comes, not at the sampling."""
        self.health, self.question = Health(), Question()
        self._echoes_late = syncs.basis in STAMPED_LATE
        self.stamps = DriveStamps(period, syncs.error_ns, resolution, self._echoes_late)
        self.clock, self._residuals = self.stamps.clock, self.stamps.residuals
        self.doubtful_error_ns = REMEMBERED * period
        """Error of a reading of uncertain place: any SYNC that is remembered may be its own."""
        self._syncs, self._tell = syncs, tell
        self._half = period // 2
        self._transit = transit
        self._case = ClockQuestion(syncs, self.stamps, period, transit, at_arrival)
        self.doubt = PeriodDoubt(syncs, self.stamps, period, transit, tell)
        self._late = LateDrive(syncs, self.stamps, self._case, self.question, period, tell)
        self._suspects: list[Suspect] = []
        self._slowest = 0  # the longest delay of a suspect that lies on a SYNC
        self._recent: deque[Sample] = deque(maxlen=REVOKED)

    @property
    def spread(self) -> bool:
        """True if delays spread over more than half a period, so that a clock that was set by whole periods
        may not show with the first reading: a placement is final only :data:`REVOKED` readings later."""
        return self._case.delays.spreads(self._half)

    @property
    def longest_delay(self) -> int:
        """Longest delay of the last thousand readings or so, ns."""
        return self._case.delays.high

    @property
    def recent(self) -> list[tuple[Reading, SyncMark]]:
        """The last readings that are not in question, and their SYNCs."""
        last_of = self._syncs.last_of
        return [(each.reading, mark) for each in self._recent if (mark := last_of(each.sequence)) is not None]

    @property
    def may_overtake(self) -> bool:
        """True if delays spread so much that a frame may come before one of the SYNC before its own."""
        delays = self._case.delays
        return max(delays.high, self._slowest) - delays.low >= self._half + self._half // 2

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        device_ns, on_bus_at = reading.device_time_ns, mark.on_bus_at
        if device_ns is not None and on_bus_at is not None:
            self.stamps.learn(device_ns, mark, on_bus_at)
            self._case.answer(mark, device_ns)
            self._case.delays.add(reading.received_at - on_bus_at)

    def place(self, reading: Reading) -> Sample | None:
        device_ns = reading.device_time_ns
        if device_ns is None or not self.clock.ready:
            self.health.unmatched += 1
            return None
        at = self.clock.place(device_ns)
        if self.doubt.open and self._resolve(device_ns, at, reading.received_at):
            at = self.clock.place(device_ns)
        mark = self._syncs.nearest(at)
        if mark is None or mark.on_bus_at is None:
            self.health.unmatched += 1
            return None
        residual = at - mark.on_bus_at
        fits = self.stamps.fits(residual)
        known = self._case.stamps.get(mark.number) if fits else None
        if known == device_ns and self._tells_again(reading):
            self._late.copied(mark, reading.received_at - mark.on_bus_at)
            self.health.duplicates += 1
            self._case.twice += 1
            return None
        if rivals := self._case.rivals(mark, at) if fits else []:
            for rival in rivals:
                if rival.number not in self._case.stamps:
                    self.question.doubt(rival.sequence, self.doubtful_error_ns)
            return self._in_doubt(reading, device_ns, mark)
        free = fits and known is None
        sampled_at = at - self._residuals.middle if self._echoes_late else mark.on_bus_at
        if free and not self.doubt.surprised and self._usual(mark, reading.received_at - sampled_at, reading):
            if self._suspects:
                self._exonerate_free()
                self._acquit()
            self._case.twice = 0
            if self._late.doubts(mark, residual):
                return self._in_doubt(reading, device_ns, mark)
            return self._matched(reading, device_ns, mark, residual)
        return self._suspect(reading, device_ns, mark, free, at, known)

    def _usual(self, mark: SyncMark, delay: int, reading: Reading) -> bool:
        """True if a reading on a free SYNC raises no question, and answers the one that may be open."""
        if delay < self._transit and self.spread and delay < self._transit - self.stamps.near_ns:
            return False
        delays, beyond = self._case.delays, self._half + self._case.delays.slack()
        if not delays.low - beyond <= delay <= delays.high + beyond:
            return False
        if not self._suspects:
            return not delays.stay_longer(delay, self._half)
        return self._case.excludes_steps(mark, delay, reading.received_at, self._suspects)

    def _matched(self, reading: Reading, device_ns: int, mark: SyncMark, residual: int) -> Sample | None:
        health, residuals, match_ns = self.health, self._residuals, self.stamps.match_ns
        on_bus_at = mark.on_bus_at
        assert on_bus_at is not None
        self._case.answer(mark, device_ns)
        lateness = self.stamps.lateness(residual)
        # A SYNC that was late by less than can be told moves the map by as much, so the bound is twice that.
        latest = Instant(reading.received_at - self._transit)
        sampled_at = self.stamps.sampled_at(on_bus_at, residual, latest)
        error_ns = 2 * match_ns + residuals.slack
        if self._echoes_late and residuals.spread:
            error_ns = residuals.reach // 2 + match_ns
        elif not self._echoes_late or lateness > match_ns:
            # Nothing but the delay excludes that the SYNC was later to the drive than its stamp tells.
            hidden = self._case.hidden_ns(reading.received_at - sampled_at)
            late = max(max(lateness, hidden), 0 if residuals.spread else self.stamps.unshown_ns)
            error_ns = late + match_ns + residuals.slack
        if error_ns > self._half:
            error_ns = self._case.bounded(error_ns, sampled_at - on_bus_at, reading.received_at - on_bus_at)
        self.stamps.follow(device_ns, on_bus_at, residual)
        if mark.sequence == SURPLUS:
            health.unmatched += 1
            return None
        health.placed, delay = health.placed + 1, reading.received_at - sampled_at
        self._case.delays.add(delay)
        unstamped_ns = self._case.unstamped_ns(delay)
        certain = not self.doubt.open
        if not certain:
            self.doubt.rows.append((mark.sequence, reading.received_at, error_ns + unstamped_ns))
        elif match_ns < lateness and self._half < error_ns and not self._echoes_late:
            certain = False  # one SYNC, not the run's
        else:
            health.judge(delay, self._transit, error_ns, unstamped_ns)
        error_ns = error_ns + unstamped_ns if certain else self.doubtful_error_ns
        sample = Sample(mark.sequence, reading, sampled_at, error_ns, certain)
        self._recent.append(sample)
        return sample

    def _tells_again(self, reading: Reading) -> bool:
        """True if one whose stamp is known may be a copy: a clock that is set back makes its stamps again."""
        for sample in self._recent:
            if sample.reading.device_time_ns == reading.device_time_ns:
                return sample.reading.velocity_rad_s == reading.velocity_rad_s
        return True

    def changed_at(self, device_ns: int) -> tuple[Instant, Duration]:
        """When a demand with this stamp changed, and by how much that may be off, a delay that all SYNCs have
        aside. A map that lags a clock of another rate is off by what all residuals have in common."""
        at = Instant(self.clock.place(device_ns) - self._residuals.middle)
        return at, Duration(self.stamps.change_error_ns(device_ns) + self._residuals.reach)

    def _exonerate_free(self) -> None:
        """The clock is as it was: suspects alone on a SYNC of their own are certain after all."""
        placed = self._case.placed(self._suspects)
        self._late.acquitted(self._suspects)
        self._clear(self._exonerate(placed))

    def _clear(self, all_proved: bool) -> None:
        """A question is answered, and it has left no reading uncertain but by a doubt that goes on."""
        self.doubt.proved = self.doubt.proved and all_proved
        self.question.cleared = self.doubt.proved and not self.doubt.open

    def _exonerate(self, placed: list[tuple[Suspect, SyncMark]], *, runs_on: bool = True) -> bool:
        """Suspects that lie where they were placed are certain after all; whether all do. None is if stamps
        lie as far from SYNCs as these from one another, nor in a row in doubt if the clock ``runs_on``."""
        guesses = [suspect.guess for suspect in self._suspects]
        stamped_ns = self.stamps.near_ns
        proved = 0
        for suspect, mark in placed:
            delay = suspect.received_at - (mark.on_bus_at or 0)
            if not suspect.second:  # wherever it was placed meanwhile: one with its stamp is a copy
                self._case.answer(mark, suspect.device_ns)
            others = runs_on and self.question.doubts(suspect.guess)
            alone = stamped_ns < 2 * self._half and guesses.count(suspect.guess) == 1 and not others
            late_by = self.clock.place(suspect.device_ns) - (mark.on_bus_at or 0)
            if alone and suspect.guess == mark.sequence and not self._late.doubts(mark, late_by):
                late = max(self.stamps.match_ns, self._case.hidden_ns(delay))
                row = suspect.guess, suspect.received_at, stamped_ns + late + self._case.unstamped_ns(delay)
                if self.doubt.open:
                    self.doubt.rows.append(row)
                else:
                    self.question.prove(*row)
                proved += 1
        return proved == len(guesses)

    def _acquit(self) -> None:
        """The clock is as it was: of two stamps of a SYNC one is of another that came late to the drive."""
        shared = {suspect.beside for suspect in self._suspects}
        self.health.two_stamps += sum(each.second and each.beside == SURPLUS for each in self._suspects)
        for mark, stamp in self._case.revoked:
            if mark.sequence not in shared:
                (self.doubt.revoked.append if self.doubt.open else self.question.withdraw)(mark.sequence)
            self._case.stamps.setdefault(mark.number, stamp)
        self._close()

    def _close(self) -> None:
        """The question is answered."""
        self._suspects.clear()
        self._case.revoked.clear()
        self._slowest = 0
        self.question.open = self.doubt.open
        self.question.since = None

    def _suspect(
        self, reading: Reading, device_ns: int, mark: SyncMark, free: bool, at: Instant, known: int | None
    ) -> Sample | None:
        """A reading that puts the question, or comes while it is open, on or near the SYNC of ``mark``."""
        suspects = self._suspects
        if note_copy(suspects, reading):
            self.health.duplicates += 1
            return None
        reach_ns = self.stamps.near_ns - self.clock.error_ns
        if self._echoes_late:  # the map lies in the middle of what it may be off
            reach_ns = self.stamps.match_ns + self._residuals.high
        early = at > reading.received_at - self._transit + reach_ns
        if not suspects:
            if (early or known is not None) and not self.doubt.open and self.stamps.show_coarser(device_ns):
                return None
            self.doubt.proved = self.doubt.proved or not self.doubt.open
            self._case.since = self._case.answered
            if self.spread:
                self._revoke()
        suspects.append(Suspect(device_ns, reading.received_at, known, early, reading.velocity_rad_s))
        if free:
            self._slowest = max(self._slowest, reading.received_at - at)
        if known is not None and self.question.doubt(mark.sequence, self.doubtful_error_ns):
            suspects[-1].beside = mark.sequence
        self.question.open = True
        guess = self._guess(reading, mark if free else None)
        if guess is not None:
            suspects[-1].guess = guess.sequence
        self._settle()
        return guess

    def _revoke(self) -> None:
        """The last placements may have been wrong already: their SYNCs are free again."""
        for sample in self._recent:
            mark = None if self.question.doubts(sample.sequence) else self._syncs.last_of(sample.sequence)
            if mark is not None and (stamp := self._case.stamps.pop(mark.number, None)) is not None:
                self._case.revoked.append((mark, stamp))
                self.question.doubt(mark.sequence, self.doubtful_error_ns)
        if self._recent:
            self.question.since = self._recent[0].sequence
        self._recent.clear()

    def _guess(self, reading: Reading, free: SyncMark | None) -> Sample | None:
        """A reading's most likely place, marked uncertain."""
        marks = self._case.free_marks(Instant(reading.received_at - self._transit))
        return self._uncertain(reading, free if free in marks else marks[-1] if marks else None)

    def _in_doubt(self, reading: Reading, device_ns: int, mark: SyncMark) -> Sample | None:
        """The SYNC of ``mark`` is answered by it, or by one that is not told from it."""
        self._case.answer(mark, device_ns)
        self.doubt.proved = False
        return self._uncertain(reading, mark)

    def _uncertain(self, reading: Reading, mark: SyncMark | None) -> Sample | None:
        """It answers the SYNC of ``mark``, or another."""
        if mark is None or mark.on_bus_at is None or mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        self.health.placed += 1
        return Sample(mark.sequence, reading, mark.on_bus_at, self.doubtful_error_ns, False)

    def _settle(self) -> None:
        """Close the question if the last suspects leave one answer."""
        agreeing, count = self._case.agreeing, len(self._suspects)
        if count < agreeing or (count - agreeing) % (AGREEING // 2):
            return
        last = self._suspects[-agreeing:]
        if lines := self._case.answers(self._suspects, unlikely=count > SUSPECTS_MAX):
            self._take(lines, last)
        elif count > SUSPECTS_MAX and self._case.was_set(self._suspects):
            del self._suspects[: AGREEING // 2]
        elif count > SUSPECTS_MAX:
            self._late.acquitted(self._suspects)
            self._acquit()

    def _tell_step(self, by_ns: int, readings: int) -> None:
        self._tell(f"its clock was set by {by_ns / NS_PER_US:+.0f} us, which {readings} readings have shown")
        self.health.steps += 1

    def _take(self, lines: list[Line], last: list[Suspect]) -> None:
        """Place the last suspects by the first of ``lines``. If that says that something has happened, the
        others may be right as well: none of them has both the clock set and the delay changed."""
        line = lines[0]
        placed = [(suspect, mark) for suspect, mark in zip(last, line.marks, strict=True) if mark is not None]
        pairs: list[tuple[int, Instant]] = []
        for suspect, mark in placed:
            assert mark.on_bus_at is not None
            pairs.append((suspect.device_ns, mark.on_bus_at))
        steps, shared = line.steps or self.stamps.lie_early(pairs), {each.beside for each in self._suspects}
        if steps:
            for sequence in shared - {mark.sequence for mark, _ in self._case.revoked}:
                self.question.withdraw(sequence)
            self._tell_step(self.clock.place(pairs[0][0]) - pairs[0][1], len(self._suspects))
            self.stamps.move_to(pairs)
            self.doubt.moved()
        others = [(other.first_at - line.first_at, other.steps) for other in lines[1:]]
        if others and (line.unlikely or line.delay_change > self._half):
            self.doubt.put(steps, others, self._case.delays, self._case.since)
        if not steps:
            self._late.acquitted(self._suspects)
            self._case.delays = DelayExtremes()
        all_proved = self._exonerate(self._case.alike(placed) if steps else placed, runs_on=not steps)
        self._clear(all_proved and not (steps and self._case.revoked))
        (self._close if steps else self._acquit)()
        self._case.twice = 0
        self._case.learn(placed, others=steps and line.others)

    def _resolve(self, device_ns: int, at: Instant, received_at: Instant) -> bool:
        """What a reading tells of the ways to place it, while there are several; whether the map moves."""
        doubt = self.doubt
        doubt.heed(device_ns, at, received_at, bool(self._suspects))
        if doubt.open:
            return False
        way = doubt.ways[0]
        if way.offset_ns == 0:
            for row in doubt.rows:
                self.question.prove(*row)
            for sequence in doubt.revoked:
                self.question.withdraw(sequence)
            self.question.cleared = doubt.proved and not self._suspects
            self.question.open = bool(self._suspects)
        else:
            self._shift(way)
        doubt.end()
        return way.offset_ns != 0

    def _shift(self, way: Placing) -> None:
        """The clock was set by whole periods, since the doubt began."""
        case, doubt = self._case, self.doubt
        self._tell_step(-way.offset_ns, len(doubt.heeded))
        for number in [number for number in case.stamps if number > doubt.since]:
            del case.stamps[number]
        last_ns, _ = doubt.heeded[-1]
        pairs: list[tuple[int, Instant]] = []
        for device_ns, at in doubt.heeded:
            mark = self._syncs.nearest(Instant(at + way.offset_ns))
            if mark is not None and mark.on_bus_at is not None:
                pairs.append((device_ns, mark.on_bus_at))
                if device_ns != last_ns:
                    case.answer(mark, device_ns)
        self.stamps.move_to(pairs[-AGREEING:])
        case.delays = way.delays
        doubt.ways = []
        self._close()
