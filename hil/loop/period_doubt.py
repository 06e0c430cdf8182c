"""Doubt about whole periods: SYNCs at equal distances leave open whether readings are placed by them.

A clock that is set back by a period and a delay that grows by one are the same stamps and the same arrivals:

    SYNC ends      1       2       3       4
    arrivals               :r1     :r2     :r3
    the clock runs on      r1: 1   r2: 2   r3: 3       and the delay is longer by a period
    it was set             r1: 2   r2: 3   r3: 4       and the delay is what it was

Each is a *way* to place the readings from there on. A way is out when a reading would have come sooner than a
frame can, when the clock would have been set and the smallest delay have changed besides, or when the
unevenness of its SYNCs explains that of the stamps so much less than another's does. Until one is left,
readings are placed by the likeliest and marked uncertain.
"""

from collections import deque
from itertools import pairwise
from typing import Final

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.hil.loop.attribution import HELD_MAX, Tell
from servobench.hil.loop.drive_stamps import DriveStamps
from servobench.hil.loop.residuals import DelayExtremes
from servobench.hil.loop.syncs import SyncLog

EXCLUDING: Final = 24.0
"""A way is out if another is e^24 times likelier: chance alone reaches that once in a million times, and is
asked with every reading."""
TOO_SOON: Final = 2
"""The first reading of a clock that was set forward comes too soon in the right way too: it puts the question
whether it was, and after that counts."""
HEEDED_MIN: Final = 8
"""Fewer changes say too little of how much they scatter."""
DELAYS_MIN: Final = 32
"""So many readings show the smallest delay of a way,"""
DELAYS_MAX: Final = 128
"""and what it is after so many is another change."""
PROBE_AFTER: Final = 16
"""Readings for which the unevenness of the SYNCs may decide before one of them goes out late for it,"""
PROBE_AGAIN_AFTER: Final = 23
"""and again: behind jitter of the SYNC at the drive some three to five are needed. No round number, by which
clocks are set: SYNCs that are late so far apart look alike then."""
PROBES_FREQUENT: Final = 10 * PROBE_AGAIN_AFTER
"""After so many readings another will hardly help, and it disturbs the loop: then every tenth of them."""


class Placing:
    """One way to place readings."""

    def __init__(self, offset_ns: int, steps: bool) -> None:
        self.steps = steps
        """True if the clock was set, so that delays are what they were."""
        self.anew(offset_ns)

    def anew(self, offset_ns: int) -> None:
        """Begin with an offset."""
        self.offset_ns = offset_ns
        """By how much later than they are placed it has their samples: whole periods."""
        self.delays = DelayExtremes()
        self.delays_seen = 0
        self.at: Instant | None = None
        """Its SYNC of the last reading."""
        self.out = False
        self.too_soon = 0
        """Readings that would have come sooner than a frame can."""
        self.stamps_squared = self.product = self.syncs_squared = 0.0
        """Sums over changes from reading to reading, less whole periods: of stamps, of both, of SYNCs."""

    @property
    def unexplained(self) -> float:
        """What the SYNCs leave of the stamps' squares, ns^2. Where echoes err, stamps follow them in part,
        but never by more than all."""
        if self.product <= 0.0:
            return self.stamps_squared
        part = min(1.0, self.product / self.syncs_squared)
        return self.stamps_squared - part * (2.0 * self.product - part * self.syncs_squared)


class PeriodDoubt:
    """The ways that are left for the readings of one drive; none while there is no doubt."""

    def __init__(
        self, syncs: SyncLog, stamps: DriveStamps, period: Duration, transit: Duration, tell: Tell
    ) -> None:
        """``transit``: the shortest time of a reading's frame."""
        self.ways: list[Placing] = []
        """The first has offset 0, as long as it is left."""
        self.heeded: deque[tuple[int, Instant]] = deque(maxlen=HELD_MAX)
        """Stamps since the map moved, and where it has them."""
        self.rows: deque[tuple[int, Instant, int]] = deque(maxlen=HELD_MAX)
        """Cycles whose readings are certain if they are placed right, when these came, and their bounds."""
        self.revoked: list[int] = []
        """Cycles from before, whose rows stay as they were if they are placed right."""
        self.proved = True
        """True if all readings are, in the cycles in which they were placed, since the question was put."""
        self.since = 0
        """Number of the newest SYNC that had been answered before."""
        self.wants_probe = False
        """True if the next SYNC is to go out a quarter of a period late."""
        self._syncs = syncs
        self._stamps = stamps
        self._period = period
        self._transit = transit
        self._tell = tell
        self._told = False
        self._spacing = float(period)
        """Mean distance of the SYNCs."""
        self._low = self._slack = 0
        """The smallest delay before, and what it may seem to change by."""
        self.surprised = False
        """True if the last reading would have come too soon in one of the ways: it is wrong, or the clock has
        been set once more."""
        self._heeded = self._changes = 0
        self._device_ns = 0

    @property
    def open(self) -> bool:
        """True if more than one is left."""
        return len(self.ways) > 1

    def put(self, steps: bool, others: list[tuple[int, bool]], delays: DelayExtremes, since: int) -> None:
        """Readings are placed in one way from now on, and others are as possible.

        ``steps``: whether the clock was set then. ``others``: by how much later they have the samples, and
        whether the clock was set. ``delays``: those until now. ``since``: the newest SYNC answered.
        """
        self._spacing = self._mean_spacing()
        if not self.ways:
            self._low, self._slack, self.since = delays.low, delays.slack(), since
            self.ways = [Placing(0, False)]
        ways: dict[int, bool] = {}
        for old in self.ways:
            for offset_ns, stepped in ((0, steps), *others):
                offset_ns = round(round((old.offset_ns + offset_ns) / self._spacing) * self._spacing)
                ways[offset_ns] = (old.steps or stepped) and ways.get(offset_ns, True)
        self.ways = [
            Placing(offset_ns, stepped) for offset_ns, stepped in sorted(ways.items(), key=_remoteness)
        ]
        self._heeded = self._changes = 0
        self.heeded.clear()

    def _mean_spacing(self) -> float:
        marks = [mark.on_bus_at for mark in self._syncs.marks if mark.on_bus_at is not None]
        half = self._period // 2
        periods = sum((later - earlier + half) // self._period for earlier, later in pairwise(marks))
        return (marks[-1] - marks[0]) / periods

    def moved(self) -> None:
        """The clock's map has moved: stamps before and after have nothing in common."""
        for way in self.ways:
            way.at = None
            way.too_soon = 0
        self.heeded.clear()

    def end(self) -> None:
        """Which way is right is known."""
        self.surprised = False
        self.ways = []
        self.rows.clear()
        self.revoked.clear()
        self.heeded.clear()
        self.wants_probe = False
        if self._told:
            self._told = False
            self._tell("which SYNCs its readings answer is known again")

    def probed(self) -> None:
        """A SYNC has gone out late."""
        self.wants_probe = False

    def heed(self, device_ns: int, at: Instant, received_at: Instant, moved: bool) -> None:
        """A reading whose stamp lies at ``at`` as it is placed. ``moved``: the clock may have been set once
        more since, so that when it came says nothing."""
        near_ns = self._stamps.near_ns
        known, self.surprised = True, False
        before = [way.at for way in self.ways]
        for way in self.ways:
            known = self._place(way, at, received_at, near_ns, moved) and known
        passed = round((device_ns - self._device_ns) * (1.0 + self._stamps.clock.rate))
        self._device_ns = device_ns
        self._heeded += 1
        self.heeded.append((device_ns, at))
        if moved and not any(self._is_near(way, at, near_ns) for way in self.ways):
            for way in self.ways:
                way.at = None
        elif known:
            self._compare(passed, before, 2 * near_ns)
        self._exclude()
        if len(self.ways) > 1:
            self._seek_help()

    def _place(self, way: Placing, at: Instant, received_at: Instant, near_ns: int, moved: bool) -> bool:
        """Find the SYNC of a reading by one way; whether there is one."""
        at = Instant(at + way.offset_ns)
        mark = self._syncs.nearest(at)
        if received_at - at < self._transit - near_ns and not moved:
            self.surprised = True
            way.too_soon += 1
            way.out = way.out or way.too_soon >= TOO_SOON
        way.at = None if mark is None else mark.on_bus_at
        if way.at is None or abs(at - way.at) > self._period // 2:
            way.at = None
            return False
        if way.delays_seen < DELAYS_MAX and not moved:
            way.delays.add(received_at - way.at)
            way.delays_seen += 1
            if way.steps and way.delays_seen >= DELAYS_MIN:
                slack = self._slack + way.delays.slack() + near_ns
                if abs(way.delays.low - self._low) > slack:
                    self._set_again(way)
        return True

    def _is_near(self, way: Placing, at: Instant, near_ns: int) -> bool:
        """Return whether the stamp at ``at`` lies on its SYNC by one way."""
        return way.at is not None and abs(at + way.offset_ns - way.at) <= near_ns

    def _set_again(self, way: Placing) -> None:
        """The delays of a way in which the clock was set are others than before, by whole periods: it was set
        once more meanwhile. By less than half a period that explains nothing, and the way is out."""
        periods = round((way.delays.low - self._low) / self._spacing)
        offset_ns = round(way.offset_ns + periods * self._spacing)
        if periods == 0 or any(abs(other.offset_ns - offset_ns) < self._period // 2 for other in self.ways):
            way.out = True
        else:
            way.anew(offset_ns)
            self._changes = 0
            for other in self.ways:
                other.stamps_squared = other.product = other.syncs_squared = 0.0

    def _compare(self, stamps_ns: int, before: list[Instant | None], near_ns: int) -> None:
        """Stamps have moved by ``stamps_ns`` since the SYNCs ``before``. What no way explains to within
        ``near_ns`` is another step of the clock, and tells nothing."""
        moves = [
            way.at - last_at
            for way, last_at in zip(self.ways, before, strict=True)
            if way.at is not None and last_at is not None
        ]
        if len(moves) < len(self.ways) or min(abs(stamps_ns - move) for move in moves) > near_ns:
            return
        self._changes += 1
        for way, move in zip(self.ways, moves, strict=True):
            periods = self._spacing * round(move / self._spacing)
            stamps, syncs = stamps_ns - periods, move - periods
            way.stamps_squared += stamps * stamps
            way.product += stamps * syncs
            way.syncs_squared += syncs * syncs

    def _exclude(self) -> None:
        if len(self.heeded) < HEEDED_MIN:
            return  # a map that is moved by fewer goes astray
        left = [way for way in self.ways if not way.out]
        if self._changes >= HEEDED_MIN and left:
            unexplained = [way.unexplained for way in left]
            scatter = 2.0 * max(2.0 * self._stamps.variance_ns2, min(unexplained) / self._changes)
            most = min(unexplained) + EXCLUDING * scatter
            left = [way for way, each in zip(left, unexplained, strict=True) if each <= most]
        self.ways = left or self.ways

    def _seek_help(self) -> None:
        """Let a SYNC go out late, and say that it has come to this."""
        apart = PROBE_AGAIN_AFTER if self._heeded < PROBES_FREQUENT else PROBES_FREQUENT
        if self._heeded % apart == PROBE_AFTER:
            self.wants_probe = True
        if self._heeded == HELD_MAX and not self._told:
            self._told = True
            by_us = " or ".join(f"{-way.offset_ns / NS_PER_US:+.0f}" for way in self.ways[1:])
            self._tell(
                "the SYNC is too regular to decide whether its clock was set or the delay of its readings has"
                f" changed ({by_us} us): they are marked uncertain"
            )


def _remoteness(way: tuple[int, bool]) -> int:
    return abs(way[0])
