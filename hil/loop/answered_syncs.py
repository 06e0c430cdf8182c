"""SYNCs that have their readings, of a drive that stamps these: with which stamps, and after which delays."""

from typing import Final

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.residuals import DelayExtremes
from servobench.hil.loop.suspects import Suspect
from servobench.hil.loop.syncs import STAMPED_LATE, SURPLUS, SyncLog, SyncMark

STAMPS_MAX: Final = 512
"""Stamps kept before those of forgotten SYNCs are dropped."""


class AnsweredSyncs:
    """Knowledge of which SYNCs have their readings, and how long these took."""

    def __init__(
        self,
        syncs: SyncLog,
        stamps: DriveStamps,
        period: Duration,
        transit: Duration,
        at_arrival: bool,
    ) -> None:
        """``transit``: shortest time of a reading's frame. ``at_arrival``: see :meth:`unstamped_ns`."""
        self.stamps: dict[int, int] = {}
        """Stamps of the SYNCs answered, by their numbers."""
        self.delays = DelayExtremes()
        """From a SYNC to its reading."""
        self.revoked: list[tuple[SyncMark, int]] = []
        """Placements just before the question that it touches, and their stamps."""
        self.answered = 0
        """Number of the newest SYNC answered."""
        self.since = 0
        """Number of the newest SYNC answered when the question was put."""
        self.twice = 0
        """Readings that came twice since the last one that raised no question."""
        self._syncs = syncs
        self._stamps = stamps
        self._transit = transit
        self._half = period // 2
        self._at_arrival = at_arrival
        self._echoes_late = syncs.basis in STAMPED_LATE

    def bounded(self, error_ns: int, after: int, delay: int) -> int:
        """``error_ns`` of a sample ``after`` its SYNC, or less where stamps are coarse and what the ``delay``
        of its reading from the SYNC exceeds the smallest by says so, as it does without stamps."""
        if self._echoes_late or not self._stamps.coarse:
            return error_ns
        return min(error_ns, max(after, self.delays.late(delay, self._transit) - after))

    def hidden_ns(self, delay: int) -> int:
        """Return how late the SYNC of a reading of ``delay`` may have been, its stamp not telling."""
        hidden = self._stamps.hidden_ns
        return min(hidden, self.delays.late(delay, self._transit)) if hidden else 0

    def unstamped_ns(self, delay: int) -> int:
        """How much later than its stamp a reading of ``delay`` may have been sampled: 0 unless the stamp is
        latched when the SYNC comes. What the drive took from there is in no stamp, but in the delay."""
        if not self._at_arrival:
            return 0
        return self.delays.late(delay, self._transit)

    def answer(self, mark: SyncMark, device_ns: int) -> None:
        """``mark`` has its reading."""
        self.stamps[mark.number] = device_ns
        self.answered = max(self.answered, mark.number)
        if len(self.stamps) > STAMPS_MAX:
            oldest = self._syncs.marks[0].number
            self.stamps = {number: stamp for number, stamp in self.stamps.items() if number >= oldest}

    def rivals(self, mark: SyncMark, at: Instant) -> list[SyncMark]:
        """The SYNCs beside the nearest, ``mark``, whose reading a stamp at ``at`` may be of too: it lies on
        them, or a drive that latches at arrival had not answered them when ``mark`` came."""
        rivals: list[SyncMark] = []
        for other in self._syncs.beside(mark):
            on_bus_at = other.on_bus_at
            if on_bus_at is not None and (self._stamps.reaches(at - on_bus_at) or self._is_late(other, mark)):
                rivals.append(other)
        return rivals

    def _is_late(self, before: SyncMark, mark: SyncMark) -> bool:
        """True if ``before`` has no reading when that of ``mark`` comes, within half a period behind it."""
        if not self._at_arrival or before.number > mark.number or before.number in self.stamps:
            return False
        assert before.on_bus_at is not None
        assert mark.on_bus_at is not None
        return mark.on_bus_at - before.on_bus_at < self._half

    def alike(self, placed: list[tuple[Suspect, SyncMark]]) -> list[tuple[Suspect, SyncMark]]:
        """Those of the suspects behind a step whose delays are like the least one: a longer delay may be that
        of a reading from before a further step, placed by that one."""
        delays = [suspect.received_at - (mark.on_bus_at or 0) for suspect, mark in placed]
        most = min(delays) + self.delays.high - self.delays.low + self.delays.slack() + self._half
        return [each for each, delay in zip(placed, delays, strict=True) if delay <= most]

    def learn(self, placed: list[tuple[Suspect, SyncMark]], *, others: bool) -> None:
        """Suspects are placed, and the map goes through them. ``others``: their delays are no longer those of
        before, and the least of those is none any more."""
        delays: list[int] = []
        for suspect, mark in placed:
            self.answer(mark, suspect.device_ns)
            assert mark.on_bus_at is not None
            residual = self._stamps.clock.place(suspect.device_ns) - mark.on_bus_at
            latest = Instant(suspect.received_at - self._transit)
            delays.append(suspect.received_at - self._stamps.sampled_at(mark.on_bus_at, residual, latest))
        if others:
            self.delays.begin(delays)
        else:
            for delay in delays:
                self.delays.add(delay)

    def free_marks(self, latest: Instant) -> list[SyncMark]:
        """SYNCs of cycles that may have ended by ``latest`` and have no stamp."""
        return [
            mark
            for mark in self._syncs.marks
            if mark.on_bus_at is not None and mark.on_bus_at - mark.late_ns <= latest
            if mark.number not in self.stamps and mark.sequence != SURPLUS
        ]

    def _is_anothers(self, mark: SyncMark, suspect: Suspect) -> bool:
        """Return whether the SYNC of ``mark`` has a reading that is not the suspect."""
        known = self.stamps.get(mark.number)
        return known is not None and (known != suspect.device_ns or suspect.repeats)

    def _lost_before(self, number: int) -> int:
        """SYNCs of cycles after the last certainly answered one and before ``number``."""
        return sum(
            self.since < mark.number < number and mark.on_bus_at is not None for mark in self._syncs.marks
        )
