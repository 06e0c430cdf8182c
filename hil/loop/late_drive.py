"""A drive whose process stood still: it hears a SYNC late, by more than a period at times.

    SYNC ends       1        2        3        4
    stands still         |----------------|
    stamps          :d1                   :d2 :d3 of one instant, or d2 alone, if a mailbox had room for one
    by its stamp    1                     3        d2 lies on the SYNC behind the one that it answers

So where a SYNC has no reading, that of the next one may be its own: if it lies off its SYNC, further than
most lie from one another, and if another one tells the same or lies on that SYNC too. All these are in doubt.
"""

from typing import Final

from servobench.drivers.timebase import Duration
from servobench.hil.loop.attribution import Question, Tell
from servobench.hil.loop.clock_question import ClockQuestion
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.suspects import Suspect
from servobench.hil.loop.syncs import REMEMBERED, SURPLUS, SyncLog, SyncMark

EXPECTED_FOR: Final = 1000
"""Readings for which a drive that stood still is expected to do so again, where stamps are so coarse that
they hide it."""
SECONDS_TOLD: Final = 64
"""Where so many more readings came on SYNCs that had one than on others, that is how the drive sends them."""
LONGEST: Final = 10
"""SYNCs for which it stands still at the most."""


class LateDrive:
    """Doubt about readings of a drive that may have stood still."""

    def __init__(
        self,
        syncs: SyncLog,
        stamps: DriveStamps,
        case: ClockQuestion,
        question: Question,
        period: Duration,
        tell: Tell,
    ) -> None:
        """``tell``: takes events."""
        self._syncs, self._stamps, self._case, self._tell = syncs, stamps, case, tell
        self._question, self._error_ns, self._half = question, REMEMBERED * period, period // 2
        self._seconds = 0
        """Twice the readings on a SYNC that had one, less those on a SYNC of their own; told of once."""
        self._expected = 0
        """Readings left for which it is expected."""

    def doubts(self, mark: SyncMark, residual: int) -> bool:
        """Return whether a reading that lies on the SYNC of ``mark`` may be of one before that has none; the
        rows of those are in doubt then."""
        self._expected -= self._expected > 0
        self._seconds -= 0 < self._seconds < SECONDS_TOLD
        if not (before := self._without_reading(mark)):
            return False
        coarse = self._stamps.coarse
        if not (self._expected > 0 if coarse else self._stamps.lies_apart(residual)):
            return False
        self._doubt(before)
        return True

    def copied(self, mark: SyncMark, delay: int) -> None:
        """Take note that the SYNC of ``mark`` has a reading, and one that came a ``delay`` after it tells the
        same: it came twice, or behind those of the SYNCs before, sampled at one instant."""
        delays, waited = self._case.delays, self._half * len(self._without_reading(mark))
        if delay <= delays.high + delays.slack() + waited:
            self._have_one_sync(mark)

    def acquitted(self, suspects: list[Suspect]) -> None:
        """Take note that the clock was not set: ``suspects`` whose stamps lie further off than any before, or
        on a SYNC that has one, are of a drive that was late."""
        self._count_seconds(sum(suspect.second for suspect in suspects))
        for suspect in suspects:
            mark = self._syncs.nearest(self._stamps.clock.place(suspect.device_ns))
            if mark is not None and (suspect.second or suspect.twice):
                self._have_one_sync(mark)
        for mark in self._case.note_residuals(suspects):
            self._doubt(self._without_reading(mark))

    def _count_seconds(self, count: int) -> None:
        """A drive that stands still makes some now and then, one that answers each SYNC twice always."""
        if self._seconds < SECONDS_TOLD <= self._seconds + 2 * count:
            self._tell(
                "it answers each SYNC twice, with different stamps, and which reading is the SYNC's cannot be"
                " told: they are marked uncertain; let one TPDO alone send the speed, with each SYNC"
            )
        self._seconds = min(SECONDS_TOLD, self._seconds + 2 * count)

    def _have_one_sync(self, mark: SyncMark) -> None:
        """Two readings lie on the SYNC of ``mark``: one may be of a SYNC before."""
        if before := self._without_reading(mark):
            self._doubt([*before, mark])
            self._expected = EXPECTED_FOR

    def _doubt(self, marks: list[SyncMark]) -> None:
        for mark in marks:
            self._question.doubt(mark.sequence, self._error_ns)

    def _without_reading(self, mark: SyncMark) -> list[SyncMark]:
        """The SYNCs of cycles just before ``mark`` that have no reading."""
        marks, found = self._syncs.marks, list[SyncMark]()
        last = mark.number - 1 - marks[0].number
        for place in range(last, max(-1, last - LONGEST), -1):
            before = marks[place]
            if before.on_bus_at is None:
                continue
            if before.number in self._case.stamps:
                break
            if before.sequence != SURPLUS:
                found.append(before)
        return found
