"""Which SYNCs readings answer whose delay may have changed by whole periods, or to another phase.

SYNC ends      1       2       3       4 a probe, late
readings         |r              |r        |r            2 has none: lost, or all come a period later now
                                 lag 0     lag 0         the probe is followed at once: it was lost
"""

from typing import Final

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.attribution import HELD_MAX
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.order_evidence import WATCHED, OrderEvidence
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.loop.usual_delays import (
    ALIKE_MIN,
    RARE,
    TOO_SOON,
    Resemblance,
    UsualDelays,
    lag_to_resemble,
    readings_to_resemble,
)

ASK_AGAIN_AFTER: Final = 100
"""SYNCs from a question that had no answer until it is put again."""
STRAYS_MAX: Final = 4
"""Readings in a row with an unusual delay: so many are no frames that were held up."""
EVIDENCE_MIN: Final = 2
"""Readings that may tell, where the spread of delays is known;"""
EVIDENCE_UNUSUAL: Final = 6
"""where it is to be seen in themselves."""
PROBE_AFTER: Final = 3
"""Readings that may show by themselves which SYNCs they answer: an uneven host, or a watermark of ten times
what delays spread over, needs no more."""
PROBES_MAX: Final = 8
"""Probes of one question: each tells e^18 where delays are even, e^2 where they spread over half a period."""
PROBED_FOR: Final = 32
"""Readings of a question in which probes have gone out: what they leave open, the look of delays decides."""


MISSES_MAX: Final = 16
"""Readings that are missing in one question, each with the delays since; more count as one."""
LOSSES_MIN: Final = 4
"""Losses that say how often readings are lost."""
LOOKS: Final = 2
"""So many readings show a loss where all are lost and delays spread over a period. The least delay of n lies
within 4 / n of what they spread over of the least before, and one that grew by about whole periods as near by
chance alone; a network's delay grows less than once in 5000 readings: together 1 in 1000."""
LOOKS_MIN: Final = 3
WIDE_PARTS: Final = 8
"""Where delays spread over such a part of a period a reading may follow a probe by chance; hardly two do."""

OUTWEIGHED: Final = 6
"""So many readings that follow a probe, for each period that delays spread over, outweigh one that does not:
it is a quarter of a period late, which those alone show that come sooner then than usual."""

COPIES_MAX: Final = 2
"""SYNCs without a reading that copies of others may hide in one question: while a shaft stands still all
readings look like copies."""


class LossShare:
    """How many readings are lost, as questions have shown: the more, the fewer readings show another one."""

    def __init__(self, since: int = 0) -> None:
        """``since``: number of a SYNC."""
        self.lost = 0
        """Times that some were."""
        self._since = since
        self._runs: list[int] = []
        """How many at a time."""

    def add(self, run: int) -> None:
        """So many in a row were lost."""
        self.lost += 1
        self._runs.append(run)

    def readings_to_show(self, spread: int, period: Duration, number: int, run: int) -> int:
        """After so many that look as before, delays that spread over ``spread`` have not grown at SYNC
        ``number`` by ``run`` periods: what as many losses in a row, or more, are likelier than."""
        alike = sum(lost >= run for lost in self._runs)
        if alike < LOSSES_MIN:
            return HELD_MAX
        return max(LOOKS_MIN, LOOKS * spread * (number - self._since) // (alike * period))


class OrderQuestion:
    """Evidence for the lags with which readings may follow their SYNCs."""

    def __init__(
        self,
        syncs: SyncLog,
        period: Duration,
        transit: Duration,
        usual: UsualDelays,
        beats: Beats,
    ) -> None:
        """``usual``: the delays of readings whose place is certain."""
        self._beats = beats
        self.evidence = OrderEvidence(syncs, transit)
        self.phase_known = True
        """True if the delay is known, whole periods aside."""
        self.odd = 0
        """Readings since it was put that seem to be held up or copies: each may hide a lost one."""
        self.asked = 0
        """Readings since it was put."""
        self.wants_probe = False
        """True if the next SYNC is to go out a quarter of a period late."""
        self._syncs = syncs
        self._period = period
        self._soonest = transit - syncs.error_ns
        self._usual = usual
        self._shares = LossShare()
        self._misses: list[tuple[int, Resemblance]] = []
        """Where readings were missing since it was put: the number of the last SYNC answered before, and the
        delays since."""
        self._probes: list[int] = []
        """Numbers of those that have gone out for it."""
        self._next_probe = 0
        """Number of the first SYNC that may be a probe."""
        self._missing = 0
        """SYNCs that had not been heard by the last reading."""

    def take_copy(self, *, copy: bool) -> None:
        """A reading came; if it looks like a ``copy`` one may be lost."""
        self.odd += copy and self.odd < COPIES_MAX

    def put(self) -> None:
        """It begins."""
        self.asked = self.odd = self._next_probe = 0
        self._probes.clear()
        self._misses.clear()

    def follow(self, age: int, answered: int, number: int) -> None:
        """Weigh readings that come ``age`` after a SYNC, from here on; see :meth:`miss`."""
        self.miss(answered, number)
        self.evidence.begin(age)

    def weigh(self, received_at: Instant) -> int:
        """See :meth:`OrderEvidence.add`. A SYNC that was not heard breaks the count of those from which on
        another delay is reckoned: readings before it say nothing of those behind."""
        if self._missing != self._syncs.missing and not self.phase_known:
            self.evidence.restart()
        self._missing = self._syncs.missing
        for _, since in self._misses:
            since.until = min(since.until, received_at)
        return self.evidence.add(received_at)

    def miss(self, answered: int, number: int) -> None:
        """Readings are missing after that of SYNC ``answered``, before that of ``number``; 0: one may be."""
        run = max(1, number - answered - 1)
        if len(self._misses) == MISSES_MAX:
            answered, since = self._misses.pop()
            run = max(run, since.run)
        self._misses.append((answered, Resemblance(run, self._known_at(answered))))

    def _known_at(self, answered: int) -> Instant:
        """An instant before the reading of SYNC ``answered`` came."""
        marks = self._syncs.marks
        return marks[max(0, answered - marks[0].number)].handed_at

    def _comes_too_soon(self, delay: int) -> bool:
        """Return whether a reading of the SYNC before would have come sooner than its frame can."""
        return delay + self._syncs.late_most < self._soonest

    @property
    def may_be_others(self) -> bool:
        """True if readings may not answer the SYNC before them though only one is missing: they may be those
        of later ones, have come too soon for it, or be of a delay that has grown, as several strays may."""
        too_soon = any(since.too_soon >= TOO_SOON for _, since in self._misses)
        grown = self.odd > 1 and not self._usual.narrow
        return too_soon or grown or not self.phase_known or self.sooner() > 0

    @property
    def differed(self) -> bool:
        """True if readings came as those of grown delays would have, beside a probe."""
        return any(since.differed for _, since in self._misses)

    @property
    def strays_often(self) -> bool:
        """True if more readings than the last one, and than are rare, came at delays that are not usual."""
        return any(since.strays_often for _, since in self._misses)

    def settled(self, number: int, lag: int) -> bool:
        """The answer is ``lag``, up to SYNC ``number``; whether delays have changed, and nothing was lost."""
        if lag or not self.phase_known:
            self._shares = LossShare(number)
            return True
        for _, since in self._misses:
            self._shares.add(since.run)
        return False

    def stray(self, received_at: Instant, *, differs: bool = False) -> None:
        """A reading came that is not weighed. It ``differs`` from those that follow their probe, or does so
        as it comes behind a probe as late as delays have grown if none was lost."""
        marks = self._syncs.marks
        probes = [mark for mark in marks if mark.number in self._probes and mark.on_bus_at is not None]
        for answered, since in self._misses:
            since.stray()
            grown = since.run * self._period
            since.differed += differs or any(
                mark.number > answered and self._usual.holds(received_at - (mark.on_bus_at or 0) - grown)
                for mark in probes
            )

    def settled_until(self) -> int:
        """Number of the SYNC up to whose reading all are placed right though more have been missing since;
        0: of none. Delays that had grown at the first of them would be longer ever since."""
        shorter = self.odd > 0 and self.sooner() > 0
        if len(self._misses) < 2 or shorter or not self.phase_known:
            return 0
        if not self._looks_as_before(self._misses[0], self._misses[0][1].run):
            return 0
        self._shares.add(self._misses.pop(0)[1].run)
        answered, since = self._misses[0]
        self.asked = since.seen
        self._probes = [number for number in self._probes if number > answered]
        return answered

    def take(self, number: int, delay: int) -> None:
        """A reading came that is weighed, so long after SYNC ``number``."""
        self.asked += 1
        if self._comes_too_soon(delay):
            for _, since in self._misses:
                since.too_soon += 1
        if self._usual.holds(delay):
            for _, since in self._misses:
                since.add(delay)
            if number in self._probes:
                for miss in self._misses:
                    miss[1].followed += 1
        else:
            for _, since in self._misses:
                since.stray()
                since.differed += number in self._probes

    def probed(self, number: int, pause: int) -> None:
        """SYNC ``number`` has gone out late; none of the next ``pause`` is to."""
        self._probes.append(number)
        self._next_probe = number + pause
        self.wants_probe = False

    def rest(self, until: int) -> None:
        """No SYNC before number ``until`` is to be a probe."""
        self._next_probe = until
        self.wants_probe = False

    def is_probing(self, answered: int) -> bool:
        """Return whether the next SYNC behind number ``answered`` is a probe, or is to be one."""
        return self.wants_probe or (bool(self._probes) and self._probes[-1] > answered)

    def is_before_probe(self, received_at: Instant, answered: int, lags: int) -> bool:
        """Return whether a reading comes as it must in front of a probe, which is late, if delays have
        grown."""
        late = Instant(received_at - self._period)
        return self.phase_known and self.is_probing(answered) and self.is_like(late, lags)

    def want_probe(self, number: int, *, beyond: bool) -> None:
        """SYNC ``number`` has its reading; see :meth:`lag`."""
        ready = len(self.evidence) >= PROBE_AFTER and (beyond or len(self._probes) < PROBES_MAX)
        self.wants_probe = ready and number >= self._next_probe

    def is_like(self, received_at: Instant, lags: int) -> bool:
        """Return whether a reading has the usual delay from any of the SYNCs that it may answer, periods
        aside."""
        nearest = self._syncs.nearest(Instant(received_at - self._usual.middle))
        if nearest is None:
            return False
        least = -self.sooner()
        for mark in reversed(self._syncs.marks):
            lag = nearest.place - mark.place
            if lag >= lags:
                break
            if mark.on_bus_at is None or lag < least:
                continue
            if self._usual.holds(received_at - mark.on_bus_at - lag * self._period):
                return True
        return False

    def sooner(self) -> int:
        """By how many SYNCs a reading may be a later one's: no reading comes sooner than its frame can."""
        longest = max(self.evidence.delays(0), default=0)
        if self.phase_known:
            longest = max(longest, self._usual.high)
        return max(0, longest + self._syncs.late_most - self._soonest) // self._period

    def lag(self, lags: int, *, beyond: bool, untidy: bool) -> int | None:
        """With which readings follow their SYNCs, if it can be told: of ``lags``, 0, 1, ..., or below 0.

        ``beyond``: no row waits for the answer. ``untidy``: frames are held up now and then.
        """
        evidence, phase = self.evidence, self.phase_known
        untidy = untidy or (self.odd > 0 and len(evidence) < EVIDENCE_UNUSUAL)
        due = self.asked <= PROBE_AFTER or self.asked % (WATCHED // 4 if beyond else 2) == 0
        if not due or len(evidence) < (EVIDENCE_MIN if phase else EVIDENCE_UNUSUAL):
            return None
        if self.counts(lags) and evidence.delays(0):
            return 0
        lag = evidence.verdict(-self.sooner(), lags, self._usual.spread // 4 if phase else 0, untidy)
        follows = lag == 0 and phase and self._usual.apart and len(evidence) >= EVIDENCE_UNUSUAL
        if lag is None or not (follows or self._is_narrow(evidence.usual_delays(lag))):
            return self._lag_by_looks(lags)
        if lag and phase and self._is_usual(evidence.delays(0), 1 if untidy or not self._probes else 0):
            return self._lag_by_looks(lags) if self._misses[-1][1].is_as_wide(self._usual) else None
        return lag

    def counts(self, lags: int) -> bool:
        """Return whether readings of an unknown delay show by their number which SYNCs they answer: each SYNC
        has had one, in its own period, since the last of which that was certain. Had they grown by a period,
        one SYNC would be without. Delays that spread over a period do not keep to theirs."""
        usual = self._usual
        if lags > 1 or self.phase_known or usual.doubted or usual.spread >= self._period:
            return False
        return self.sooner() == 0

    def fits(self, delay: int, lags: int) -> bool:
        """Return whether the answer may confirm that a reading of such a delay answers the SYNC before."""
        return self._usual.holds(delay) or self.counts(lags)

    def _is_usual(self, weighed: list[int], others: int) -> bool:
        """Return whether all delays but so many ``others`` are as they were. Nothing excludes then that none
        changed: what holds up SYNCs may hold up readings behind them too, and another lag be more even. One
        that is none of a probe decides nothing: it may have come before another node's frame, for once."""
        return bool(weighed) and sum(not self._usual.holds(delay) for delay in weighed) <= others

    def _is_narrow(self, weighed: list[int]) -> bool:
        """Return whether delays that were weighed are none that are folded upon themselves by whole
        periods."""
        spread = max(weighed) - min(weighed)
        if self.phase_known:
            spread = max(spread, self._usual.spread)
        few = len(weighed) < EVIDENCE_UNUSUAL
        if not self._probes:  # which are later than echoes are
            spread *= self._usual.parts
        return spread <= self._period // (8 if few else 2)

    def _looks_as_before(self, miss: tuple[int, Resemblance], run: int) -> bool:
        """Return whether delays look as before since one of the readings that are missing, ``run`` in a
        row."""
        count = readings_to_resemble(self._usual.spread, self._period, self._alike_least)
        known = self._shares.readings_to_show(self._usual.spread, self._period, miss[0], run)
        if not (self._probes or known < HELD_MAX or self._periods_late(miss) == 0):
            return False
        count = min(count, known)
        return not self._speaks_against(miss) and miss[1].is_shown(
            self._usual, count, frames=self._shares.lost >= LOSSES_MIN
        )

    def _periods_late(self, miss: tuple[int, Resemblance]) -> int | None:
        """By how many periods the drive's timers are late since one of the readings that are missing."""
        return self._beats.periods_late(miss[1].since, miss[1].until, self._usual.spread)

    def _speaks_against(self, miss: tuple[int, Resemblance]) -> bool:
        """Return whether probes have gone out, and readings have not followed them, but for what is lost and
        what chance makes of delays that spread."""
        answered, since = miss
        few = 1 if WIDE_PARTS * self._usual.spread < self._period else 2
        probed = sum(number > answered for number in self._probes)
        weight = max(1, OUTWEIGHED * self._usual.spread // self._period)
        least = max(few, probed // 2, weight * since.differed)
        return bool(self._probes) and since.followed < least

    @property
    def _alike_least(self) -> int:
        return PROBED_FOR if self._probes else ALIKE_MIN

    def _lag_by_looks(self, lags: int) -> int | None:
        """The lag with which delays look as before, where SYNCs do not tell it."""
        miss = self._misses[-1]
        late = self._periods_late(miss)
        if late and self.phase_known and -self.sooner() <= late < lags and self.evidence.delays(late):
            return late if miss[1].is_shown(self._usual, LOOKS_MIN, frames=True) else None
        if self.phase_known:
            shorter = self.odd > 0 and self.sooner() > 0
            longest = max(since.run for _, since in self._misses)
            return 0 if not shorter and self._looks_as_before(miss, longest) else None
        if self._speaks_against(miss) or RARE * self.odd > self.asked:
            return None
        lag = lag_to_resemble(self.evidence.delays(0), self._usual, self._period, self._alike_least)
        return lag if lag is None or self.evidence.delays(lag) else None
