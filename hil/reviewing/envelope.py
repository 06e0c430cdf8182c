"""Signals of any length in bounded memory: the largest value and its instant; the least and the largest row
of each of some thousand buckets.

    rows       .  : .'.   .  :'  .  .     :
    buckets   |        |        |         |     2 to the power of k ns wide, counted from the time zero
    kept         :  '      :  .   .       :     least and largest of each, with their own instants

What is kept are rows as they were, so a peak of one cycle is seen in an hour. A bucket twice as wide is made
of two buckets, so any division of the rows into chunks keeps the same rows.

Gaps between readings, in bounded memory: where the line of what was read has to be interrupted.

    readings    . . . .         . . .
    cycles      | | | | | | | | | | |
    gap                 |------>|       begins where the first reading is due that did not come

Of many gaps the longest of each bucket is kept, as of any envelope.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray


class Largest:
    """The largest value so far, and when it was first so large."""

    def __init__(self) -> None:
        self.value: float | None = None
        self.at: int | None = None
        """None: there was no value yet."""

    def look(self, times: NDArray[np.int64], values: NDArray[np.float64 | np.int64]) -> None:
        """Take in instants, (n,) ns, and values, (n,)."""
        if values.size:
            place = int(values.argmax())
            self.note(int(times[place]), float(values[place]))

    def note(self, at: int, value: float) -> None:
        """Take in one value."""
        if self.value is None or value > self.value:
            self.value, self.at = value, at


def largest(values: Iterable[float | None]) -> float | None:
    """Return the largest of the measured values; None if none was measured."""
    return max((value for value in values if value is not None), default=None)


BUCKETS: Final = 4_000
"""Two for each pixel of the widest plot on a screen of 1920."""
LANE_BUCKETS: Final = 800
"""Buckets of a lane of states: one is two pixels wide there, and so seen."""
_NARROWEST_NS: Final = 1 << 16
"""65 us, shorter than any cycle: a short run keeps every row."""
_SLACK: Final = 8
"""So many times what is to be kept comes together before it is reduced."""

Points = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Instants, (n,) ns, and values, (n,)."""


def bucket_width_ns(first: int, last: int, buckets: int = BUCKETS) -> int:
    """Return the width of buckets of which at most ``buckets`` + 1 hold the instants from ``first`` to
    ``last``."""
    width = _NARROWEST_NS
    while (last - first) // width >= buckets:
        width *= 2
    return width


class Envelope:
    """Envelope of one signal; rows in order of time."""

    def __init__(self) -> None:
        self._times: list[NDArray[np.int64]] = []
        self._values: list[NDArray[np.float64]] = []
        self._held = 0

    def add(self, times: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Take in instants, (n,) ns, and values, (n,); what is no number is left out."""
        known = ~np.isnan(values)
        if not known.any():
            return
        # a mask makes copies: what is handed in may lie in a ring
        self._times.append(times[known])
        self._values.append(values[known])
        self._held += self._times[-1].size
        if self._held > 2 * BUCKETS * _SLACK:
            self._reduce()

    def points(self) -> Points:
        """Least and largest row of each bucket, in order of time."""
        self._reduce()
        if not self._times:
            return np.empty(0, np.int64), np.empty(0)
        return self._times[0], self._values[0]

    def largest(self, share: float = 1.0) -> float | None:
        """Return the value that a ``share`` of the kept rows does not exceed, by size; None: there is no
        row."""
        values = np.abs(self.points()[1])
        return float(np.quantile(values, share, method="inverted_cdf")) if values.size else None

    def ends(self) -> tuple[float, float] | None:
        """Least and largest value; None: there is no row."""
        values = self.points()[1]
        return (float(values.min()), float(values.max())) if values.size else None

    def _reduce(self) -> None:
        if not self._times:
            return
        times, values = np.concatenate(self._times), np.concatenate(self._values)
        bucket = times // bucket_width_ns(int(times[0]), int(times[-1]))
        order = np.lexsort((values, bucket))
        starts = np.flatnonzero(np.diff(bucket, prepend=bucket[0] - 1))
        ends = np.append(starts[1:], bucket.size) - 1
        kept = np.sort(np.concatenate((order[starts], order[ends])))
        kept = kept[np.diff(kept, prepend=-1) != 0]
        self._times, self._values, self._held = [times[kept]], [values[kept]], kept.size


class CodeLane:
    """The gravest code in each bucket of a lane, and how many rows have one; 0: nothing to tell."""

    def __init__(self) -> None:
        self._times: list[NDArray[np.int64]] = []
        self._codes: list[NDArray[np.int64]] = []
        self._telling: list[NDArray[np.int64]] = []
        self._rows: list[NDArray[np.int64]] = []
        self._held = 0

    def add(self, times: NDArray[np.int64], codes: NDArray[np.int64]) -> None:
        """Take in instants, (n,) ns, in order, and codes, (n,), of which the largest is the gravest."""
        if not times.size:
            return
        self._times.append(np.array(times, np.int64))
        self._codes.append(np.array(codes, np.int64))
        self._telling.append((self._codes[-1] != 0).astype(np.int64))
        self._rows.append(np.ones(times.size, np.int64))
        self._held += times.size
        if self._held > LANE_BUCKETS * _SLACK:
            self._reduce()

    def changes(self, few: int = 0, share: float = 0.0) -> list[tuple[int, int]]:
        """From which instant on, ns, which code holds; ``few`` more where less than a ``share`` of the rows
        there have one.
        """
        self._reduce()
        if not self._times:
            return []
        times, codes, telling = self._times[0], self._codes[0], self._telling[0]
        codes = codes + few * ((telling > 0) & (telling < share * self._rows[0]))
        return [(int(times[at]), int(codes[at])) for at in np.flatnonzero(np.diff(codes, prepend=-1))]

    def _reduce(self) -> None:
        if not self._times:
            return
        times, codes = np.concatenate(self._times), np.concatenate(self._codes)
        bucket = times // bucket_width_ns(int(times[0]), int(times[-1]), LANE_BUCKETS)
        starts = np.flatnonzero(np.diff(bucket, prepend=bucket[0] - 1))
        self._times, self._codes = [times[starts]], [np.maximum.reduceat(codes, starts)]
        self._telling, self._rows = (
            [np.add.reduceat(np.concatenate(counts), starts)] for counts in (self._telling, self._rows)
        )
        self._held = starts.size


class Gaps:
    """Stretches of cycles without a reading, of one axis."""

    def __init__(self) -> None:
        self._lasted = Envelope()
        self._since: int | None = None

    def add(self, due_at: NDArray[np.int64], dropped: NDArray[np.bool_]) -> None:
        """Take in cycles, (n,), in order of time."""
        if not due_at.size:
            return
        changed = dropped != np.append(self._since is not None, dropped[:-1])
        begins, ends = due_at[changed & dropped], due_at[changed & ~dropped]
        if self._since is not None:
            begins = np.append(self._since, begins)
        self._lasted.add(begins[: ends.size], (ends - begins[: ends.size]).astype(np.float64))
        self._since = int(begins[-1]) if dropped[-1] else None

    def points(self, end: int) -> Points:
        """Return begins, ns, and how long each lasted, ns; one that is open lasts until ``end``."""
        begins, lasted = self._lasted.points()
        if self._since is None:
            return begins, lasted
        return np.append(begins, self._since), np.append(lasted, float(end - self._since))

    def interrupt(self, points: Points, end: int) -> Points:
        """Put no number into a line of readings, or of their envelope, at each gap that can be seen: one as
        long as two points of an envelope lie apart."""
        times, values = points
        if not times.size:
            return points
        begins, lasted = self.points(end)
        seen = begins[lasted >= bucket_width_ns(int(times[0]), int(times[-1]))]
        places = np.searchsorted(times, seen)
        return np.insert(times, places, seen), np.insert(values, places, np.nan)
