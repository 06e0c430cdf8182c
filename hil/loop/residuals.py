"""How far stamps lie from their SYNCs: what the clock's map leaves over, and what bounds are made from.

    residual  =  jitter of the SYNC at the drive  +  latency of the stamp  -  error of the echo  -  rounding

Each part is taken to be none now and then, so the residuals reach over the sum of the largest ones, and no
instant of sampling lies further from its SYNC than that. What stays
the same from SYNC to SYNC is in none of them: it cannot be told from the offset of the clock.

    residuals       |. : .. ::.: . .:|
    early  <---------------|---------------> late            beyond what map and stamp err by
"""

from bisect import insort
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from servobench.drivers.core.native import nearest

_round: Final = nearest
"""A module constant: found without a look-up where compiled."""
WATCHED: Final = 256
"""Values whose smallest and largest stand for the present."""
CHANGE_KEPT: Final = 0.97
"""Weight of the past in the mean change from one residual to the next: it forgets within some thirty."""
OUTLYING: Final = 4
"""Changes beyond so many times the mean one move neither that nor the map by more: a value that is evenly
spread reaches three times its mean change, so only rare ones are cut."""

FEW: Final = 8
"""Of values that something new has befallen, so many have been seen."""
GAPS: Final = 8
"""Beyond so many mean gaps a residual lies once in 3000 times, as long as they are spread evenly."""
CLUSTERED: Final = 32
"""The last so many show whether there are gaps in them."""
RARE: Final = 8
"""and what hardly one in so many reaches, to either side."""
CHANGING: Final = 3.0
"""Values that are spread evenly over a width change by a third of it on the average. Behind a calibration,
where the map itself errs by more, changes alone show that they scatter."""
RARELY_LATE: Final = 8.0
"""Deviation of values of which one in sixty reaches so many times further than the others."""


SLACKS: Final = 2
"""Where delays alone bound a sample: the smallest is not eight mean gaps above the least possible one in one
window of three thousand, if they are spread evenly."""
LEAST: Final = 16
"""How far so many of the smallest reach tells it too. Delays of several parts, a
SYNC that is late and a reading that is, are rare near their least: the smallest one lies further above it
than mean gaps say, and so do the next ones above the smallest. It lies further above than those reach in one
window of 30 000 if delays are spread evenly, in one of eighty if two parts alike are."""
HIDDEN_PARTS: Final = 16
"""Three idle bits behind a SYNC hide how late it was to the drive: less than a part of 48 bits or more."""


NEARER: Final = 7 / 16
"""Of a period: a stamp so far off its SYNC lies further from every other, by an eighth, as they jitter by.
Up to a quarter alone, a clock that was set again and again left certain rows wrong."""


class Extremes:
    """Smallest and largest of the last values."""

    def __init__(self) -> None:
        self.low = self.high = 0
        """0 before the first value."""
        self._low = self._high = self._count = self._seen = 0
        self._unknown = self._unknown_next = 0
        """By how much more than they reach over they may lie, as it is not known where."""

    @property
    def width(self) -> int:
        """How far they reach."""
        return self.high - self.low - self._unknown

    def add(self, value: int) -> None:
        if self._seen == 0:
            self.low = self.high = value
        if self._count == 0:
            self._low = self._high = value
        self._low, self._high = min(self._low, value), max(self._high, value)
        self.low, self.high = min(self.low, value), max(self.high, value)
        self._count += 1
        self._seen = min(self._seen + 1, WATCHED // 2)
        if self._count == WATCHED // 2:
            self.low, self.high, self._count = self._low, self._high, 0
            self._unknown, self._unknown_next = self._unknown_next, 0

    def begin(self, values: Sequence[int]) -> None:
        """Values are others from these on, and spread over no less than before."""
        spread = self.high - self.low
        self._count = self._seen = 0
        for value in values:
            self.add(value)
        self.high = self._high = max(self.high, self.low + spread)

    def spreads(self, over: int) -> bool:
        """Return whether they spread over so much or more."""
        return self.high - self.low >= over

    def widen(self, reach: int) -> None:
        """They reach over so much, and which way beyond the seen ones is not known."""
        lacks = self._unknown = self._unknown_next = max(0, reach - (self.high - self.low))
        self.low, self.high = self.low - lacks, self.high + lacks
        self._low, self._high = self._low - lacks, self._high + lacks

    def distrust(self) -> None:
        """The next values may be others: the last few alone count."""
        self._seen = min(self._seen, FEW)

    def slack(self) -> int:
        """How far beyond what was seen the next value may well lie.

        Of n values drawn evenly the smallest is an (n+1)-th of their spread above the least possible one on
        the average, and hardly ever four times that. At the end of a half only that half counts.
        """
        return 4 * (self.high - self.low) // max(self._seen, 1)


class DelayExtremes(Extremes):
    """The last delays of one drive's readings, and how far they lie above the least possible one."""

    def __init__(self) -> None:
        super().__init__()
        self._least: list[int] = []
        """The smallest of this half, in order, and of the one before."""
        self._reach = -1
        """From the smallest of them to the last of :data:`LEAST`; -1: to be found."""
        self._least_before: list[int] = []
        self._longer = 0
        """Delays in a row, see :meth:`stay_longer`."""

    def stay_longer(self, delay: int, by: int) -> bool:
        """Return whether this is the last of several in a row that are longer than the least by more than
        ``by``, and by more than most of what delays spread over."""
        most = self.low + max(by, (self.high - self.low) * 3 // 4)
        self._longer = self._longer + 1 if delay > most else 0
        return self._longer == FEW

    def add(self, value: int) -> None:
        if value < self.low and self._leaves(value):
            self.distrust()
        if self._count == 0:
            self._least_before, self._least, self._reach = self._least, [], -1
        least = self._least
        if len(least) < LEAST or value < least[-1]:
            self._reach = -1
            insort(least, value)
            if len(least) > LEAST:
                least.pop()
        super().add(value)

    def begin(self, values: Sequence[int]) -> None:
        self._least, self._least_before = [], []
        super().begin(values)

    def _leaves(self, delay: int) -> bool:
        """Return whether it is so much below the smallest that delays have become others."""
        return delay < self.low - self.unseen(0)

    def unseen(self, transit: int) -> int:
        """How far below the smallest of these delays, of frames that take ``transit``, others may lie."""
        if self._reach < 0:
            least = sorted([*self._least_before, *self._least])[:LEAST]
            self._reach = least[-1] - least[0] if least else 0
        return max(self._reach, SLACKS * self.slack()) + transit // HIDDEN_PARTS

    def late(self, delay: int, transit: int) -> int:
        """How much of ``delay`` may have passed before the drive sampled, if its frame takes ``transit`` or
        more."""
        off = max(0, delay - self.low)
        if self._leaves(delay):  # how far above the least one of now it lies is not known yet
            return max(off, delay - transit)
        return min(off + self.unseen(transit), max(off, delay - transit))


class Residuals:
    """The last residuals of one drive's stamps, ns."""

    def __init__(self, expected: float) -> None:
        """``expected``: the change from one to the next before any has been seen, ns."""
        self.early = self.late = 0
        """How far they reach to either side beyond what the map itself errs by."""
        self._extremes = Extremes()
        self._last = 0
        self.hidden = 0
        """What a SYNC may be late without the stamp telling, as the stamp waits for a tick of the drive."""
        self._recent: list[int] = []  # a ring once it is full
        self._count = 0
        self._expected = self.change_ns = expected
        """The mean change from one to the next."""

    def variance_ns2(self, unmapped_ns: int) -> float:
        """Of one of them; 0 where they neither reach nor change by more than stamps and echoes account for,
        which err by up to ``unmapped_ns`` to either side.

        By changes, as a map that lags moves neighbours alike: evenly spread values change by 1.2 times their
        deviation on the average. And by how far they reach, as much as late ones now and then make of it.
        """
        spread = self.early + self.late
        if spread or self.change_ns > unmapped_ns / CHANGING:
            return max(self.change_ns, spread / RARELY_LATE) ** 2
        return 0.0

    @property
    def least(self) -> int:
        """The least of them; 0 where they reach no further than the map itself errs by."""
        return self._extremes.low if self.early or self.late else 0

    @property
    def middle(self) -> int:
        """Half way between the least and the largest."""
        return (self._extremes.low + self._extremes.high) // 2

    @property
    def high(self) -> int:
        """The largest that the next may well be."""
        return self._extremes.high + self._slack()

    @property
    def spread(self) -> int:
        """How far they reach in all, and the next may well do, beyond what the map itself errs by."""
        return self.early + self.late + self.slack

    @property
    def reach(self) -> int:
        """From the least to the largest that the next may well be, all of it."""
        return self._extremes.high - self._extremes.low + 2 * self._slack()

    @property
    def width(self) -> int:
        """From the least to the largest."""
        return self._extremes.width

    @property
    def slack(self) -> int:
        """How far beyond the others the next may well lie."""
        return self._slack() if self.early or self.late else 0

    def _slack(self) -> int:
        """Twice what is usual: a bound has to hold from the first row to the last."""
        extremes = self._extremes
        return min(extremes.high - extremes.low, GAPS // 4 * extremes.slack())

    def lies_apart(self, residual: int, least_ns: int) -> bool:
        """Return whether it lies further from most of the last ones than these from one another, and than
        ``least_ns``; not where there are none to lie apart from."""
        if not self._recent:
            return False
        ordered = sorted(self._recent)
        rare = len(ordered) // RARE
        low, high = ordered[rare], ordered[-1 - rare]
        apart_ns = max(least_ns, high - low)
        return not low - apart_ns <= residual <= high + apart_ns

    def learn(self, residuals: Sequence[int], unseen_ns: int, *, anew: bool = True) -> None:
        """Take these for all that have been seen; see :meth:`add`. ``anew``: or else they lie about another
        line, and reach as far as others did before."""
        reached = 0 if anew else self._extremes.width
        self._extremes = Extremes()
        for residual in residuals:
            self.add(residual, unseen_ns)
        self._extremes.widen(reached)
        self._reach(unseen_ns)
        changes = [abs(later - earlier) for earlier, later in pairwise(residuals)]
        self.change_ns = max(self._expected, sum(changes) / max(1, len(changes)))

    def add(self, residual: int, unseen_ns: int) -> None:
        """The next one; ``unseen_ns``: what map and stamp err by in any case."""
        extremes, slack = self._extremes, self._slack() + unseen_ns
        if residual < extremes.low - slack or residual > extremes.high + slack:
            extremes.distrust()
        extremes.add(residual)
        if self._count < CLUSTERED:
            self._recent.append(residual)
        else:
            self._recent[self._count % CLUSTERED] = residual
        self._count += 1
        if self._count % (CLUSTERED // 4) == 0 and self.early + self.late:
            self._look_for_gap(unseen_ns)
        self._reach(unseen_ns)
        change = float(abs(residual - self._last))
        self._last = residual
        change = min(change, OUTLYING * self.change_ns + unseen_ns)
        self.change_ns = CHANGE_KEPT * self.change_ns + (1.0 - CHANGE_KEPT) * change

    def add_questioned(self, residual: int, unseen_ns: int, period: int) -> None:
        """That of a stamp that has put a question, if it is not as near to another SYNC."""
        if abs(residual) <= period * NEARER:
            self.add(residual, unseen_ns)

    def scatter(self, residuals: Sequence[int]) -> None:
        """Heed that several in a row have changed by more than before, not a single one."""
        changes = sorted(abs(later - earlier) for earlier, later in pairwise(residuals))
        if len(changes) >= FEW:
            self.change_ns = max(self.change_ns, float(changes[len(changes) // 2]))

    def _reach(self, unseen_ns: int) -> None:
        extremes = self._extremes
        self.early = max(0, -extremes.low - unseen_ns)
        self.late = max(0, extremes.high - unseen_ns)

    def _look_for_gap(self, unseen_ns: int) -> None:
        """Residuals of stamps that wait for a tick lie a tick apart, with nothing between. A single late SYNC
        lies apart, too, by chance."""
        ordered = sorted(self._recent)
        for place in range(2, len(ordered) - 1):
            gap = ordered[place] - ordered[place - 1]
            if gap > 4 * unseen_ns and 2 * gap > ordered[-1] - ordered[0]:
                self.hidden = max(self.hidden, gap)

    def cut(self, residual: int, unseen_ns: int) -> int:
        """``residual``, no further out than what one of many may well be."""
        if -unseen_ns <= residual <= unseen_ns:
            return residual
        most = _round(OUTLYING * self.change_ns) + unseen_ns
        return min(max(residual, -most), most)
