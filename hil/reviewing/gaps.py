"""Gaps between readings, in bounded memory: where the line of what was read has to be interrupted.

    readings    . . . .         . . .
    cycles      | | | | | | | | | | |
    gap                 |------>|       begins where the first reading is due that did not come

Of many gaps the longest of each bucket is kept, as of any envelope.
"""

import numpy as np
from numpy.typing import NDArray

from servobench.hil.reviewing.envelope import Envelope, Points, bucket_width_ns


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
