"""Memory of placing by order: SYNCs without a reading, and what the last readings said."""

import math
from collections.abc import Sequence
from typing import Final

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.attribution import Question
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.order_question import STRAYS_MAX
from servobench.hil.loop.residuals import DelayExtremes
from servobench.hil.loop.syncs import REMEMBERED, STAMPED_LATE, SyncLog, SyncMark
from servobench.hil.loop.usual_delays import FIRST, UsualDelays

COPIES: Final = 8
"""The last readings, of which another may be a copy."""
UNTIDY_FOR: Final = 1000
"""Readings for which frames are expected to come twice or be held up once more."""
OPEN_FOR: Final = 10
"""SYNCs after which one that was passed over will have no reading any more: networks hold frames for less."""
HELD_UP: Final = 4
"""SYNCs after which a frame that was held up comes at the latest, and may be taken for that of another."""


class Unanswered:
    """SYNCs that were passed over, as a later one has its reading, and may have theirs yet."""

    def __init__(self, syncs: SyncLog) -> None:
        self._syncs = syncs
        self._numbers: list[int] = []
        """The oldest first."""

    def pass_over(self, answered: int, mark: SyncMark) -> bool:
        """``mark`` has its reading, and ``answered`` was the last before it; whether one is missing."""
        marks = self._syncs.marks
        first = marks[0].number
        missing = [
            number
            for number in range(max(first, answered + 1), mark.number)
            if marks[number - first].on_bus_at is not None
        ]
        self._numbers = [*self._numbers, *missing][-REMEMBERED:]
        return bool(missing)

    def since(self, number: int) -> int:
        """How many of them are later than SYNC ``number``."""
        count = len(self._numbers)
        while count and self._numbers[-count] <= number:
            count -= 1
        return count

    def is_within(self, syncs: int, mark: SyncMark) -> bool:
        """Return whether one of the last ``syncs`` before ``mark`` has no reading."""
        return bool(self._numbers) and 0 < mark.number - self._numbers[-1] <= syncs

    def may_come(self, mark: SyncMark) -> bool:
        """Return whether one before ``mark`` may have its reading yet."""
        return self.is_within(OPEN_FOR, mark)

    def may_be_taken_for(self, mark: SyncMark) -> bool:
        """Return whether a reading may be of one before ``mark`` that was held up."""
        return self.is_within(HELD_UP, mark)

    def take(self, latest: Instant) -> SyncMark | None:
        """The newest that had ended by ``latest``; it is answered then."""
        marks = self._syncs.marks
        first = marks[0].number
        for number in reversed(self._numbers):
            mark = marks[number - first] if number >= first else None
            if mark is not None and mark.on_bus_at is not None and mark.on_bus_at <= latest:
                self._numbers.remove(number)
                return mark
        return None


class Strays:
    """Readings in a row of another delay than is usual."""

    def __init__(self) -> None:
        self.ages: list[int] = []
        """How long each came after the SYNC before it."""
        self._known = 0
        """So many of the last ones are placed."""

    def __len__(self) -> int:
        return len(self.ages)

    @property
    def are_known(self) -> bool:
        """True if so many of them are placed that theirs is the usual delay."""
        return len(self.ages) >= STRAYS_MAX <= self._known

    def add(self, age: int, *, known: bool) -> None:
        """The next one; whether it is ``known`` which SYNC it answers."""
        self.ages.append(age)
        self._known = self._known + 1 if known else 0

    def clear(self) -> None:
        """A reading of a usual delay came, or theirs is the usual one."""
        self.ages.clear()
        self._known = 0


class SampleDelays(DelayExtremes):
    """Delays of readings whose place is certain, outliers too: bounds are made from them.

    What the SYNC took behind its echo, and what the echo was stamped late, is part of the delay. So a sample
    lies no further behind its SYNC than its delay exceeds the smallest of the last ones, and where echoes are
    stamped late no further before it than delays spread.
    """

    def __init__(self, syncs: SyncLog, period: Duration, transit: Duration) -> None:
        super().__init__()
        self._period, self._transit = period, transit
        self._echo_error, self._echoes_late = syncs.error_ns, syncs.basis in STAMPED_LATE
        self._first: list[int] = []
        """The first of a run."""
        self._longest = DelayExtremes()
        """Delays with the sign turned: how far above the longest others may lie. It is they that tell how
        late echoes are, as no reading is stamped before the echo in front of it."""

    def add(self, value: int) -> None:
        super().add(value)
        if self._echoes_late:
            self._longest.add(-value)

    def begin(self, values: Sequence[int]) -> None:
        super().begin(values)
        if self._echoes_late:
            self._longest.begin([-value for value in values])

    def take(self, delay: int) -> None:
        """One of a run. With the first ones those of a calibration are let go of: they are of a quiet bus, so
        alike that they say the least one is known."""
        self.add(delay)
        if len(self._first) < FIRST:
            self._first.append(delay)
            if len(self._first) == FIRST:
                self.begin(self._first)

    def error_of(self, delay: int) -> int:
        """How far the sample of a reading may lie from its SYNC."""
        if self._echoes_late:  # and by how much is in no single delay, as readings are stamped late too
            unseen = max(self.unseen(self._transit), self._longest.unseen(self._transit))
            return self._echo_error + max(delay, self.high) - self.low + unseen
        if len(self._first) < FIRST:
            late = max(delay - self.low, min(delay - self._transit, self._period // 2))
            return self._echo_error + late
        return self._echo_error + self.late(delay, self._transit)


class Copies:
    """Speeds and stamps of the last readings: a frame that comes twice tells one of them again."""

    def __init__(self, syncs: SyncLog, period: Duration, transit: Duration) -> None:
        self.stamps: DriveStamps | None = None
        """Knowledge of the drive's stamps."""
        self._syncs = syncs
        self._period, self._transit = period, transit
        self._told: list[tuple[float, int | None]] = [(math.nan, None)] * COPIES
        self._place = 0
        self.before = self._held = False
        """True if the reading before the last one may have been a copy."""

    @property
    def told_by_stamps(self) -> bool:
        """True if what is held is a copy: two SYNCs have two stamps, unless these advance by more than half a
        period or stand still. Speeds alone are alike while a shaft is at rest."""
        stamps = self.stamps
        if stamps is None or 2 * stamps.resolution > self._period:
            return False
        return len({stamp for _, stamp in self._told}) > COPIES // 2

    @property
    def told_by_speeds(self) -> bool:
        """True if what is held is hardly told by chance: a shaft at rest has told nothing else."""
        return not (self.before or math.isnan(self._told[-1][0]))

    def is_surplus(self, copy: Reading, unanswered: Unanswered, answered: int) -> bool:
        """Return whether one that is held answers no SYNC: all up to number ``answered`` have their readings,
        and a shaft that is not at rest told it."""
        latest = Instant(copy.received_at - self._transit)
        mark = self._syncs.newest_before(latest)
        if mark is None or not self.told_by_speeds or unanswered.may_come(mark):
            return False
        return mark.number <= answered and not self._syncs.may_precede(latest, mark)

    def holds(self, reading: Reading) -> bool:
        """Return whether one of the last readings told the same; else it is remembered."""
        told = reading.velocity_rad_s, reading.device_time_ns
        self.before = self._held
        held = self._held = told in self._told
        if not held:
            self._told[self._place] = told
            self._place = (self._place + 1) % COPIES
        return held


class Unconfirmed:
    """Rows of readings that wait for the answer to a question."""

    def __init__(self, question: Question, usual: UsualDelays) -> None:
        self._question = question
        self._usual = usual
        self._rows: list[tuple[tuple[int, Instant, int], bool]] = []

    def add(self, row: tuple[int, Instant, int], delay: int, behind: bool) -> None:
        """``row``: its cycle, when the reading came, and the bound of its sample if the answer confirms it.
        ``behind``: whether it may be of a SYNC before, if frames are held up: one of a ``delay`` that none
        was seen to have is not confirmed then."""
        if not behind or self._usual.saw(delay):
            self._rows.append((row, behind))

    def drop(self, sequence: int) -> None:
        """The reading of that cycle may be another's in any case."""
        self._rows = [row for row in self._rows if row[0][0] != sequence]

    def clear(self) -> None:
        """None is confirmed."""
        for _ in self._rows:
            self._usual.tell(certain=False)
        self._rows.clear()

    @property
    def behind(self) -> bool:
        """True if one of them may be that of a SYNC before."""
        return any(behind for _, behind in self._rows)

    def confirm(self, until: int, *, untidy: bool) -> None:
        """Those up to cycle ``until`` are where they were placed; ``untidy``: frames are held up at times."""
        for row, behind in self._rows:
            if row[0] <= until:
                certain = self._usual.tell(certain=not (behind and untidy))
                if certain:
                    self._question.prove(*row)
        self._rows = [row for row in self._rows if row[0][0] > until]
