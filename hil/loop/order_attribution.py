"""Which SYNC a reading without a stamp answers: by its usual delay, and by what is uneven in SYNCs."""

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NEVER, NS_PER_US, Duration, Instant
from servobench.hil.loop.attribution import HELD_MAX, Health, Question, Tell
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.kept_order import KeptOrder, PlacedInOrder
from servobench.hil.loop.order_memory import UNTIDY_FOR, Copies, SampleDelays, Strays, Unanswered, Unconfirmed
from servobench.hil.loop.order_question import ASK_AGAIN_AFTER, STRAYS_MAX, OrderQuestion
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.syncs import REMEMBERED, STAMPED_LATE, SURPLUS, SyncLog, SyncMark
from servobench.hil.loop.usual_delays import UsualDelays, middle_of


class OrderAttribution:
    """Places readings by how long they usually take.

        SYNC ends      1       2       3          4                 5
        readings         |r      |r                 |r       |s
        placed           1       2                  4        s, a stray: its delay is unusual

    A reading answers the SYNC that ended as long before it as usual. Where one is missing, it was lost, or
    the delay has grown; where several come at another phase, it is another. That is a *question*, answered by
    unevenness of SYNCs, by a *probe*, one that goes out late, or by delays that look as before.
    """

    def __init__(self, syncs: SyncLog, period: Duration, transit: Duration, tell: Tell, beats: Beats) -> None:
        self.health, self.question = Health(), Question()
        self._syncs, self._tell, self._beats = syncs, tell, beats
        self._period, self._transit = period, transit
        self._echo_error, self._delays = syncs.error_ns, SampleDelays(syncs, period, transit)
        self._kept_order = KeptOrder(syncs, period, transit)
        self._usual = UsualDelays(period, transit, syncs.error_ns, syncs.basis in STAMPED_LATE)
        self._in_question = OrderQuestion(syncs, period, transit, self._usual, beats)
        self._answered = self._known = 0  # numbers of the last SYNCs that have readings, and certain ones
        self._open, self.copies = Unanswered(syncs), Copies(syncs, period, transit)
        self._sure, self._beyond = True, False  # beyond: the question has had no answer so far
        self._unsure, self._strays = Unconfirmed(self.question, self._usual), Strays()
        self._held: tuple[int, Instant, int] | None = None  # a row, if the next reading is to show it
        self._untidy = self._copied = 0  # readings while frames may be held up; SYNC of the last, if a copy

    @property
    def wants_probe(self) -> bool:
        """True if the next SYNC is to go out a quarter of a period late."""
        return self._in_question.wants_probe

    @property
    def settled(self) -> bool:
        """True if it is known which SYNCs readings answer."""
        return self._sure and not self._beyond

    @property
    def shown_later(self) -> int:
        """Cycles until the next reading, which may have changed places with the last: delays of a period."""
        return 1 if self._usual.high > self._period else 0

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        self._beats.take(reading.status_told_at)
        if mark.on_bus_at is not None:
            delay = reading.received_at - mark.on_bus_at
            self._delays.add(delay)
            self._usual.add(delay)
            self._answered = self._known = mark.number

    def skip(self, reading: Reading) -> None:
        """Readings up to this one were let go of before the run, and are taken to answer the SYNC before."""
        mark = self._syncs.newest_before(Instant(reading.received_at - self._transit))
        if mark is not None:
            self._answered = self._known = max(self._known, mark.number)

    def probed(self, mark: SyncMark) -> None:
        """The SYNC of ``mark`` has gone out late."""
        self._in_question.probed(mark.number, ASK_AGAIN_AFTER if self._beyond else self._lags() + 1)

    def place(self, reading: Reading) -> Sample | None:
        self._beats.take(reading.status_told_at)
        copy, self.question.left_open = self.copies.holds(reading), False
        self._untidy -= self._untidy > 0
        again = copy and self.copies.told_by_stamps
        self.health.duplicates += again
        if surplus := copy and self._sure and self.copies.is_surplus(reading, self._open, self._answered):
            self._note_untidy(copy)
        return None if again or surplus else self._place(reading, copy)

    def _place(self, reading: Reading, copy: bool) -> Sample | None:
        received_at, usual = reading.received_at, self._usual
        mark = self._syncs.newest_before(Instant(received_at - usual.least))
        delay = 0 if mark is None or mark.on_bus_at is None else received_at - mark.on_bus_at
        usually = self._sure and usual.apart
        if usually and mark is not None and usual.holds(delay) and self._is_plain(mark):
            self._answered = self._known = mark.number
            return self._sample(reading, mark, certain=True)
        row = self._kept_order.take(reading, self._known, copy)
        if self._kept_order.leads and not usual.leads:
            return self._in_order(reading, row)
        if not usually:
            if (mark := self._followed(received_at)) is None:
                return self._stray(reading, copy)
        elif mark is None or not usual.holds(delay) or self._comes_sooner(mark, received_at, copy):
            return self._stray(reading, copy)
        self._strays.clear()
        if not self._sure:
            mark = self._weigh(mark, received_at)
        if mark.number <= self._answered:
            return self._find_twice(reading, mark, copy)
        if mark.number > self._answered + 1:
            self._pass_over(mark, received_at)
        elif self._held is not None:
            self.question.prove(*self._held)
            self.question.withdraw(mark.sequence)
            self.question.cleared = self._sure
        self._answered, self._held = mark.number, None
        self._known = mark.number if self._sure else self._known
        self.question.open = not (self._sure or self._beyond)
        if mark.sequence == SURPLUS:
            return self._guess(reading, None)
        delay = received_at - (mark.on_bus_at or 0)
        behind = self._open.may_be_taken_for(mark)
        self._in_question.take_copy(copy=(copy := copy and self._untidy > 0))
        final = copy or self._sure or self._beyond or self._syncs.may_hide(mark, received_at)
        if waits := not final and self._in_question.fits(delay, self._lags()):
            self._unsure.add((mark.sequence, received_at, self._error_of(delay)), delay, behind)
        is_next = 0 < self._copied == mark.number - 1  # it may be of the SYNC that a copy was placed at
        self._copied = mark.number if copy else 0
        certain = self._sure and not (copy or is_next or (behind and self._untidy > 0))
        return self._sample(reading, mark, certain=certain, waits=waits)

    def _is_plain(self, mark: SyncMark) -> bool:
        """Return whether a usual reading behind ``mark`` follows usual ones."""
        plain = not (self._untidy or self._strays) and mark.sequence != SURPLUS
        return plain and mark.number == self._answered + 1

    def _in_order(self, reading: Reading, row: PlacedInOrder | None) -> Sample | None:
        """Its place is ``row``, if the next ones say so."""
        if self._sure or self._beyond:
            self._in_question.phase_known = False
            self._ask(self._usual.middle)
            self._beyond = self._in_question.wants_probe = False
        for one in self._kept_order.proved:
            self._delays.take(one.delay)
            if one.heeded:
                self.question.prove(one.mark.sequence, one.received_at, self._error_of(one.delay))
        self.question.open = True
        if row is None or row.mark.sequence == SURPLUS:
            return self._guess(reading, None)
        if row.mark.number > self._answered:
            row.heeded, self._answered = True, row.mark.number
        return self._sample(reading, row.mark, certain=False, waits=True)

    def _followed(self, received_at: Instant) -> SyncMark | None:
        """The SYNC before a reading of the delay that is in question."""
        if self._sure:
            self._in_question.phase_known = False
            self._ask(self._usual.middle if self._usual.spread < self._period else self._usual.low)
        elif self._in_question.phase_known and not self._in_question.is_like(received_at, self._lags()):
            return None
        return self._mark(number) if (number := self._in_question.weigh(received_at)) else None

    def _pass_over(self, mark: SyncMark, received_at: Instant) -> None:
        """``mark`` has its reading; what of SYNCs between it and the last one that have none?"""
        if not (self._open.pass_over(self._answered, mark) and self._in_question.phase_known):
            return
        if self._beyond:
            self._in_question.miss(self._answered, mark.number)
        else:
            self._ask(self._usual.middle, mark.number)
            self._in_question.weigh(received_at)

    def _ask(self, age: int, number: int = 0) -> None:
        """Put the question which SYNCs readings answer that come ``age`` after one, from ``number`` on."""
        if self._sure:
            self._sure = False
            self._in_question.put()
        self._in_question.follow(age, self._answered, number)

    def _lags(self) -> int:
        """How many SYNCs a reading may answer: the one before, and others since the last certain one, or the
        oldest remembered where most were in doubt."""
        known = min(self._known, self._syncs.marks[0].number) if self._usual.doubted else self._known
        missing = self._open.since(known) + self._syncs.unheard_since(self._mark(known))
        return 1 + missing + self._in_question.odd

    def _weigh(self, mark: SyncMark, received_at: Instant) -> SyncMark:
        """The SYNC that a reading answers, if ``mark`` is the one before it."""
        question = self._in_question
        assert mark.on_bus_at is not None
        question.take(mark.number, received_at - mark.on_bus_at)
        lag = question.lag(self._lags(), beyond=self._beyond, untidy=self._untidy > 0)
        if lag is None:
            if before := question.settled_until():
                self._settle_until(before)
            question.want_probe(mark.number, beyond=self._beyond)
            if question.asked >= HELD_MAX and not self._beyond:
                self._give_up(mark.number)
            return mark
        self._settle(lag)
        if lag:
            mark, heard = self._syncs.before_place(mark.place - lag)
            self._answered = mark.number - heard
        return mark

    def _settle(self, lag: int) -> None:
        """Readings answer the SYNC before, or one ``lag`` earlier."""
        by_count = not self._beyond and self._in_question.counts(self._lags())
        if self._in_question.settled(self._answered, lag):
            delays = self._in_question.evidence.delays(lag)
            if self._usual.settle(delays, known=by_count):
                self._tell(f"its readings come {min(delays) / NS_PER_US:.0f} us after their SYNC now")
            self._delays.begin(delays)
            if by_count:
                self._unsure.confirm(NEVER, untidy=self._untidy > 0)
                self.question.cleared = True
            self._untidy = 0  # what seemed to be held up was of the new delay
        elif not self._beyond:
            self._untidy = UNTIDY_FOR if self._in_question.differed else self._untidy  # delays had not grown
            self._in_question.odd += self._untidy > 0 and self._unsure.behind
            self._unsure.confirm(NEVER, untidy=self._untidy > 0)
            self.question.cleared = self._in_question.odd == 0
            self.question.left_open = not self.question.cleared
        if self._beyond:
            self._tell("it is known again which SYNCs its readings answer")
        self._sure = self._in_question.phase_known = True
        self._beyond = self._in_question.wants_probe = False
        self._unsure.clear()

    def _settle_until(self, number: int) -> None:
        """Readings up to that of SYNC ``number`` answer the SYNC before; those since are in question yet."""
        self._known = max(self._known, number)
        self._unsure.confirm(self._mark(number).sequence, untidy=self._untidy > 0)
        self._beyond = False

    def _give_up(self, number: int) -> None:
        """Rows wait no longer for the answer; a probe looks again later."""
        self._unsure.clear()
        self._in_question.rest(number + ASK_AGAIN_AFTER)
        self._beyond = True
        why = "as their delays changed or spread and it has no stamp beside the speed"
        self._tell(f"it cannot be told which SYNCs its readings answer, {why}: they are marked uncertain")

    def _sample(self, reading: Reading, mark: SyncMark, *, certain: bool, waits: bool = False) -> Sample:
        """``waits``: the answer to a question will tell whether it is where it is placed."""
        health, on_bus_at = self.health, mark.on_bus_at
        assert on_bus_at is not None
        health.placed, delay = health.placed + 1, reading.received_at - on_bus_at
        error_ns = self._error_of(delay)
        certain = certain and not self._syncs.may_hide(mark, reading.received_at)
        if certain:
            self._delays.take(delay)
            self._usual.add(delay)
            health.error_ns_max = max(health.error_ns_max, error_ns)
            if delay < self._transit - self._echo_error:
                health.below_transit += 1
        if waits or not self._usual.tell(certain=certain):
            error_ns, certain = self._echo_error + reading.received_at - self._syncs.marks[0].handed_at, False
        return Sample(mark.sequence, reading, on_bus_at, error_ns, certain)

    def _error_of(self, delay: int) -> int:
        return self._delays.error_of(delay)

    def _stray(self, reading: Reading, copy: bool) -> Sample | None:
        """A reading of another delay than is usual, placed where a SYNC has none yet if there is one."""
        latest = Instant(reading.received_at - self._transit)
        mark = self._syncs.newest_before(latest)
        held, self._held = self._held, None
        if mark is None or mark.on_bus_at is None:
            self._note_untidy(copy)
            return self._guess(reading, self._open.take(latest))
        age = reading.received_at - mark.on_bus_at
        next_one = mark.number == self._answered + 1
        behind_unheard = mark.handed_at == mark.on_bus_at and age - self._transit >= self._period * 3 // 4
        if stamped_late := self._syncs.may_precede(latest, mark):
            self._doubt(self._syncs.marks[-1])
        alone = not (held or behind_unheard or stamped_late) and self._is_only_one(mark, copy)
        if next_one or not copy:
            self._strays.add(age, known=alone)
        if alone:
            self._answered = self._known = mark.number
            changed_places = len(self._strays) == 1 and self._may_be_of_before(reading.received_at, mark)
            if self._strays.are_known:
                self._usual.begin(self._strays.ages)
                self._strays.clear()
            return self._sample(reading, mark, certain=not changed_places)
        self._usual.stray(age, copy=copy)
        if next_one and self._in_question.phase_known and len(self._strays) < STRAYS_MAX:
            return self._count_in(reading, mark, age, behind_unheard or (copy and self._untidy > 0))
        if held is None and self._is_held(mark, age, copy):
            return self._hold(reading, mark)
        probing = self._in_question.is_before_probe(reading.received_at, self._answered, self._lags())
        copied = copy and self.copies.told_by_speeds
        if probing or (self._usual.nearly_holds(age) and not copied and mark.number > self._answered):
            self._in_question.odd += 1
        else:
            self._note_untidy(copy)
        if len(self._strays) >= STRAYS_MAX:
            self._in_question.phase_known = False
            self._in_question.odd = max(0, self._in_question.odd - STRAYS_MAX)
            self._ask(middle_of(self._strays.ages, self._period))
            self._in_question.weigh(reading.received_at)
            self._strays.clear()
        self._in_question.stray(reading.received_at, differs=probing)
        if mark.number > self._answered:
            self._pass_over(mark, reading.received_at)
            self._answered = mark.number
        else:
            self._doubt(mark)
            mark = self._open.take(latest) if probing else self._take_open(latest, copy)
        self.question.open = not (self._sure or self._beyond)
        return self._guess(reading, mark)

    def _count_in(self, reading: Reading, mark: SyncMark, age: int, copy: bool) -> Sample | None:
        """It is that of the next SYNC, of one that was passed over, or a ``copy``, which proves nothing."""
        self._answered = mark.number
        if not self._sure:
            self._in_question.weigh(reading.received_at)
            self._in_question.stray(reading.received_at)
        self._in_question.odd += (behind := self._open.may_be_taken_for(mark)) and not copy
        if not (self._sure or self._beyond or copy or self._may_be_of_before(reading.received_at, mark)):
            self._unsure.add((mark.sequence, reading.received_at, self._error_of(age)), age, behind)
        return self._guess(reading, mark)

    def _is_only_one(self, mark: SyncMark, copy: bool) -> bool:
        """Return whether all other SYNCs have their readings for certain, and this is none of those again."""
        copied = self._untidy and (copy or self.copies.before)
        if not self._sure or copied or mark.sequence == SURPLUS or not self._usual.apart:
            return False
        return mark.number == self._answered + 1 == self._known + 1 and not self._open.may_come(mark)

    def _comes_sooner(self, usual: SyncMark, received_at: Instant, copy: bool) -> bool:
        """True if a reading is that of a SYNC after the ``usual`` one, as this and all before have theirs."""
        if usual.number > self._answered or copy or self.copies.before:
            return False
        later = self._syncs.newest_before(Instant(received_at - self._transit))
        return later is not None and self._is_only_one(later, copy)

    def _may_be_of_before(self, at: Instant, mark: SyncMark) -> bool:
        """Return whether a stray behind ``mark`` may be of a SYNC before, as its delay from there is usual:
        then the reading that one has may be of ``mark``, or nobody's, and is in doubt as well."""
        own = self._syncs.newest_before(Instant(at - self._usual.least))
        if own is None or own.number >= mark.number or not self._usual.holds(at - (own.on_bus_at or 0)):
            return False
        self._doubt(own)
        return True

    def _is_held(self, mark: SyncMark, age: int, copy: bool) -> bool:
        """Return whether a reading is that of the SYNC before ``mark``: none comes as soon after its own."""
        if not self._sure or copy or mark.number != self._answered + 2 or age >= self._usual.least:
            return False
        others_lack = self._usual.nearly_holds(age) or self._open.may_come(mark)  # frames of other axes
        return not others_lack and self._mark(mark.number - 1).on_bus_at is not None

    def _hold(self, reading: Reading, mark: SyncMark) -> Sample | None:
        """It was held up. If the next one does not come, it may be one before, or that of ``mark``."""
        own, came_at = self._mark(mark.number - 1), reading.received_at
        self._doubt(mark)
        self._answered = own.number
        self._held = own.sequence, came_at, self._error_of(came_at - (own.on_bus_at or 0))
        self.question.open = True
        return self._guess(reading, own)

    def _mark(self, number: int) -> SyncMark:
        return self._syncs.marks[max(0, number - self._syncs.marks[0].number)]

    def _find_twice(self, reading: Reading, mark: SyncMark, copy: bool) -> Sample | None:
        """A SYNC has a second reading: one is a copy, or was held up, or delays are shorter."""
        if self._sure and not copy and self._in_question.sooner() > 0:
            self._ask(self._usual.middle)
        self._note_untidy(copy)
        self._doubt(mark)
        missing = self._take_open(Instant(reading.received_at - self._transit), copy)
        self.question.open = not (self._sure or self._beyond)
        return self._guess(reading, missing)

    def _take_open(self, latest: Instant, copy: bool) -> SyncMark | None:
        """The SYNC without a reading that one too many may answer. If it is the only one since a place was
        certain, none is missing, and no delay has grown; whose each is, one that is held up may hide."""
        mark, question = self._open.take(latest), self._in_question
        tells_nothing = self._sure or copy or question.may_be_others or self._usual.doubted
        if mark is not None and not tells_nothing and self._open.since(self._known) == 0:
            if not self._usual.narrow or question.strays_often:
                self._unsure.clear()
            self._settle(0)
        return mark

    def _note_untidy(self, copy: bool) -> None:
        """A frame seems to be held up, or to have come twice; in a question it may be one of a new delay."""
        self._in_question.odd += not copy
        self._untidy = UNTIDY_FOR

    def _guess(self, reading: Reading, mark: SyncMark | None) -> Sample | None:
        if mark is None or mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        return self._sample(reading, mark, certain=False)

    def _doubt(self, mark: SyncMark) -> None:
        """The reading that ``mark`` has may be another's."""
        self._unsure.drop(mark.sequence)
        self.question.doubt(mark.sequence, self._echo_error + REMEMBERED * self._period)
