"""A drive whose process stood still: it hears a SYNC late, by more than a period at times.

    SYNC ends       1        2        3        4
    stands still         |----------------|
    stamps          :d1                   :d2 :d3 of one instant, or d2 alone, if a mailbox had room for one
    by its stamp    1                     3        d2 lies on the SYNC behind the one that it answers

So a reading that lies off a SYNC, and none on those before, may be of one of these. Jitter makes such
readings too, but not rarely, and not by so much: those are doubted that lie further off than most, once one
has lain off by more than any before, or two SYNCs have one stamp.
"""

from typing import Final

from servobench.drivers.timebase import Duration
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.attribution import Question
from servobench.hil.loop.clock_question import ClockQuestion
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.suspects import Suspect
from servobench.hil.loop.syncs import SURPLUS, SyncLog, SyncMark

EXPECTED_FOR: Final = 1000
"""Readings for which a drive that stood still is expected to do so again,"""
JITTER_PARTS: Final = 4
"""if it was off by more than such a part of a period: jitter is less, and one that stands still for longer
than a period acts at any phase,"""
LONGEST: Final = 10
"""and SYNCs for which it stands still at the most."""


class LateDrive:
    """Doubt about readings of a drive that may have stood still."""

    def __init__(
        self,
        syncs: SyncLog,
        stamps: DriveStamps,
        case: ClockQuestion,
        question: Question,
        period: Duration,
        error_ns: int,
    ) -> None:
        """``error_ns``: of a reading of uncertain place."""
        self._syncs, self._stamps, self._case = syncs, stamps, case
        self._question, self._error_ns = question, error_ns
        self._jitter_most = period // JITTER_PARTS
        self._may_wait = syncs.basis is EchoBasis.NONE
        self._expected = 0
        """Readings left for which it is expected."""

    def doubts(self, mark: SyncMark, residual: int) -> bool:
        """Return whether a reading that lies on the SYNC of ``mark`` may be of one before that has none; the
        rows of those are in doubt then."""
        if self._expected == 0:
            return False
        self._expected -= 1
        return self._stamps.is_rarely_off(residual) and self._doubt_before(mark)

    def copied(self, mark: SyncMark, residual: int) -> None:
        """Take note that the SYNC of ``mark`` has a reading with this residual, and another one tells the
        same: it came twice, or both were sampled at one instant."""
        if self._stamps.is_rarely_off(residual) and self._doubt_before(mark):
            self._question.doubt(mark.sequence, self._error_ns)
            self._note(residual)

    def acquitted(self, suspects: list[Suspect]) -> None:
        """Take note that the clock was not set: ``suspects`` whose stamps lie further off than any before are
        of a drive that was late."""
        for mark, residual in self._case.note_residuals(suspects):
            self._note(residual)
            self._doubt_before(mark)

    def _note(self, residual: int) -> None:
        """Where no echo tells what SYNCs of this host waited in front of the bus, nothing tells that from a
        drive that was late."""
        shown = self._syncs.of_another or not self._may_wait
        if shown and abs(residual) > self._jitter_most:
            self._expected = EXPECTED_FOR

    def _doubt_before(self, mark: SyncMark) -> bool:
        """Doubt the rows of the SYNCs just before ``mark`` that have no reading; return whether there are
        any."""
        marks, found = self._syncs.marks, False
        last = mark.number - 1 - marks[0].number
        for place in range(last, max(-1, last - LONGEST), -1):
            before = marks[place]
            if before.on_bus_at is None:
                continue
            if before.number in self._case.stamps:
                break
            if before.sequence != SURPLUS:
                self._question.doubt(before.sequence, self._error_ns)
                found = True
        return found
