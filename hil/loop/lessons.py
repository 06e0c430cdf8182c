"""Lessons of an axis while it is calibrated: readings that can only answer one SYNC."""

from collections.abc import Sequence
from typing import Final

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.clock_map import residuals_of
from servobench.hil.loop.syncs import STAMPED_LATE, SyncLog, SyncMark

STANDS_STILL: Final = 3
"""Equal stamps of SYNCs that were learned from in a row: one may be a frame that came twice."""
LESSONS_MIN: Final = 8
"""Fewer readings do not say which of two ways to place their SYNCs is the better one,"""
EVENER: Final = 1.5
"""nor does a smaller difference: so much larger are the squares by the worse way. Readings scatter by
themselves, and where no echo is late a SYNC that waited in front of the bus has made the hand-over wrong."""


class Lessons:
    """Readings of a calibration, each with the SYNC that it answers."""

    def __init__(self, syncs: SyncLog) -> None:
        """``syncs``: of the axis's segment."""
        self.pairs: list[tuple[Reading, SyncMark]] = []
        self._syncs = syncs
        self._alone = True
        """True if the last SYNC had one reading."""
        self._stood = 0
        """How often in a row the stamp was the same."""

    def __len__(self) -> int:
        return len(self.pairs)

    def take(self, readings: Sequence[Reading], mark: SyncMark) -> Reading | None:
        """The reading to learn from among what came since the SYNC of ``mark``; call it once for each SYNC.

        A drive or a bus that stood still gives back several at once, and those of SYNCs before. So a reading
        must have come alone, and the SYNC before must have had its own.
        """
        alone = len({reading.device_time_ns or reading.received_at for reading in readings}) == 1
        if not (alone and self._alone and mark.on_bus_at is not None):
            self._alone = alone
            return None
        reading = readings[0]
        if self.pairs:
            before = self.pairs[-1][0].device_time_ns
            self._stood = self._stood + 1 if before is not None and before == reading.device_time_ns else 0
        self.pairs.append((reading, mark))
        return reading

    @property
    def stamp_stands_still(self) -> bool:
        """True if the last readings had one stamp."""
        return self._stood >= STANDS_STILL

    @property
    def echoes_mislead(self) -> bool:
        """True if readings follow the hand-over of their SYNCs more evenly than the echoes, which are off
        by more than is assumed: the stamps of readings, or where they have none the instants at which they
        came."""
        syncs = self._syncs
        if syncs.basis not in STAMPED_LATE or len(self.pairs) < LESSONS_MIN:
            return False
        echoes: list[tuple[int, Instant]] = []
        hand_overs: list[tuple[int, Instant]] = []
        for reading, mark in self.pairs:
            at = None if self.stamp_stands_still else reading.device_time_ns
            at = reading.received_at if at is None else at
            assert mark.on_bus_at is not None
            echoes.append((at, mark.on_bus_at))
            hand_overs.append((at, mark.handed_at))
        off = residuals_of(echoes)
        if max(off) - min(off) <= 2 * syncs.error_ns:
            return False
        by_hand_over = sum(each * each for each in residuals_of(hand_overs))
        return EVENER * by_hand_over < sum(each * each for each in off)

    def drop_overdue(self, period: Duration) -> bool:
        """Let go of readings that came behind the next SYNC and were taken for that one's; whether there were
        any. By the stamps that SYNC is a period later than those of the others."""
        offsets = [
            mark.on_bus_at - reading.device_time_ns
            for reading, mark in self.pairs
            if mark.on_bus_at is not None and reading.device_time_ns is not None
        ]
        if len(offsets) < len(self.pairs) or max(offsets, default=0) - min(offsets, default=0) < period // 2:
            return False
        latest = min(offsets) + period // 2
        self.pairs = [pair for pair, offset in zip(self.pairs, offsets, strict=True) if offset < latest]
        return True
