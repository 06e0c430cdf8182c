"""The common part of both ways to place readings: what they rest on, what they found, what is still open.

A drive whose stamp comes with the speed is placed by it (:mod:`servobench.hil.loop.stamp_attribution`),
another one by the order of SYNCs and readings on the bus (:mod:`servobench.hil.loop.order_attribution`).
"""

from collections.abc import Callable
from typing import Final

from servobench.drivers.record import replaced
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.loop.samples import Observation, Sample

HELD_MAX: Final = 64
"""Cycles for which a row waits for the answer to a question: longer than one stays open."""
HELD_FOR: Final = 150 * NS_PER_MS
"""The longest that a row waits so: those that wait in this process are gone if it is killed, and at most the
last 200 ms of a run may be. Rows that were not waited for stay uncertain."""

Tell = Callable[[str], None]


class Health:
    """Observations by which a run must be judged."""

    def __init__(self) -> None:
        self.placed = 0
        """Readings placed."""
        self.duplicates = 0
        """Readings that came twice."""
        self.unmatched = 0
        """Readings that answer no SYNC of this bench that is remembered."""
        self.steps = 0
        """Times that the drive's clock was found to be set."""
        self.below_transit = 0
        """Readings, placed for certain, that would have come sooner than their frame takes on the wire."""
        self.before_sync = 0
        """Readings, placed for certain, that would have come before their SYNC."""
        self.two_stamps = 0
        """SYNCs with two different stamps whose row had been recorded as certain."""
        self.error_ns_max = 0
        """Largest error bound of a reading placed for certain."""
        self.stamp_error_ns_max = 0
        """Largest error of a stamp that placed one."""

    def judge(self, delay: int, transit: Duration, error_ns: int, unstamped_ns: int) -> None:
        """Count what cannot be, of a reading placed for certain whose frame takes ``transit`` or more.
        ``unstamped_ns``: how much later than its stamp it may have been sampled."""
        if delay < transit - error_ns:
            self.below_transit += 1
            if delay < 0:
                self.before_sync += 1
        if error_ns > self.stamp_error_ns_max:
            self.stamp_error_ns_max = error_ns
        if error_ns + unstamped_ns > self.error_ns_max:
            self.error_ns_max = error_ns + unstamped_ns


class Question:
    """Rows and readings held back while it is open which SYNCs the last readings answer.

    A reading that comes meanwhile is marked uncertain at first. With the answer its mark is taken back, or
    stays; the rows of a run wait for that (:data:`HELD_MAX` cycles, :data:`HELD_FOR` at most).
    """

    def __init__(self) -> None:
        self.open = False
        self.since: int | None = None
        """While it is open: the first cycle whose reading had been placed and may not have been its own; None
        if no such one is in doubt."""
        self.cleared = False
        """True if a question ended without leaving a reading uncertain, since this was last set back."""
        self.left_open = False
        """True if one ended with the last reading and left some uncertain; the next may have begun then."""
        self._doubted: dict[int, int] = {}
        """Bounds of rows whose readings may be others'."""
        self._proved: dict[int, tuple[Instant, int]] = {}
        """Of rows, when the reading came that is theirs, and the bound of its sample."""
        self._recorded = -1
        """The newest row that is recorded."""

    def doubt(self, sequence: int, error_ns: int) -> bool:
        """Mark the row of a cycle uncertain after all; return False if it is recorded already."""
        self._doubted[sequence] = error_ns
        self._proved.pop(sequence, None)
        return sequence > self._recorded

    def doubts(self, sequence: int) -> bool:
        """Return whether the row of a cycle has been marked so, and waits."""
        return sequence in self._doubted

    def prove(self, sequence: int, received_at: Instant, error_ns: int) -> None:
        """The row of a cycle is certain after all, if it has the reading that came at ``received_at``: it may
        have been settled with another by then."""
        self._proved[sequence] = received_at, error_ns

    def withdraw(self, sequence: int) -> None:
        """The row stays as it is."""
        self._doubted.pop(sequence, None)

    def applied(self, observation: Observation, received_at: Instant | None) -> Observation:
        """The observation with what became known since, which is then forgotten. ``received_at``: of its
        reading; None if it has none."""
        row = self._recorded = observation.sequence
        if not (self._doubted or self._proved):
            return observation
        error_ns = self._doubted.pop(row, None)
        certain = False
        if row in self._proved:
            came_at, proved_ns = self._proved.pop(row)
            if certain := came_at == received_at:
                error_ns = proved_ns
        if len(self._doubted) + len(self._proved) > 2 * HELD_MAX:  # of rows that had been recorded
            self._doubted = {other: what for other, what in self._doubted.items() if other > row}
            self._proved = {other: which for other, which in self._proved.items() if other > row}
        if error_ns is None:
            return observation
        if isinstance(observation, Sample):
            return replaced(observation, certain=certain, sampled_at_error_ns=error_ns)
        return replaced(observation, certain=certain)
