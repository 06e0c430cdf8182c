"""How long readings usually take: where most of the last delays lie, without the few that were held up.

    delays        . ::.::|:.      .               .          the last two are outliers
    usual         |-------|                                  least ... most, with a margin to either side

A network holds a frame now and then by far more than the others. What is usual must not grow by those: a
band as wide as the period says nothing of the SYNC that a reading answers.
"""

from collections.abc import Sequence
from typing import Final

from servobench.drivers.timebase import NEVER, NS_PER_US, Duration, Instant

KEPT: Final = 64
"""The last delays: as many as readings wait for an answer."""
LOOKED_AT_EVERY: Final = 16
"""Delays from one look at all of them to the next: it costs some 10 us."""
RARE: Final = 8
"""One of so many may be an outlier: a network that holds up more of its frames has no usual delay."""
GAPS: Final = 8
"""A delay is none of the others beyond so many mean gaps of theirs: e^-8 for delays spread evenly."""
SLACKS: Final = 4
"""How many mean gaps beyond the others the next delay may well lie."""
USUAL_PARTS: Final = 32
"""A delay within such a part of a period of the others is usual in any case."""
TAIL_PARTS: Final = 4
"""By such a part of their spread the next delay may well be off: not all spread evenly."""
RESOLUTION_NS: Final = 2 * NS_PER_US
"""Deviation that delays have at least: the stuff bits of one frame or two."""
FREE_PARTS: Final = 4
"""Where delays reach to within such a part of a period, others are longer than it: a calibration, which takes
readings for those of the SYNC before, cannot know."""
FIRST: Final = 32
"""Readings of a run until they say how far delays spread: a calibration's are of a bus without commands, and
of a shaft at rest."""
STUFFED_PARTS: Final = 5
"""Stuff bits make a frame longer by up to such a part: 24 bits beside the 111 of one with eight bytes. Zeros
have most of them, so that the least delay is less once a shaft turns."""
ALIKE_MIN: Final = 12
"""Readings after which delays that look as before are those of before: a probe is out by then."""
ALIKE_PER_PERIOD: Final = 256
"""The same of delays that spread over a period, as far as rows wait: so many show their least one to a 64th
of a period, and one in 32 of the delays to which a network may change looks like the old one."""
TOO_SOON: Final = 2
"""Readings that would have come too soon for the SYNC before: a frame that is held up into just that gap is
rare, and all are that are shorter than the least delay where they have grown by less than whole periods."""
SLIGHT_PARTS: Final = 8
"""By less than such a part of a period a reading is off that came behind other nodes' frames, or before."""
ALIKE_PARTS: Final = 16
"""Of a period, such a part is the most by which the least delay may differ where delays are rare near it."""
ALIKE_MOST: Final = 56
"""Most readings that are asked for: rows wait for 64, and some of those may be outliers."""


class UsualDelays:
    """The delays of the last readings whose place is certain."""

    def __init__(self, period: Duration, transit: Duration, echo_error: int, echoes_late: bool) -> None:
        """``transit``: of the shortest frame. ``echoes_late``: echoes may be stamped any time after the end
        of their frames."""
        self.low = self.high = 0
        """Least and greatest of those delays that are no outliers."""
        self.least = self.most = 0
        """From when to when a delay is usual."""
        self.apart = True
        """True if a usual delay is one of one SYNC only: they spread over less than a period."""
        self._period = period
        self._transit = transit
        self._stuffing = transit // STUFFED_PARTS
        self._echo_error = echo_error
        self.parts = 2 if echoes_late else 1
        """So many times what they spread over SYNCs and readings may move against each other."""
        self._kept: list[int] = []
        self._rare = 0
        """How far the least of them reach that are no outliers, :data:`SLACKS` of them."""
        self._oldest = 0
        self._fresh = 0
        self._unsure = 0.0
        """Share of the last readings whose place was not certain."""
        self._unusual = 0.0
        """Share of the last readings that came at an unusual delay."""
        self._told = 0
        """Readings that this share rests on, up to :data:`KEPT`."""
        self._placed = 0
        """Readings of the run whose place was certain, up to :data:`FIRST`."""

    @property
    def spread(self) -> int:
        return self.high - self.low

    @property
    def _may_be_all(self) -> bool:
        """True if delays leave a part of the period free, so that none is longer than it."""
        return FREE_PARTS * self.parts * self.spread <= (FREE_PARTS - 1) * self._period

    @property
    def _others_are_rare(self) -> bool:
        """True if few of the last readings came at another delay."""
        return RARE * self._unusual <= 1.0

    @property
    def leads(self) -> bool:
        """True if most of the last readings had a usual delay that is one of one SYNC only."""
        return self.apart and self._others_are_rare

    @property
    def doubted(self) -> bool:
        """Return whether the place of most of the last readings was in doubt."""
        return 2.0 * self._unsure >= 1.0

    @property
    def narrow(self) -> bool:
        """True if one of another delay hardly looks usual: they spread over half a period at the most."""
        return 2 * self.parts * self.spread <= self._period

    @property
    def resolution_ns(self) -> int:
        """By how much the least delay may differ though nothing has changed."""
        return RESOLUTION_NS if self._placed >= FIRST else max(RESOLUTION_NS, self._stuffing)

    def tolerance(self, spread: int, count: int) -> int:
        """How far the least of ``count`` delays may well lie from the least of those before, ns: both are
        chance, and where delays are rare near their least, as those of several parts, they show it."""
        few = max(1, min(count, len(self._kept)))
        rare = min(self._rare, self._period // ALIKE_PARTS)
        return max(self.resolution_ns, SLACKS * spread // few, rare)

    def tell(self, *, certain: bool) -> bool:
        """Return whether the place of a reading, ``certain`` by what is usual, may be told so: not where most
        of the last ones were in doubt, and one that is held up may well look usual; nor where so many came at
        other delays that none is usual, or a calibration may have taken longer ones for shorter."""
        self._unsure += (1.0 - certain - self._unsure) / KEPT
        self._told += self._told < KEPT
        self._unusual -= self._unusual / (RARE + self._told)
        self._placed += certain and self._placed < FIRST
        known = self._others_are_rare and (self._placed >= FIRST or self._may_be_all)
        return certain and known and (self.narrow or not self.doubted)

    def stray(self, delay: int, *, copy: bool) -> None:
        """A reading came at an unusual delay, a ``copy`` of another perhaps."""
        others_lack = self.narrow and self.nearly_holds(delay)  # frames that usually come in front of it
        self._unusual += (not (copy or others_lack)) / (RARE + self._told)

    def nearly_holds(self, delay: int) -> bool:
        """Return whether one is usual but for frames of others: no sign of frames held up until another's
        turn."""
        beyond = self._period // SLIGHT_PARTS
        return self.least - beyond <= delay <= self.most + beyond

    def begins_at(self, low: int, count: int, *, frames: bool) -> bool:
        """Return whether the least of ``count`` delays is that of those before; ``frames``: or would be if as
        many frames of other axes as there are had not come in front of it, or one or two more."""
        off = abs(low - self.low)
        if off <= self.tolerance(self.spread, count):
            return True
        return frames and any(
            off - times * self._transit in range(times * self._stuffing) for times in (1, 2)
        )

    def are_within(self, low: int, spread: int, tolerance: int) -> bool:
        """Return whether delays from ``low`` over ``spread`` hold the usual ones, and none below the least of
        them.

        Delays that grew by a little less than whole periods would show some.
        """
        if low + tolerance < self.low:
            return False
        return low <= self.low + tolerance and low + spread >= self.high - tolerance

    @property
    def middle(self) -> int:
        return (self.low + self.high) // 2

    def begin(self, delays: Sequence[int]) -> None:
        """Forget all; these are usual now."""
        self._kept = list(delays[-KEPT:])
        self._oldest = self._told = 0
        self._unsure = self._unusual = 0.0
        self._look()

    def settle(self, delays: Sequence[int], *, known: bool) -> bool:
        """Some whose place is now known are usual; whether they are others than before. ``known``: each SYNC
        had its reading, so those that spread too far to tell are what they were."""
        if known and not self.apart:
            for delay in delays:
                self.add(delay)
            return False
        self.begin(delays)
        return True

    def add(self, delay: int) -> None:
        kept = self._kept
        if len(kept) < KEPT:
            kept.append(delay)
        else:
            kept[self._oldest] = delay
            self._oldest = (self._oldest + 1) % KEPT
        self._fresh += 1
        if self._fresh >= LOOKED_AT_EVERY or len(kept) < LOOKED_AT_EVERY:
            self._look()
        elif not self.low <= delay <= self.high and self.least <= delay <= self.most:
            self.low, self.high = min(self.low, delay), max(self.high, delay)
            self._set_limits()

    def saw(self, delay: int) -> bool:
        """Return whether it is no longer than others, nor shorter, but for stuff bits and chance."""
        beyond = max(self._stuffing, SLACKS * self.spread // max(1, len(self._kept)))
        return self.low - beyond <= delay <= self.high + beyond

    def holds(self, delay: int) -> bool:
        """Return whether a delay is usual."""
        return self.least <= delay <= self.most

    def _look(self) -> None:
        self._fresh = 0
        ordered = sorted(self._kept)
        first, last = _band(ordered, self._period)
        self.low, self.high = ordered[first], ordered[last]
        self._rare = ordered[min(first + SLACKS, last)] - self.low
        self._set_limits()

    def _set_limits(self) -> None:
        spread = self.high - self.low
        free = self._period - self.parts * spread
        slack = max(SLACKS * spread // len(self._kept), spread // TAIL_PARTS)
        if self._placed < FIRST:  # later on, what echoes err by is in the spread
            slack += self._echo_error
        margin = max(slack, self._period // USUAL_PARTS)
        margin = min(margin, free // 3)
        self.apart = margin >= 0
        self.least, self.most = self.low - margin, self.high + margin


def _band(ordered: Sequence[int], period: Duration) -> tuple[int, int]:
    """Places of the first and the last of some delays, the smallest first, in the narrowest band that holds
    all but the rare ones, and what joins it without a gap."""
    count = len(ordered)
    inside = count - count // RARE
    first = min(range(count - inside + 1), key=lambda place: ordered[place + inside - 1] - ordered[place])
    last = first + inside - 1
    gap = max(GAPS * (ordered[last] - ordered[first]) // inside, period // USUAL_PARTS)
    while first > 0 and ordered[first] - ordered[first - 1] <= gap:
        first -= 1
    while last < count - 1 and ordered[last + 1] - ordered[last] <= gap:
        last += 1
    return first, last


class Resemblance:
    """Whether the delays since the last reading that is missing look as those before: the least is the same.

    A network that delays readings by just whole periods more has the same look. None was seen to; the look
    decides only where SYNCs tell nothing.
    """

    def __init__(self, run: int, since: Instant) -> None:
        self.run = run
        """So many are missing in a row,"""
        self.since, self.until = since, NEVER
        """in this time: no sooner, and all readings from ``until`` on are behind."""
        self._low = self._high = self._count = self._others = 0
        self.followed = 0
        """Probes that readings of a usual delay have followed."""
        self.differed = 0
        """Readings that came at such an instant as follows no probe."""
        self.too_soon = 0
        """Readings that would have come sooner than their frame can."""

    @property
    def seen(self) -> int:
        """How many there are."""
        return self._count + self._others

    @property
    def strays_often(self) -> bool:
        """True if more than the last delay, and than are rare, were not usual."""
        return RARE * (self._others - 1) > self._count

    def stray(self) -> None:
        """A delay is not usual. Too many of them, and it begins again: later ones may be."""
        self._others += 1
        if RARE * self._others > self._count and self.seen >= KEPT:
            self._begin_again()

    def add(self, delay: int) -> None:
        """A delay is usual."""
        self._low = delay if self._count == 0 else min(self._low, delay)
        self._high = delay if self._count == 0 else max(self._high, delay)
        self._count += 1

    def is_as_wide(self, usual: UsualDelays) -> bool:
        """Return whether the largest is the same too. For that delays which grew by whole periods would have
        to have become more even as well, by just what is uneven in the SYNCs."""
        return self._count > 0 and abs(self._high - usual.high) <= usual.tolerance(usual.spread, self._count)

    def is_shown(self, usual: UsualDelays, least: int, *, frames: bool) -> bool:
        """By ``least`` readings or more; see :meth:`UsualDelays.begins_at`."""
        if self._count < least or RARE * self._others > self._count:
            return False
        if self.too_soon < TOO_SOON and usual.begins_at(self._low, self._count, frames=frames):
            return True
        if self.seen >= KEPT:
            self._begin_again()
        return False

    def _begin_again(self) -> None:
        """The next ones may show it."""
        self._count = self._others = self.too_soon = 0


def readings_to_resemble(spread: int, period: Duration, least: int) -> int:
    """How many readings show the least delay of some that spread over so much."""
    return max(least, min(ALIKE_MOST, ALIKE_PER_PERIOD * spread // period))


def lag_to_resemble(delays: Sequence[int], usual: UsualDelays, period: Duration, least: int) -> int | None:
    """By how many periods ``delays`` are to be longer to hold the usual ones, rare ones aside; None if they
    do not say, as they are fewer than ``least``, do not hold them, or spread so far that they may be folded
    upon themselves by whole periods."""
    if len(delays) < least:
        return None
    ordered = sorted(delays)
    first, last = _band(ordered, period)
    low, spread = ordered[first], ordered[last] - ordered[first]
    if 2 * spread > period or len(delays) < readings_to_resemble(spread, period, least):
        return None
    tolerance = usual.tolerance(spread, len(delays))
    lag = (usual.low + tolerance - low) // period
    return lag if usual.are_within(low + lag * period, spread, tolerance) else None


def middle_of(ages: Sequence[int], period: Duration) -> int:
    """The middle of some ages, whole periods aside."""
    half = period // 2
    off = [(age - ages[0] + half) % period - half for age in ages]
    return ages[0] + (min(off) + max(off)) // 2
