"""What is uneven in SYNCs, and which of them the readings follow.

    SYNC ends    1      2         3      4      5         1 to 2, 2 to 3, ... are of different lengths
    readings       |r     |r        |r     |r     |r      they follow the SYNC before them: lag 0
                          |r     |r        |r     |r      the one before that: lag 1

With the right lag the delays of readings are as even as the network has them, with a wrong one what is uneven
in the SYNCs is in them too. SYNCs at equal distances say nothing.
"""

import math
from typing import Final

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.loop.usual_delays import RARE, RESOLUTION_NS

WATCHED: Final = 64
"""Readings that are weighed: rows wait for no more."""
LAGS_MAX: Final = 32
"""Lags that are told apart."""
EXCLUDING: Final = 12.0
"""A lag is none if another is e^12, 160 000 times, likelier: it is asked hundreds of times in a run."""
OUTLYING: Final = 6.0
"""Deviations beyond which a reading weighs no more: one alone, e^18 against e^0, decides by a probe."""
OUTLYING_UNTIDY: Final = 4.0
"""The same where frames are held up now and then: two readings decide, at e^8 each."""


class OrderEvidence:
    """Readings of one delay, whole periods aside."""

    def __init__(self, syncs: SyncLog, transit: Duration) -> None:
        """``transit``: no reading comes sooner after its SYNC."""
        self._syncs = syncs
        self._soonest = transit - syncs.error_ns
        self._age = 0
        self._numbers: list[int] = []
        """Of each reading, the SYNC that it answers with lag 0."""
        self._came_at: list[Instant] = []

    def __len__(self) -> int:
        return len(self._numbers)

    def begin(self, age: int) -> None:
        """Weigh readings that come ``age`` after a SYNC."""
        self._age = age
        self._numbers.clear()
        self._came_at.clear()

    def restart(self) -> None:
        """Forget the readings, but not how they come."""
        self.begin(self._age)

    def add(self, received_at: Instant) -> int:
        """Take a reading; number of the SYNC that it answers with lag 0. 0: it is the second one of that."""
        mark = self._syncs.nearest(Instant(received_at - self._age))
        if mark is None or mark.on_bus_at is None or (self._numbers and mark.number <= self._numbers[-1]):
            return 0
        self._numbers.append(mark.number)
        self._came_at.append(received_at)
        if len(self._numbers) > WATCHED:
            del self._numbers[0], self._came_at[0]
        return mark.number

    def delays(self, lag: int) -> list[int]:
        """Of the readings with this lag; none if they would answer a SYNC that was never on the bus, or is
        yet to come. Below 0: they answer later SYNCs, and few come sooner than their frame can, which are
        others' that were held up."""
        marks = self._syncs.marks
        first = marks[0].number + lag
        end = len(marks)
        delays: list[int] = []
        too_soon = 0
        for number, came_at in zip(self._numbers, self._came_at, strict=True):
            place = number - first
            on_bus_at = marks[place].on_bus_at if 0 <= place < end else None
            if on_bus_at is None:
                return []
            too_soon += lag < 0 and came_at - on_bus_at < self._soonest
            delays.append(came_at - on_bus_at)
        return delays if RARE * too_soon <= len(delays) else []

    def usual_delays(self, lag: int) -> list[int]:
        """The same, without those of single readings that were held up."""
        delays = self.delays(lag)
        middle = sorted(delays)[len(delays) // 2]
        off = sorted(abs(delay - middle) for delay in delays)
        most = max(OUTLYING * off[len(off) // 2], float(RESOLUTION_NS))
        return [delay for delay in delays if abs(delay - middle) <= most]

    def verdict(self, least_lag: int, lags: int, deviation_ns: int, untidy: bool) -> int | None:
        """The lag, if the readings leave one of ``least_lag``, ... ``lags`` - 1; ``deviation_ns``: of
        delays as they were; ``untidy``: frames are held up now and then."""
        of_lags = [self.delays(lag) for lag in range(least_lag, min(lags, LAGS_MAX))]
        deviations = [_deviation(delays) for delays in of_lags if delays]
        if not deviations or len(self) < 2:
            return None
        variance = max(deviation_ns, RESOLUTION_NS, self._syncs.error_ns // 3, min(deviations)) ** 2.0
        outlying = OUTLYING_UNTIDY if untidy else OUTLYING
        misfits = [_misfit(delays, variance, outlying) if delays else -1.0 for delays in of_lags]
        least = min(each for each in misfits if each >= 0.0)
        left = [lag for lag, each in enumerate(misfits) if 0.0 <= each <= least + EXCLUDING]
        return least_lag + left[0] if len(left) == 1 else None


def _deviation(delays: list[int]) -> float:
    middle = sorted(delays)[len(delays) // 2]
    return math.sqrt(sum(float(delay - middle) ** 2 for delay in delays) / max(1, len(delays) - 1))


def _misfit(delays: list[int], variance: float, outlying: float) -> float:
    """The logarithm of how much likelier even delays would be."""
    middle = sorted(delays)[len(delays) // 2]
    most = outlying**2
    return sum(min(float(delay - middle) ** 2 / variance, most) for delay in delays) / 2.0
