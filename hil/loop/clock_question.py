"""The question whether a drive's clock was set: ways to place readings whose stamps, or delays, put it.

The readings of a clock that runs on lie on one line, a SYNC each. Shifted by whole periods they do so again:

    SYNC ends      1       2       3       4       5
    as it runs             :d1     :d2     :d3             cost 0: nothing has happened
    set back                       :d1     :d2     :d3     cost of a step, and of a reading that was lost

Each way has the cost of what must have happened for it.
"""

from statistics import median_low
from typing import Final

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.answered_syncs import AnsweredSyncs
from servobench.hil.loop.residuals import NEARER
from servobench.hil.loop.suspects import DELAY_COST, LIKELY_COST_MAX, LOSS_COST_MAX, STEP_COST, Line, Suspect
from servobench.hil.loop.syncs import SURPLUS, SyncMark

AGREEING: Final = 8
"""Readings that must agree before it is settled: fewer could be chance under a jittering SYNC."""
AGREEING_SPREAD: Final = 32
"""The same where delays spread over almost a period, so that only the smallest of many is telling."""
AGREEING_ALONE: Final = 2 * AGREEING
"""Readings of grown delays until one usual reading answers nothing: fewer happen by jitter of the SYNC."""
SUSPECTS_MAX: Final = 48
"""After so many an unlikely answer is taken too. If there is none it is settled for the clock as it was,
unless a reading would have come before its SYNC."""
EXCLUDING: Final = 12.0
"""A line is none if another is e^12, 160 000 times, likelier by how far the readings lie off it. So SYNCs
that are not at equal distances tell which ones they are."""
MISFIT_MOST: Final = 2.0
"""Most misfit of each suspect on a line; half is usual. Those of a clock that was set twice lie on two lines,
and on none between."""
RARE: Final = 8
"""One suspect in so many may lie off its SYNC by more than any stamp did though the clock was not set,"""
OUTLYING: Final = 4.0
"""and weighs no more than one so many deviations off: each is rare by itself."""
SHOWN_MIN: Final = 3
"""Suspects that lie on SYNCs as the clock was show what delays were before it was set,"""
SCATTER_PARTS: Final = 20
"""where stamps lie within such a part of a period: three lie so by chance once in a thousand times."""
UNHEARD_PARTS: Final = 4
"""One suspect in so many may answer a SYNC of another node that was not heard: or else lines would be lost
for the lack of one, and one that needs none of them taken though it is the worse."""
DRIFT_WITHIN: Final = 2e-3
"""Rates up to 2000 ppm off the old one are looked for among suspects."""


class ClockQuestion(AnsweredSyncs):
    """The ways out of the question, while it is open."""

    _low: int = 0  # the smallest delay before it

    @property
    def agreeing(self) -> int:
        """How many readings settle it. Of delays that spread over less than a period a line that is a period
        off has some below the time of a frame, or all above those of before."""
        return AGREEING_SPREAD if self.delays.spreads(self._half * 7 // 4) else AGREEING

    def excludes_steps(self, mark: SyncMark, delay: int, at: Instant, suspects: list[Suspect]) -> bool:
        """Return whether a reading that came ``at``, a ``delay`` after the SYNC of ``mark``, is unusual for
        those beside it, as after a step by whole periods; not if those of many suspects are longer, too."""
        if mark.number <= self.since or any(suspect.early for suspect in suspects):
            return False  # early: before its SYNC, which no network can do
        period, low, slack, since = 2 * self._half, self.delays.low, self.delays.slack(), delay
        gaps = [(other.on_bus_at or 0) - (mark.on_bus_at or 0) for other in self._syncs.beside(mark)]
        least, most = low - self.delays.unseen(0), self.delays.high + slack
        if self._echoes_late:  # each is off the map by up to half of what residuals reach over
            off = self._stamps.residuals.reach // 2
            since, least, most = at - (mark.on_bus_at or 0), least - off, most + off
        else:  # the stamp tells a SYNC apart whose distance is no period
            gaps = [gap for gap in gaps if abs(abs(gap) - period) <= self._half // 4]
        if any(least <= since - gap <= most for gap in (period, -period, *gaps)):
            return False
        delays = [each.received_at - self._stamps.clock.place(each.device_ns) for each in suspects]
        return len(delays) < AGREEING_ALONE or min(delay, *delays) < low + self._half

    def placed(self, suspects: list[Suspect]) -> list[tuple[Suspect, SyncMark]]:
        """Suspects that lie on a SYNC, as the clock is, and that."""
        placed = list[tuple[Suspect, SyncMark]]()
        for suspect in suspects:
            at = self._stamps.clock.place(suspect.device_ns)
            mark = self._syncs.nearest(at)
            if mark is not None and mark.on_bus_at is not None and self._stamps.fits(at - mark.on_bus_at):
                placed.append((suspect, mark))
        return placed

    def note_residuals(self, suspects: list[Suspect]) -> list[SyncMark]:
        """Suspects lie off their SYNCs though the clock is as it was: others may too. Where a SYNC may wait
        in front of the bus unseen, a stamp before one is of the SYNC before, which waited so long. Return
        those off which a stamp lies by more than any before."""
        stamps, may_wait, noted = self._stamps, self._syncs.basis is EchoBasis.NONE, list[int]()
        beyond: list[SyncMark] = []
        for suspect in suspects:
            at = stamps.clock.place(suspect.device_ns)
            mark = None if suspect.second else self._syncs.nearest(at)
            if mark is not None and mark.on_bus_at is not None:
                residual = at - mark.on_bus_at
                if not may_wait or residual >= stamps.residuals.least - stamps.match_ns:
                    if not stamps.reaches(residual):
                        beyond.append(mark)
                    stamps.residuals.add_questioned(residual, stamps.match_ns, 2 * self._half)
                    noted.append(residual)
        stamps.residuals.scatter(noted)
        return beyond

    def was_set(self, suspects: list[Suspect]) -> bool:
        """True if the clock is not as it was: a suspect would have come before the SYNC next to its stamp."""
        for suspect in suspects:
            mark = self._syncs.nearest(self._stamps.clock.place(suspect.device_ns))
            latest = suspect.received_at - self._transit + self._stamps.match_ns
            if mark is not None and mark.on_bus_at is not None and mark.on_bus_at > latest:
                return True
        return False

    def answers(self, suspects: list[Suspect], *, unlikely: bool) -> list[Line]:
        """The ways to place the last suspects that are likely enough, the one first of which least must have
        happened. ``unlikely``: or a step, and that the smallest delay has changed by less than a period, or
        whatever is needed for the only one, if all suspects lie on it."""
        last, earlier = suspects[-self.agreeing :], suspects[: -self.agreeing]
        self._stamps.heed_steps([suspect.device_ns for suspect in suspects])
        lines = self._borne_out(self.lines(last, self._low_before(earlier)), earlier)
        if unlikely and len(lines) == 1:
            line = lines[0]
            if self._misfit(line.moved_by, earlier) <= MISFIT_MOST * len(earlier):
                return [] if self._explains_nothing(line, suspects) else lines
        lines = [
            line
            for line in lines
            if line.cost <= LIKELY_COST_MAX or (unlikely and line.delay_change < 2 * self._half)
        ]
        return sorted(lines, key=lambda line: (line.cost, line.steps, line.delay_change))

    def _explains_nothing(self, line: Line, suspects: list[Suspect]) -> bool:
        """Return whether the clock would have been set by whole periods, and delays have changed by as much:
        stamps lie on SYNCs as well, and arrivals are what they are, without either."""
        moved = self._misfit(line.moved_by, suspects)
        return line.steps and line.others and self._misfit(0, suspects) <= moved + EXCLUDING

    def _low_before(self, earlier: list[Suspect]) -> int:
        """The smallest delay before a step: that of the first suspects, if several lie on SYNCs as the clock
        was and the others do not; no chance makes that of stamps that scatter little."""
        place, near_ns, delays = self._stamps.clock.place, self._stamps.near_ns, list[int]()
        for suspect in earlier:
            at = place(suspect.device_ns)
            if abs(self._miss(at)) > near_ns:
                shown = len(delays) >= SHOWN_MIN and 2 * self._half >= SCATTER_PARTS * near_ns
                return min(delays) if shown else self.delays.low
            if not suspect.second:
                delays.append(suspect.received_at - at)
        return self.delays.low

    def _borne_out(self, lines: list[Line], earlier: list[Suspect]) -> list[Line]:
        """Those of ``lines`` that ``earlier`` suspects bear out as well as any: a few readings, looked at
        again and again, lie on a wrong line by chance, all of them do not. Where the best one leaves most of
        them off, as those before a step are, they say nothing."""
        if len(lines) < 2 or not earlier:
            return lines
        misfits = [self._misfit(line.moved_by, earlier) for line in lines]
        if min(misfits) > MISFIT_MOST * len(earlier):
            return lines
        total = [line.misfit + misfit for line, misfit in zip(lines, misfits, strict=True)]
        most = min(total) + EXCLUDING
        return [line for line, misfit in zip(lines, total, strict=True) if misfit <= most]

    def _misfit(self, moved_by: int, suspects: list[Suspect]) -> float:
        """By how far suspects lie off a line on which all are later by ``moved_by``."""
        place, variance, misfit = self._stamps.clock.place, self._stamps.variance_ns2, 0.0
        for suspect in suspects:
            miss = self._miss(Instant(place(suspect.device_ns) + moved_by))
            misfit += min(miss * miss / variance, OUTLYING**2) / 2.0
        return misfit

    def lines(self, last: list[Suspect], low: int | None = None) -> list[Line]:
        """Every way to place the last suspects on SYNCs, all of them on one line, that is not so much less
        likely than another by how far they lie off it. ``low``: the smallest delay before them."""
        self._low = self.delays.low if low is None else low
        received_at = last[0].received_at
        match_ns, residuals = self._stamps.unmapped_ns, self._stamps.residuals
        scatter = residuals.variance_ns2(match_ns) > 0.0
        if scatter:
            match_ns = max(match_ns, min(match_ns + residuals.reach, round(2 * self._half * NEARER)))
        placements = []
        for mark in self._syncs.marks:
            on_bus_at = mark.on_bus_at
            if on_bus_at is not None and on_bus_at <= received_at - self._transit + match_ns:
                line = self._line(last, mark, match_ns)
                if line is not None:
                    placements.append(line)
        if all(line.steps for line in placements):
            placements += self._unmoved(last, match_ns)
        most = min((line.misfit for line in placements), default=0.0) + EXCLUDING
        if scatter:  # or else it is another rate that they show
            most = min(most, MISFIT_MOST * len(last))
        return [line for line in placements if line.misfit <= most]

    def _line(self, last: list[Suspect], first: SyncMark, match_ns: int) -> Line | None:
        """How they are placed if the first answers ``first``; None if they cannot be. ``match_ns``: how far a
        stamp may be off the SYNC that it answers: more than its own error only where stamps scatter. Then the
        line is the one in their middle, as neighbours may lie twice as far from one another.

        Readings that seemed to come twice just before may have been the first after a step by whole periods.
        """
        origin_at = first.on_bus_at
        assert origin_at is not None
        clock = self._stamps.clock
        unmoved_at = clock.place(last[0].device_ns)
        placed = [Instant(clock.place(suspect.device_ns) - unmoved_at + origin_at) for suspect in last]
        scatters = match_ns > self._stamps.unmapped_ns
        middle = median_low(self._miss(at) for at in placed) if scatters else 0
        steps = abs(unmoved_at - origin_at - middle) > match_ns + clock.error_ns
        marks: list[SyncMark | None] = []
        misses: list[int] = []
        used: set[int] = set()
        for suspect, at in zip(last, placed, strict=True):
            mark = self._syncs.nearest(Instant(at + middle))
            if mark is None or mark.on_bus_at is None:
                return None
            if self._syncs.may_lack(mark, Instant(at + middle)) or (marks and mark.sequence == SURPLUS):
                marks.append(None)
                continue
            if mark.number in used or mark.sequence == SURPLUS:
                return None
            miss = mark.on_bus_at - at
            delay = suspect.received_at - mark.on_bus_at
            if abs(miss - middle) > match_ns + DRIFT_WITHIN * self._half or delay < self._transit - match_ns:
                return None
            if self._is_anothers(mark, suspect):
                return None
            if not scatters:  # it may run at another rate
                middle = miss
            misses.append(miss)
            used.add(mark.number)
            marks.append(mark)
        if UNHEARD_PARTS * marks.count(None) > len(marks):
            return None
        smallest = min(suspect.received_at - at for suspect, at in zip(last, placed, strict=True))
        if scatters and self._comes_too_soon(smallest, misses):
            return None
        smallest -= middle if self._echoes_late else max(misses)
        mean = sum(misses) / len(misses)
        squares = sum((miss - mean) ** 2 for miss in misses) * len(last) / len(misses)
        misfit = squares / (2.0 * self._stamps.variance_ns2)
        if not steps and any(self._is_second(mark, stamp, last, marks) for mark, stamp in self.revoked):
            return None
        moved_by = origin_at - unmoved_at + round(mean)
        if steps and self.revoked and not self._agrees(used, moved_by):
            return None
        return self._costed(marks, smallest, steps, misfit, moved_by)

    def _comes_too_soon(self, smallest: int, misses: list[int]) -> bool:
        """Return whether a reading was sampled later than its frame takes before it came, by its stamp: at
        the instant that this tells, if the SYNC was not late to the drive whose stamp lies earliest, or whose
        echo was late by least, where echoes are."""
        stamps = self._stamps
        sampled = min(misses) if self._echoes_late else max(misses)
        return smallest - sampled < self._transit - stamps.unmapped_ns - stamps.resolution - stamps.hidden_ns

    def _is_second(
        self, answered: SyncMark, stamp: int, last: list[Suspect], marks: list[SyncMark | None]
    ) -> bool:
        """Return whether a SYNC that was ``answered`` with a stamp has another one on this way: no clock that
        runs on makes two of one SYNC."""
        return any(
            mark is not None
            and mark.number == answered.number
            and (suspect.device_ns != stamp or suspect.repeats)
            for suspect, mark in zip(last, marks, strict=True)
        )

    def _miss(self, at: Instant) -> int:
        """By how much the SYNC nearest to ``at`` is later."""
        mark = self._syncs.nearest(at)
        return 0 if mark is None or mark.on_bus_at is None else mark.on_bus_at - at

    def _unmoved(self, last: list[Suspect], match_ns: int) -> list[Line]:
        """The clock and the delays as they were, and one SYNC in :data:`RARE` that was late by more than any
        before; none if the suspects cannot be placed so."""
        clock, marks, delays = self._stamps.clock, list[SyncMark | None](), list[int]()
        near_ns, variance = match_ns + clock.error_ns, self._stamps.variance_ns2
        misfit, outlying = 0.0, 0
        for suspect in last:
            at = clock.place(suspect.device_ns)
            mark = self._syncs.nearest(at)
            if mark is None or mark.on_bus_at is None or mark in marks or mark.sequence == SURPLUS:
                return []
            off = abs(at - mark.on_bus_at)
            outlying += off > near_ns
            delays.append(suspect.received_at - mark.on_bus_at)
            if off > 2 * self._half * NEARER or delays[-1] < self._transit - match_ns:
                return []
            if self._is_anothers(mark, suspect):
                return []
            misfit += min(off * off / variance, OUTLYING**2) / 2.0
            marks.append(mark)
        if len(last) < RARE or outlying * RARE > len(last):
            return []
        line = self._costed(marks, min(delays), False, misfit, 0)
        return [] if line.unlikely else [line]

    def _costed(
        self, marks: list[SyncMark | None], smallest: int, steps: bool, misfit: float, moved_by: int
    ) -> Line:
        """The way that places suspects on ``marks`` with this smallest delay, and what it costs."""
        lost = self._lost_before(min(mark.number for mark in marks if mark is not None))
        if steps:
            cost = STEP_COST + min(max(0, lost - self.twice), LOSS_COST_MAX)
        else:
            cost = min(lost + self.twice, LOSS_COST_MAX)
        change = abs(smallest - self._low)
        others = change > self._half + self.delays.slack()
        return Line(cost + DELAY_COST * others, change, tuple(marks), steps, misfit, moved_by, others)

    def _agrees(self, used: set[int], moved_by: int) -> bool:
        """Return whether the readings before the suspects can be placed as well, if the clock was set among
        them.

        The stamps of those since then are later by ``moved_by``; no two may lie on one SYNC.
        """
        numbers = [mark.number for mark, _ in self.revoked]
        since = [
            -1 if (mark := self._syncs.nearest(Instant(at + moved_by))) is None else mark.number
            for at in (self._stamps.clock.place(stamp) for _, stamp in self.revoked)
        ]
        for split in range(len(numbers) + 1):
            placed = numbers[:split] + since[split:]
            taken = used.union(placed)
            if len(taken) == len(used) + len(placed) and not taken.intersection(self.stamps):
                return True
        return False
