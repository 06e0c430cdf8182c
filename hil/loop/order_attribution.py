"""Which SYNC a reading without a stamp answers: by its usual delay, and by what is uneven in SYNCs."""

from typing import Final

from drivers.exchange import Reading
from drivers.timebase import NS_PER_US, Duration, Instant
from hil.loop.attribution import HELD_MAX, Health, Question, Tell
from hil.loop.order_evidence import WATCHED, OrderEvidence
from hil.loop.residuals import Extremes
from hil.loop.samples import Sample
from hil.loop.syncs import REMEMBERED, STAMPED_LATE, SURPLUS, SyncLog, SyncMark

SLACKS: Final = 2
"""Nothing else bounds a sample without a stamp: the smallest delay is not eight mean gaps above the least
possible one in one window of three thousand."""
EVIDENCE_MIN: Final = 2
"""Readings that may tell, where the spread of delays is known;"""
EVIDENCE_UNUSUAL: Final = 6
"""where it is to be seen in themselves."""
HIDDEN_PARTS: Final = 16
"""Three idle bits behind a SYNC hide how late it was to the drive: less than a part of 48 bits or more."""
PROBE_AFTER: Final = 3
"""Readings that may show by themselves which SYNCs they answer: an uneven host, or a watermark of ten times
what delays spread over, needs no more."""
PROBES_MAX: Final = 8
"""Probes of one question: each tells e^18 where delays are even, e^2 where they spread over half a period."""
ASK_AGAIN_AFTER: Final = 100
"""SYNCs from a question that had no answer until it is put again."""
WITHOUT_PROBE: Final = 12
"""Readings of a question by which a probe would have gone out: where none can, none is waited for."""
USUAL_PARTS: Final = 32
"""A delay within such a part of a period of those before is usual: where SYNCs tell nothing, one in
sixteen of the delays to which a network may change is taken for the old one, if readings are missing then."""
STRAYS_MAX: Final = 4
"""Readings in a row with an unusual delay: so many are no frames that were held up."""
UNTIDY_FOR: Final = 1000
"""Readings for which frames are expected to come twice or be held up once more."""
DOUBLES: Final = 2
"""SYNCs without a reading that copies of others may hide in one question."""
OPEN_FOR: Final = 10
"""SYNCs after which one that was passed over will have no reading any more: networks hold frames for less."""
HELD_UP: Final = 4
"""SYNCs after which a frame that was held up comes at the latest, and may be taken for that of another."""
COPIES: Final = 8
"""The last readings, of which another may be a copy."""


class OrderAttribution:
    """Places readings by how long they usually take.

        SYNC ends      1       2       3          4                 5
        readings         |r      |r                 |r       |s
        placed           1       2                  4        s, a stray: its delay is unusual

    A reading answers the SYNC that ended as long before it as those of the last readings did, over whole
    periods too: the calibration has taught the delay. Where one is missing, it was lost, or the delay has
    grown by whole periods; where several in a row come at another phase, the delay is another. Which SYNCs
    they answer is then a *question*, and readings are uncertain. What is uneven in the SYNCs answers it
    (:mod:`hil.loop.order_evidence`): a host that wakes late, a watermark, the jitter of another's SYNCs, and
    where that does not suffice by a *probe*, a SYNC that goes out a quarter of a period late. Where none can,
    the delay is taken for what it was if it looks so.

    What the SYNC took behind its echo, and what the echo was stamped late, is part of the delay. So a sample
    lies no further behind its SYNC than its delay exceeds the smallest of the last ones, and no further
    before it than its delay is below the largest.
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
        self._echo_error = syncs.error_ns
        self._echoes_late = syncs.basis in STAMPED_LATE
        self._delays = Extremes()
        """Of readings whose place is certain."""
        self._answered = 0
        """Number of the last SYNC that has its reading."""
        self._known = 0
        """The same of readings whose place was certain."""
        self._open: list[int] = []
        """Numbers of SYNCs that were passed over, the oldest first."""
        self._sure = True
        self._usual = True
        """Whether the delay is known, whole periods aside."""
        self._odd = 0
        """Readings since the question was put that seem to be held up or copies: each may hide a lost one."""
        self._beyond = False
        """Whether the question has had no answer so far."""
        self._evidence = OrderEvidence(syncs)
        self._asked = 0
        """Readings since the question was put."""
        self._probes = 0
        self._next_probe = 0
        """Number of the first SYNC that may be a probe."""
        self._unsure: list[tuple[int, int]] = []
        """Cycles whose readings wait for the answer, and the bounds of their samples if it confirms them."""
        self._strays: list[int] = []
        """Of those in a row, how long they came after the SYNC before them."""
        self._untidy = 0
        """Readings for which frames are still expected to come twice or be held up."""
        self._speeds: list[float] = []
        """Of the last readings since then."""

    @property
    def settled(self) -> bool:
        """Whether it is known which SYNCs readings answer."""
        return self._sure and not self._beyond

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        if mark.on_bus_at is not None:
            self._delays.add(reading.received_at - mark.on_bus_at)
            self._answered = self._known = mark.number

    def skip(self, reading: Reading) -> None:
        """Readings up to this one were let go of before the run, and are taken to answer the SYNC before."""
        mark = self._syncs.newest_before(Instant(reading.received_at - self._transit))
        if mark is not None:
            self._answered = self._known = max(self._known, mark.number)

    def probed(self, mark: SyncMark) -> None:
        """The SYNC of ``mark`` has gone out late."""
        self._probes += 1
        self._next_probe = mark.number + (ASK_AGAIN_AFTER if self._beyond else self._lags() + 1)
        self.wants_probe = False

    def place(self, reading: Reading) -> Sample | None:
        received_at = reading.received_at
        copied = self._untidy > 0 and self._is_copy(reading)
        if self._sure and self._margin < 0:
            self._usual = False
            self._ask(self._delays.low)
        mark = self._expected(received_at) if self._sure else self._followed(received_at)
        if mark is None:
            return self._stray(reading)
        if self._strays:
            self._strays.clear()
        if not self._sure:
            mark = self._weigh(mark)
        if mark.number <= self._answered:
            return self._find_twice(reading, mark)
        if self._pass_over(mark) and not self._sure:
            self._evidence.add(received_at)
        if self._sure:
            self._known = mark.number
        self.question.open = not (self._sure or self._beyond)
        if mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        assert mark.on_bus_at is not None
        delay = received_at - mark.on_bus_at
        if not self._sure and not self._beyond and self._is_usual(delay):
            self._unsure.append((mark.sequence, self._error_of(delay)))
        hidden = copied or self._may_be_held(mark) or self._syncs.may_hide(mark, received_at)
        return self._sample(reading, mark, certain=self._sure and not hidden)

    def _expected(self, received_at: Instant) -> SyncMark | None:
        """The SYNC that a reading answers with a usual delay."""
        mark = self._syncs.newest_before(Instant(received_at - self._delays.low + self._margin))
        if mark is None or mark.on_bus_at is None or not self._is_usual(received_at - mark.on_bus_at):
            return None
        return mark

    @property
    def _margin(self) -> int:
        """How far beyond the others a usual delay may lie; below 0: they spread over more than a period."""
        delays = self._delays
        spread = delays.high - delays.low
        free = self._period - (2 * spread if self._echoes_late else spread)
        return min(max(SLACKS * delays.slack() + self._echo_error, self._period // USUAL_PARTS), free // 3)

    def _is_usual(self, delay: int) -> bool:
        margin, delays = self._margin, self._delays
        return self._usual and delays.low - margin <= delay <= delays.high + margin

    def _followed(self, received_at: Instant) -> SyncMark | None:
        """The SYNC before a reading of the delay that is in question."""
        number = self._evidence.add(received_at)
        marks = self._syncs.marks
        return marks[number - marks[0].number] if number else None

    def _pass_over(self, mark: SyncMark) -> bool:
        """``mark`` has its reading; whether SYNCs between it and the last one have none."""
        marks = self._syncs.marks
        first = marks[0].number
        missing = [
            number
            for number in range(max(first, self._answered + 1), mark.number)
            if marks[number - first].on_bus_at is not None
        ]
        self._answered = mark.number
        if not missing:
            return False
        self._open = [*self._open, *missing][-REMEMBERED:]
        if self._usual and not self._beyond:
            self._ask((self._delays.low + self._delays.high) // 2)
        return True

    def _ask(self, age: int) -> None:
        """Put the question which SYNCs readings answer that come ``age`` after one."""
        if self._sure:
            self._asked = self._probes = self._next_probe = 0
            self._sure, self._odd = False, DOUBLES if self._untidy else 0
        self._evidence.begin(age)

    def _lags(self) -> int:
        """Of so many SYNCs one reading may be: the one before it, and those since the last certain one that
        have none."""
        missing = len(self._open)
        while missing and self._open[-missing] <= self._known:
            missing -= 1
        return 1 + missing + self._odd

    def _weigh(self, mark: SyncMark) -> SyncMark:
        """The SYNC that a reading answers, if ``mark`` is the one before it."""
        evidence, usual = self._evidence, self._usual
        self._asked += 1
        lag: int | None = None
        due = self._asked <= PROBE_AFTER or self._asked % (WATCHED // 2 if self._beyond else 2) == 0
        if due and len(evidence) >= (EVIDENCE_MIN if usual else EVIDENCE_UNUSUAL):
            delays = self._delays
            lag = evidence.verdict(self._lags(), (delays.high - delays.low) // 4 if usual else 0)
            if lag is not None:
                lag = lag if self._is_narrow(evidence.usual_delays(lag)) else None
        if lag is None and usual and self._probes == 0 and self._asked >= WITHOUT_PROBE:
            spread = self._delays.high - self._delays.low
            if USUAL_PARTS * spread < self._period and all(map(self._is_usual, evidence.delays(0))):
                lag = 0
        if lag is None:
            ready = len(evidence) >= PROBE_AFTER and (self._beyond or self._probes < PROBES_MAX)
            self.wants_probe = ready and mark.number >= self._next_probe
            if self._asked >= HELD_MAX and not self._beyond:
                self._give_up(mark.number)
            return mark
        self._settle(lag)
        marks = self._syncs.marks
        answered = marks[max(0, mark.number - lag - marks[0].number)]
        if lag:
            self._answered = answered.number - 1
        return answered

    def _is_narrow(self, weighed: list[int]) -> bool:
        """Whether delays that were weighed are none that are folded upon themselves by whole periods."""
        spread = max(weighed) - min(weighed)
        if self._usual:
            spread = max(spread, self._delays.high - self._delays.low)
        few = len(weighed) < EVIDENCE_UNUSUAL
        return spread <= self._period // (8 if few else 2)

    def _settle(self, lag: int) -> None:
        """Readings answer the SYNC before, or one ``lag`` earlier."""
        if lag or not self._usual:
            self._delays = Extremes()
            for delay in self._evidence.usual_delays(lag):
                self._delays.add(delay)
            self._untidy = 0  # what seemed to be held up was of the new delay
            self._tell(f"its readings come {self._delays.low / NS_PER_US:.0f} us after their SYNC now")
        elif not self._beyond:
            for sequence, error_ns in self._unsure:
                self.question.amend(sequence, True, error_ns)
            self.question.cleared = self._odd == 0
        if self._beyond:
            self._tell("it is known again which SYNCs its readings answer")
        self._sure = self._usual = True
        self._beyond = self.wants_probe = False
        self._unsure.clear()

    def _give_up(self, number: int) -> None:
        """Rows wait no longer for the answer; a probe looks again later."""
        self._unsure.clear()
        self._next_probe = number + ASK_AGAIN_AFTER
        self.wants_probe = False
        self._beyond = True
        self._tell(
            "it cannot be told which SYNCs its readings answer, as their delays changed or spread and"
            " it has no stamp beside the speed: they are marked uncertain"
        )

    def _sample(self, reading: Reading, mark: SyncMark, *, certain: bool) -> Sample:
        health, on_bus_at = self.health, mark.on_bus_at
        assert on_bus_at is not None
        health.placed += 1
        delay = reading.received_at - on_bus_at
        error_ns = self._error_of(delay)
        if certain:
            self._delays.add(delay)
            health.error_ns_max = max(health.error_ns_max, error_ns)
            if delay < self._transit - self._echo_error:
                health.below_transit += 1
        else:
            error_ns = self._echo_error + reading.received_at - self._oldest_at()
        return Sample(mark.sequence, reading, on_bus_at, error_ns, certain)

    def _error_of(self, delay: int) -> int:
        """How far the sample of a reading may lie from its SYNC."""
        delays = self._delays
        off = max(0, delay - delays.low)
        if self._echoes_late:
            off = max(off, delays.high - delay)
        off_most = off + SLACKS * delays.slack() + self._transit // HIDDEN_PARTS
        return self._echo_error + min(off_most, max(off, delay - self._transit))

    def _oldest_at(self) -> Instant:
        """No SYNC that is remembered ended before."""
        first = self._syncs.marks[0]
        return first.handed_at if first.on_bus_at is None else first.on_bus_at

    # ---- frames that are held up, or come twice -----------------------------------------------------------

    def _stray(self, reading: Reading) -> Sample | None:
        """A reading of another delay than is usual, placed where a SYNC has none yet if there is one."""
        latest = Instant(reading.received_at - self._transit)
        mark = self._syncs.newest_before(latest)
        if mark is not None and self._is_only_one(mark):
            self._answered = self._known = mark.number
            return self._sample(reading, mark, certain=not self._syncs.may_hide(mark, reading.received_at))
        self._note_untidy()
        if mark is not None and mark.on_bus_at is not None:
            self._strays.append(reading.received_at - mark.on_bus_at)
            if len(self._strays) == STRAYS_MAX:
                self._usual = False
                self._odd = max(0, self._odd - STRAYS_MAX)
                self._ask(self._middle(self._strays))
                self._evidence.add(reading.received_at)
                self._strays.clear()
        if mark is not None and mark.number > self._answered:
            self._pass_over(mark)
        else:
            if mark is not None:
                self._doubt(mark)
            mark = self._take_open(latest)
        self.question.open = not (self._sure or self._beyond)
        return self._guess(reading, mark)

    def _middle(self, ages: list[int]) -> int:
        """Of ages, whole periods aside."""
        half, period = self._period // 2, self._period
        off = [(age - ages[0] + half) % period - half for age in ages]
        return ages[0] + (min(off) + max(off)) // 2

    def _is_only_one(self, mark: SyncMark) -> bool:
        """Whether all other SYNCs have their readings, and none came twice lately."""
        if not self._sure or self._untidy or mark.sequence == SURPLUS or self._margin < 0:
            return False
        return mark.number == self._answered + 1 and not self._is_open_within(OPEN_FOR, mark)

    def _may_be_held(self, mark: SyncMark) -> bool:
        """Whether the reading at ``mark`` may be that of one before, which was held up by whole periods."""
        return self._untidy > 0 and self._is_open_within(HELD_UP, mark)

    def _is_open_within(self, syncs: int, mark: SyncMark) -> bool:
        """Whether one of the last ``syncs`` before ``mark`` has no reading."""
        return bool(self._open) and 0 < mark.number - self._open[-1] <= syncs

    def _take_open(self, latest: Instant) -> SyncMark | None:
        """The newest SYNC that was passed over, and had ended by ``latest``."""
        marks = self._syncs.marks
        first = marks[0].number
        for number in reversed(self._open):
            mark = marks[number - first] if number >= first else None
            if mark is not None and mark.on_bus_at is not None and mark.on_bus_at <= latest:
                self._open.remove(number)
                return mark
        return None

    def _find_twice(self, reading: Reading, mark: SyncMark) -> Sample | None:
        """A SYNC has a second reading: either may be a copy, or one that was held up."""
        self._note_untidy()
        self._doubt(mark)
        return self._guess(reading, self._take_open(Instant(reading.received_at - self._transit)))

    def _note_untidy(self) -> None:
        """A frame seems to be held up, or to have come twice; in a question it may be one of a new delay."""
        self._odd += 1
        if self._sure:
            self._untidy = UNTIDY_FOR

    def _guess(self, reading: Reading, mark: SyncMark | None) -> Sample | None:
        if mark is None or mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        return self._sample(reading, mark, certain=False)

    def _doubt(self, mark: SyncMark) -> None:
        """The reading that ``mark`` has may be another's."""
        self._unsure = [unsure for unsure in self._unsure if unsure[0] != mark.sequence]
        self.question.amend(mark.sequence, False, self._echo_error + REMEMBERED * self._period)

    def _is_copy(self, reading: Reading) -> bool:
        """Whether it may be one of the last readings again."""
        self._untidy -= 1
        copied = reading.velocity_rad_s in self._speeds
        self._speeds = [*self._speeds[1 - COPIES :], reading.velocity_rad_s]
        return copied
