"""The map between a drive's clock and the host's.

A drive latches its actual values when a SYNC ends, and stamps them with its own clock; the end of that SYNC
is known on the host's clock, from its echo:

    host    --- b(k) ------------------- b(k+1) ---------------->   end of SYNC k on the bus
    drive   --- d(k) ------------------- d(k+1) ---------------->   stamp: other origin, other rate

The map is a straight line that is followed by a Kalman filter of two states, offset and rate. Which SYNC a
stamp belongs to, and whether a stamp that lies off the line may move it, is decided elsewhere
(:mod:`servobench.hil.loop.attribution`). No rate is too large to be followed.

Lessons of an axis while it is calibrated: readings that can only answer one SYNC.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from servobench.drivers.core.native import nearest
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration, Instant
from servobench.hil.loop.syncs import STAMPED_LATE, SyncLog, SyncMark

_round: Final = nearest
"""A module constant: found without a look-up where compiled."""
STAMP_RESOLUTION: Final = Duration(NS_PER_US)
"""1013h counts whole microseconds, rounded down (CiA 301 7.5.2.16); makers differ."""
STEP_SHOWS: Final = 50
"""So small a part of a step shows that instants are on no common grid of it, and stamps on it coarse,"""
STEP_SHOWS_NS: Final = 3 * NS_PER_US
"""and so much does of any: more than two roundings to a microsecond hide."""
_RATE_WALK: Final = 1e-11
"""How fast the rate of a quartz clock wanders, (ns/ns)^2 per s: 3 ppm in a second, faster than that of a
clock being warmed, so that the filter never falls asleep."""
RATE_MAX: Final = 2e-3
"""By which a clock may be expected to be off: 2000 ppm, ten times a poor quartz."""
_FIRST_RATE_VARIANCE: Final = RATE_MAX**2
"""Before anything is known of the rate."""


class ClockMap:
    """Host instant = ``offset`` + (1 + ``rate``) * stamp, both followed from stamp to stamp."""

    def __init__(self, resolution: Duration = STAMP_RESOLUTION) -> None:
        """``resolution``: of a stamp, which is rounded down to a multiple of it."""
        self.set_resolution(resolution)
        self.ready = False
        """True if at least one stamp with its SYNC has been seen."""
        self._device_ns = 0
        self._host_ns = 0
        self._part_ns = 0.0
        """Remainder that ``_host_ns``, a whole number, lacks."""
        self._rate = 0.0
        self._offset_var = 0.0
        self._cross = 0.0
        self._rate_var = 0.0

    def set_resolution(self, resolution: Duration) -> None:
        """Stamps from now on are rounded down to a multiple of ``resolution``."""
        self.resolution = self.off_most = resolution
        self._rounding_variance = resolution**2 / 12.0
        """Variance of a value that is equally likely anywhere in a step, ns^2."""

    @property
    def drift_ppm(self) -> float:
        """How much faster the drive's clock runs than the host's (negative: slower), parts per million."""
        return (1.0 / (1.0 + self._rate) - 1.0) * 1e6

    @property
    def rate(self) -> float:
        """By how much more than a nanosecond of the host passes in one of the drive's, ns/ns."""
        return self._rate

    @property
    def drift_error_ppm(self) -> float:
        """Two standard deviations of it."""
        return 2.0 * math.sqrt(self._rate_var) * 1e6

    @property
    def offset_ns(self) -> int:
        """Host minus device, at the last stamp."""
        return self._host_ns - self._device_ns

    @property
    def error_ns(self) -> int:
        """Error of a placed instant: the resolution of a stamp and four standard deviations of the line."""
        return self.off_most + int(4.0 * math.sqrt(self._offset_var))

    def since_last(self, device_ns: int) -> int:
        """How long after the last stamp that the line has followed this one is, on the drive's clock."""
        return device_ns - self._device_ns

    def place(self, device_ns: int) -> Instant:
        """The host's instant of a device stamp. Needs :attr:`ready`."""
        passed = device_ns - self._device_ns
        return Instant(self._host_ns + passed + _round(self._part_ns + self._rate * passed))

    def observe(self, device_ns: int, host_ns: Instant, variance_ns2: float) -> None:
        """A stamp whose host instant is known; ``variance_ns2``: of that instant, beside a stamp's rounding.

        A stamp older than the last one teaches nothing, as the line has passed it.
        """
        if not self.ready:
            self.ready = True
            self._device_ns, self._host_ns, self._part_ns, self._rate = device_ns, int(host_ns), 0.0, 0.0
            self._offset_var = self._rounding_variance + variance_ns2
            self._cross, self._rate_var = 0.0, _FIRST_RATE_VARIANCE
            return
        passed = device_ns - self._device_ns
        if passed <= 0:
            return
        dt = float(passed)
        moved = self._part_ns + self._rate * dt
        # P <- A P A' + Q with A = [1 dt; 0 1]; the rate's wandering enters through itself alone.
        offset_var = self._offset_var + dt * (2.0 * self._cross + dt * self._rate_var)
        cross = self._cross + dt * self._rate_var
        rate_var = self._rate_var + _RATE_WALK * dt / NS_PER_S
        innovation = float(host_ns - self._host_ns - passed) - moved
        spread = offset_var + self._rounding_variance + variance_ns2
        gain, rate_gain = offset_var / spread, cross / spread
        part = moved + gain * innovation
        whole = math.floor(part)
        self._device_ns = device_ns
        self._host_ns += passed + whole
        self._part_ns = part - whole
        self._rate += rate_gain * innovation
        self._offset_var = (1.0 - gain) * offset_var
        self._cross = (1.0 - gain) * cross
        self._rate_var = rate_var - rate_gain * cross

    def shift(self, by_ns: int) -> None:
        """Move the line: placed instants are later by ``by_ns`` from now on."""
        self._host_ns += by_ns

    def start_anew(self, pairs: Sequence[tuple[int, Instant]], variance_ns2: float) -> None:
        """Forget the line, and learn it from (stamp, host instant) pairs in order of their stamps."""
        self.ready = False
        for device_ns, host_ns in pairs:
            self.observe(device_ns, host_ns, variance_ns2)

    def move_to(self, pairs: Sequence[tuple[int, Instant]], variance_ns2: float) -> None:
        """The clock was set, and runs as fast as before: the line goes through these (stamp, host instant)
        pairs in order of their stamps."""
        last_ns, last_at = pairs[-1]
        moved = [(at - last_at) - (device - last_ns) * (1.0 + self._rate) for device, at in pairs]
        self._device_ns, self._host_ns = last_ns, int(last_at)
        self._part_ns = sum(moved) / len(moved)
        span = float(last_ns - pairs[0][0])
        self._cross = 0.0
        self._offset_var = (self._rounding_variance + variance_ns2) / len(
            pairs
        ) + self._rate_var * span * span


def residuals_of(pairs: Sequence[tuple[int, Instant]]) -> list[int]:
    """By how much the straight line through all (stamp, host instant) pairs, by least squares, places each
    stamp later than its host instant, ns."""
    return _fitted(pairs)[1]


def _fitted(pairs: Sequence[tuple[int, Instant]]) -> tuple[float, list[int]]:
    """The slope of that line, and by how much it places each stamp later."""
    device_ns, host_ns = pairs[0]
    xs = [float(device - device_ns) for device, _ in pairs]
    ys = [float(host - host_ns) for _, host in pairs]
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    spread = sum((x - mean_x) ** 2 for x in xs)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in zip(xs, ys, strict=True)) / spread if spread else 1.0
    return slope, [round(mean_y + slope * (x - mean_x) - y) for x, y in zip(xs, ys, strict=True)]


def evenly_spaced(pairs: Sequence[tuple[int, Instant]], period: int) -> Sequence[tuple[int, Instant]]:
    """(stamp, host instant) pairs of SYNCs that come every ``period`` ns, with instants at equal distances;
    as they are if two of them have stamps of one period."""
    device_ns, host_ns = pairs[0]
    places = [round((device - device_ns) / period) for device, _ in pairs]
    if any(later <= earlier for earlier, later in pairwise(places)):
        return pairs
    return [
        (device, Instant(host_ns + place * period)) for (device, _), place in zip(pairs, places, strict=True)
    ]


def step_of(pairs: Sequence[tuple[int, Instant]]) -> int:
    """By how much the stamps of (stamp, host instant) pairs advance at a time, ns; 0 if that does not show.

    The greatest common divisor of their differences, unless the host instants have it too, but for a clock's
    rate: stamps that advance as they do, say by whole periods, may do so in steps of any size.
    """
    device_ns, _ = pairs[0]
    step = math.gcd(*(device - device_ns for device, _ in pairs))
    if step == 0:
        return 0
    slope, residuals = _fitted(pairs)
    off = max(abs(residual) for residual in residuals)
    return step if off > min(step // STEP_SHOWS, STEP_SHOWS_NS) or abs(slope - 1.0) > RATE_MAX else 0


STANDS_STILL: Final = 3
"""Equal stamps of SYNCs that were learned from in a row: one may be a frame that came twice."""
ALIKE_PARTS: Final = 3
"""So small a part of readings, of those that are most alike, is alike by a cause that goes on: delays that
spread about a period have some behind the next SYNC."""
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
        """Let go of readings that came behind the next SYNC and were taken for that one's, and of those of a
        drive that stood still; whether there were any. By the stamps the SYNCs of the former are a period
        later than those of the others, of the latter earlier, and few of these are alike."""
        offsets = [
            mark.on_bus_at - reading.device_time_ns
            for reading, mark in self.pairs
            if mark.on_bus_at is not None and reading.device_time_ns is not None
        ]
        half = period // 2
        lacks = self.stamp_stands_still or len(offsets) < len(self.pairs)
        if lacks or max(offsets, default=0) - min(offsets, default=0) < half:
            return False
        alike = [(sum(least <= offset < least + half for offset in offsets), least) for least in offsets]
        most = max(alike)[0]
        first = min(least for count, least in alike if ALIKE_PARTS * count >= most)
        self.pairs = [
            pair for pair, offset in zip(self.pairs, offsets, strict=True) if first <= offset < first + half
        ]
        return True
