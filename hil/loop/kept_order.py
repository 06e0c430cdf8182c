"""Which SYNCs readings answer on a way that keeps their order, however far their delays spread.

    SYNC ends    1      2      3      4      5
    readings                |a     |b |c                 c comes before 5, and they are three: 2's, 3's, 4's

Each reading answers a later SYNC than the one before, so that of the next one at the earliest; at the latest
the last that its frame leaves time for. Where both are the same it is certain, and so are those before it.
A loss leaves one to spare, until a delay would be longer than all are: then the loss is known. If a delay had
grown instead, readings would soon come too early for it, or earlier than any before; so what rests on such a
loss waits for more, and where the shortest is far longer than a frame takes nothing rests on it.

That a way keeps the order is seen in the frames of one SYNC: where delays spread over a period and frames
overtake each other, they do so within a SYNC too, in one cycle of four.
"""

from typing import Final

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.syncs import STAMPED_LATE, SURPLUS, SyncLog, SyncMark

OVERTAKEN_AT_FIRST: Final = 0.25
"""The share of readings that another frame of their SYNC has overtaken, where frames do so freely."""
OVERTAKEN_MOST: Final = 1 / 16
"""The same of a way that keeps the order: losses look like it."""
HEEDED: Final = 96
"""Readings that this share rests on: by chance it does not come from the one to the other."""
SEEN_MIN: Final = 16
"""Certain delays that tell how long the longest is."""
SLACK_PARTS: Final = 8
"""By such a part of their spread the next one may well be longer,"""
SLACKS: Final = 4
"""or by so many mean gaps; and hardly be shorter by more than these."""
WAITS: Final = 16
"""Readings behind one that is certain: if one too many had come, there would be more than SYNCs by then."""
WAITS_LOST: Final = 48
"""The same of one that rests on a loss: those of a delay that has grown would have come too soon."""
LOSSES_MIN: Final = 3
"""As few may be a delay that has grown by about a period, once or twice."""
HIDES_PARTS: Final = 2
"""A shortest delay that exceeds a frame's by such a part of a period hides a delay that has grown by less
than a period: it takes a loss's place, and no reading comes too early."""
NARROWEST_PARTS: Final = 2
"""Delays that spread over less than such a part of a period are told by how long they usually are."""
WIDEST: Final = 2
"""Periods: in a queue that holds frames for longer few come soon enough to show that a delay has grown."""
KEPT: Final = 64
"""Readings that may become certain: rows wait for no more."""
BLURRED: Final = 4
"""SYNCs before a reading that was overtaken which may be its own: networks hold frames for less."""
AT_REST: Final = 16
"""Readings that show whether those of the begin, alike as the shaft stood still, were readings or copies."""
DISTRUSTED_FOR: Final = 1000
"""Readings after more came than SYNCs could have, until it is believed again that none are surplus."""


class PlacedInOrder:
    """A reading and the SYNC that it answers at the earliest."""

    def __init__(self, mark: SyncMark, latest: int, received_at: Instant) -> None:
        assert mark.on_bus_at is not None
        self.mark = mark
        self.latest = latest
        """Number of the last SYNC that it may answer."""
        self.received_at = received_at
        self.delay = received_at - mark.on_bus_at
        self.certain = False
        self.heeded = False
        """True if the reading was placed so, and no other one before."""


class KeptOrder:
    """The last readings of a drive that were not placed for certain."""

    def __init__(self, syncs: SyncLog, period: Duration, transit: Duration) -> None:
        self._syncs = syncs
        self._period = period
        self._transit = transit
        exact = syncs.basis in (EchoBasis.BUS, EchoBasis.HARDWARE)
        self._soonest = transit - syncs.error_ns if exact else 0
        self.proved: list[PlacedInOrder] = []
        """Those that have become certain with the last one."""
        self._rows: list[PlacedInOrder] = []
        self._last = 0
        """Number of the SYNC that the last reading answers at the earliest."""
        self._last_at = Instant(0)
        self._overtaken = OVERTAKEN_AT_FIRST
        self._frames_apart = False
        """True if position and speed come in frames of their own."""
        self._distrusted = 0
        self._lost = False
        """True if one was lost since it was known how many there are."""
        self._hidden = False
        """True if a delay may have grown instead."""
        self._losses = 0
        """Times that some were, up to :data:`LOSSES_MIN`."""
        self._count = 0
        """Readings since then,"""
        self._alike = 0
        """and such as were like the first one."""
        self._low = self._high = self._seen = 0
        """Of certain delays."""

    @property
    def leads(self) -> bool:
        """True if readings can be placed by it, as they spread over a good part of a period or more."""
        if self._distrusted or (self._syncs.basis in STAMPED_LATE and not self._syncs.of_another):
            return False  # an echo may be stamped behind the reading that it is followed by
        kept = self._frames_apart and self._overtaken < OVERTAKEN_MOST
        spread = self._high - self._low
        reaches = self._period <= NARROWEST_PARTS * spread and spread < WIDEST * self._period
        return kept and self._seen >= SEEN_MIN and reaches

    def take(self, reading: Reading, known: int, copy: bool) -> PlacedInOrder | None:
        """Take the next reading; None if it says nothing. ``known``: number of the last SYNC whose reading
        was certain. ``copy``: it may be one of another."""
        self.proved.clear()
        at = reading.received_at
        overtaken = reading.position_told_at < self._last_at
        self._frames_apart |= 2 * (at - reading.position_told_at) >= self._transit
        self._overtaken += (overtaken - self._overtaken) / HEEDED
        self._distrusted -= self._distrusted > 0
        self._last_at = at
        if known > self._last:
            self._begin(known)
        latest = self._syncs.newest_before(Instant(at - self._soonest))
        if latest is None:
            return None
        if copy or overtaken:
            self._alike += copy and self._count <= 1
            self._rows = [row for row in self._rows if row.latest <= latest.number - BLURRED]
            return None
        mark = self._earliest(at)
        if mark is None or mark.number > latest.number:
            self._distrusted = DISTRUSTED_FOR
            self._begin(latest.number)
            self._seen = 0
            return None
        if mark.number > self._last + 1:
            self._lost = True
            self._hidden |= HIDES_PARTS * (self._low - self._soonest) > self._period
            self._losses = min(LOSSES_MIN, self._losses + 1)
        self._last = mark.number
        self._count += 1
        row = PlacedInOrder(mark, latest.number, at)
        self._rows.append(row)
        if len(self._rows) > KEPT:
            del self._rows[0]
        shortest = self._low - SLACKS * (self._high - self._low) // max(self._seen, 1)
        self._hidden |= self._lost and row.delay < shortest  # a delay has grown by less than a period
        if self._count == AT_REST and self._alike and len(self._rows) > 1:
            self._count_those_at_rest()
        self._prove()
        return row

    def _prove(self) -> None:
        latest = self._last + 1
        waits = WAITS
        if self._lost:
            waits = WAITS_LOST if self._losses >= LOSSES_MIN and not self._hidden else KEPT
        for behind, row in enumerate(reversed(self._rows)):
            if row.certain:  # so are those before it, or never will be
                break
            latest = min(row.latest, latest)
            if latest == row.mark.number and behind >= waits:
                row.certain = True
                self._learn(row.delay)
                if row.mark.sequence != SURPLUS:
                    self.proved.append(row)
            latest -= 1

    def _begin(self, number: int) -> None:
        self._rows.clear()
        self._last, self._lost, self._hidden = number, False, False
        self._count = self._alike = 0

    def _count_those_at_rest(self) -> None:
        """Those that were alike at the begin count as far as all since would come a period late without."""
        least = min(row.delay for row in self._rows[1:])
        self._rows.clear()
        self._last += min(self._alike, max(0, least - self._soonest) // self._period)

    def _learn(self, delay: int) -> None:
        self._low = delay if self._seen == 0 else min(self._low, delay)
        self._high = delay if self._seen == 0 else max(self._high, delay)
        self._seen += 1

    def _earliest(self, at: Instant) -> SyncMark | None:
        """The first SYNC behind that of the last reading, if no delay is longer than all are."""
        longest = at
        if self._seen >= SEEN_MIN:
            spread = self._high - self._low
            longest = Instant(self._high + max(spread // SLACK_PARTS, SLACKS * spread // self._seen))
        marks = self._syncs.marks
        for mark in marks[max(0, self._last + 1 - marks[0].number) :]:
            if mark.on_bus_at is not None and at - mark.on_bus_at <= longest:
                return mark
        return None
