"""A histogram of times in bounded memory: exact below 2 us, within 0.1 % above."""

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_US

_MANTISSA_BITS = 10
"""A bucket is 1/1024 of its octave's begin wide, and a figure off by half of it."""
_BUCKETS_PER_OCTAVE = 1 << _MANTISSA_BITS
_LARGEST_BITS = 50
"""13 days; the buckets up to there take 330 KB, those up to a millisecond 88."""
_LARGEST_NS = (1 << _LARGEST_BITS) - 1


class TimeHistogram:
    """Counts times from 0 to 2^50 ns (13 days); shorter ones count as 0, longer ones as the largest."""

    def __init__(self) -> None:
        self._counts: NDArray[np.int64] = np.zeros(0, np.int64)
        """Of whole octaves, up to that of the largest time: a campaign's run makes some twenty histograms."""
        self.total = 0
        self._smallest_ns = _LARGEST_NS
        self._largest_ns = 0

    def add(self, times_ns: NDArray[np.int64]) -> None:
        """Take in times: (n,) ns."""
        if not times_ns.size:
            return
        clipped = np.clip(times_ns, 0, _LARGEST_NS)
        places = _bucket_of(clipped)
        first = int(places.min())
        counts = np.bincount(places - first)
        self._reach(first + counts.size)
        self._counts[first : first + counts.size] += counts
        self.total += clipped.size
        self._smallest_ns = min(self._smallest_ns, int(clipped.min()))
        self._largest_ns = max(self._largest_ns, int(clipped.max()))

    @property
    def largest_ns(self) -> int | None:
        """The largest time, exactly; None if there was none."""
        return self._largest_ns if self.total else None

    def quantile_ns(self, share: float) -> float | None:
        """The smallest time that a ``share`` (0..1] of all does not exceed (nearest rank); None if empty."""
        if not self.total:
            return None
        rank = max(1, math.ceil(share * self.total))
        first, last = _bucket_of(np.array([self._smallest_ns, self._largest_ns])).tolist()
        place = first + int(np.searchsorted(np.cumsum(self._counts[first : last + 1]), rank))
        low, width = _bucket_range(place)
        return float(min(max(low + (width - 1) / 2, self._smallest_ns), self._largest_ns))

    def bars(self, width_ns: int, count: int) -> NDArray[np.int64]:
        """The counts of ``count`` equal bars from 0 up; what lies beyond them is in the last: (count,)."""
        filled = np.flatnonzero(self._counts)
        middles = [low + (width - 1) // 2 for low, width in map(_bucket_range, filled.tolist())]
        places = np.minimum(np.asarray(middles, np.int64) // width_ns, count - 1)
        heights = np.zeros(count, np.int64)
        np.add.at(heights, places, self._counts[filled])
        return heights

    def take_in(self, other: "TimeHistogram") -> None:
        """Add the counts of another histogram."""
        self._reach(other._counts.size)
        self._counts[: other._counts.size] += other._counts
        self.total += other.total
        self._smallest_ns = min(self._smallest_ns, other._smallest_ns)
        self._largest_ns = max(self._largest_ns, other._largest_ns)

    def _reach(self, buckets: int) -> None:
        """Have at least so many buckets."""
        if buckets > self._counts.size:
            added = -(-(buckets - self._counts.size) // _BUCKETS_PER_OCTAVE) * _BUCKETS_PER_OCTAVE
            self._counts = np.concatenate((self._counts, np.zeros(added, np.int64)))


def merged(histograms: Iterable[TimeHistogram]) -> TimeHistogram:
    """All that they have counted."""
    histogram = TimeHistogram()
    for each in histograms:
        histogram.take_in(each)
    return histogram


def _bucket_of(times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """One bucket for each ns below 2^11; above, 2^10 equal buckets in each octave."""
    _, bits = np.frexp(times_ns.astype(np.float64))
    shift = np.maximum(bits.astype(np.int64) - (_MANTISSA_BITS + 1), 0)
    places: NDArray[np.int64] = shift * _BUCKETS_PER_OCTAVE + (times_ns >> shift)
    return places


def _bucket_range(place: int) -> tuple[int, int]:
    """Smallest time and width of a bucket, ns; inverse of :func:`_bucket_of`."""
    shift = max(place // _BUCKETS_PER_OCTAVE - 1, 0)
    return (place - shift * _BUCKETS_PER_OCTAVE) << shift, 1 << shift


def round_width(width_ns: float) -> int:
    """The next of 1, 2, 5 times a power of ten us that is not smaller."""
    power = 10.0 ** math.floor(math.log10(max(width_ns / NS_PER_US, 1.0)))
    factor = next(factor for factor in (1, 2, 5, 10) if factor * power * NS_PER_US >= width_ns)
    return int(factor * power) * NS_PER_US
