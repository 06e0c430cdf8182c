"""Which SYNC a reading without a stamp answers: by the order in which they passed the bus."""

from typing import Final

from drivers.exchange import Reading
from drivers.timebase import Duration, Instant
from hil.loop.attribution import Health, Question, Tell
from hil.loop.residuals import Extremes
from hil.loop.samples import Sample
from hil.loop.syncs import STAMPED_LATE, SURPLUS, SyncLog, SyncMark

SLACKS: Final = 2
"""Nothing else bounds a sample without a stamp: the smallest delay is not eight mean gaps above the least
possible one in one window of three thousand."""
PROBE_AGAIN_AFTER: Final = 100
"""SYNCs from a probe that failed until the next one."""


class OrderAttribution:
    """Places readings by the order in which SYNCs and readings passed the bus.

        SYNC ends      1       2       3          4                 5
        readings         |r      |r                 |r       |?
        placed           1       2                  4        not in order: 4 was answered already

    A reading answers the SYNC before it, as long as the drive answers before the next one. That cannot be
    seen from readings that come regularly: one period more of delay, which begins with a gap, looks like one
    lost reading. So after a gap readings are uncertain until a *probe*: one SYNC goes out a quarter of a
    period late. A drive that answers in time answers that one as late as itself; a delayed stream stays.

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
        self._probe = 0
        """Number of the SYNC that went out late; 0: none is out."""
        self._sure = True
        self._beyond = False
        self._usual_ns = 0.0
        self._next_probe = 0
        self._unsure: list[tuple[int, int]] = []
        """Cycles whose readings wait for the end of the probe, and the bounds of their samples if they are
        placed right."""

    @property
    def settled(self) -> bool:
        """Whether it is known that readings answer the SYNC before them."""
        return self._sure and not self._beyond

    def learn(self, reading: Reading, mark: SyncMark) -> None:
        """Take a reading that can only answer the SYNC of ``mark``."""
        if mark.on_bus_at is not None:
            delay = reading.received_at - mark.on_bus_at
            self._usual_ns = float(delay)
            self._delays.add(delay)
            self._answered = mark.number

    def probed(self, mark: SyncMark) -> None:
        """The SYNC of ``mark`` has gone out late."""
        self._probe = mark.number
        self.wants_probe = False

    def place(self, reading: Reading) -> Sample | None:
        received_at = reading.received_at
        mark = self._syncs.newest_before(received_at)
        if mark is None or mark.on_bus_at is None or mark.sequence == SURPLUS:
            self.health.unmatched += 1
            return None
        age = received_at - mark.on_bus_at
        if mark.number <= self._answered:
            # The second answer to a SYNC: this one, or the one before, was late by a period or more.
            self._find_beyond(mark.number)
            self.health.unmatched += 1
            return None
        if mark.number > self._answered + 1:
            self._sure = False
        self._answered = mark.number
        if mark.number == self._probe:
            self._conclude(age)
        elif not self._sure and self._probe < mark.number and mark.number >= self._next_probe:
            self.wants_probe = True
        self._usual_ns += (age - self._usual_ns) / 4.0
        self.question.open = not (self._sure or self._beyond)
        health = self.health
        health.placed += 1
        error_ns = self._error_of(age)
        if not self._sure:
            if not self._beyond:
                self._unsure.append((mark.sequence, error_ns))
            error_ns = self._echo_error + received_at - self._oldest_at()
        else:
            self._delays.add(age)
            health.error_ns_max = max(health.error_ns_max, error_ns)
            if age < self._transit - self._echo_error:
                health.below_transit += 1
        return Sample(mark.sequence, reading, mark.on_bus_at, error_ns, self._sure)

    def _error_of(self, delay: int) -> int:
        """How far the sample of a reading may lie from its SYNC."""
        delays = self._delays
        off = max(0, delay - delays.low)
        if self._echoes_late:
            off = max(off, delays.high - delay)
        return self._echo_error + min(off + SLACKS * delays.slack(), max(off, delay - self._transit))

    def _oldest_at(self) -> Instant:
        """No SYNC that is remembered ended before."""
        first = self._syncs.marks[0]
        return first.handed_at if first.on_bus_at is None else first.on_bus_at

    def _conclude(self, age: int) -> None:
        """The SYNC that went out late was answered after ``age``; usual is what the readings before had."""
        if abs(age - self._usual_ns) >= self._period / 8.0:
            self._find_beyond(self._probe)
            return
        self._sure = True
        for sequence, error_ns in self._unsure:
            self.question.amend(sequence, True, error_ns)
        self._unsure.clear()
        self.question.cleared = not self._beyond
        if self._beyond:
            self._beyond = False
            self._tell("its readings answer the SYNC before them again")

    def _find_beyond(self, number: int) -> None:
        """A reading has come later than the SYNC after its own; ``number``: of the SYNC of now."""
        self._sure = False
        self.question.open = False
        self._unsure.clear()
        self.wants_probe = False
        self._next_probe = number + PROBE_AGAIN_AFTER
        if not self._beyond:
            self._beyond = True
            self._tell(
                "its readings come later than the next SYNC; without a stamp of the drive's clock beside the"
                " speed it cannot be told which SYNC they answer: they are marked uncertain"
            )
