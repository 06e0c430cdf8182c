"""Unevenness of SYNCs, and which of them the readings follow.

    SYNC ends    1      2         3      4      5         1 to 2, 2 to 3, ... are of different lengths
    readings       |r     |r        |r     |r     |r      they follow the SYNC before them: lag 0
                          |r     |r        |r     |r      the one before that: lag 1

With the right lag the delays of readings are as even as the network has them, with a wrong one what is uneven
in the SYNCs is in them too. SYNCs at equal distances say nothing.
"""

import math
from typing import Final

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.syncs import SyncLog, SyncMark
from servobench.hil.loop.usual_delays import RARE, RESOLUTION_NS

WATCHED: Final = 64
"""Readings that are weighed: rows wait for no more."""
LAGS_MAX: Final = 32
"""Lags that are told apart."""
EXCLUDING: Final = 12.0
"""A lag is none if another is e^12, 160 000 times, likelier: it is asked hundreds of times in a run."""
HALF: Final = 2
"""While no more than one of so many comes too soon for a lag, it is none to decide for, but possible yet."""
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
        self._places: list[int] = []
        """Place of the SYNC that each reading answers with lag 0."""
        self._came_at: list[Instant] = []

    def __len__(self) -> int:
        return len(self._places)

    def begin(self, age: int) -> None:
        """Weigh readings that come ``age`` after a SYNC."""
        self._age = age
        self._places.clear()
        self._came_at.clear()

    def restart(self) -> None:
        """Forget the readings, but not how they come."""
        self.begin(self._age)

    def add(self, received_at: Instant) -> int:
        """Take a reading; number of the SYNC that it answers with lag 0. 0: it is the second one of that. If
        the first came too soon for it, that may be another's that was held up, and is forgotten."""
        mark = self._syncs.nearest(Instant(received_at - self._age))
        if mark is None or mark.on_bus_at is None:
            return 0
        if self._places and mark.place <= self._places[-1]:
            if mark.place == self._places[-1] and self._came_at[-1] - mark.on_bus_at < self._soonest:
                del self._places[-1], self._came_at[-1]
            return 0
        self._places.append(mark.place)
        self._came_at.append(received_at)
        if len(self._places) > WATCHED:
            del self._places[0], self._came_at[0]
        return mark.number

    def delays(self, lag: int) -> list[int]:
        """Those with this lag whose SYNC was heard; none if the readings cannot have it. Below 0 they answer
        later SYNCs, and few come sooner than their frame can, which are others' that were held up."""
        delays = _known(self._delays(lag, self._by_place()))
        return delays if self._may_have(lag, delays, RARE) else []

    def _by_place(self) -> dict[int, SyncMark]:
        return {mark.place: mark for mark in self._syncs.marks}

    def _delays(self, lag: int, by_place: dict[int, SyncMark]) -> list[int | None]:
        """Of each reading with this lag; None where its SYNC was not heard. None at all if they would answer
        a SYNC that was never on the bus, or is yet to come."""
        of_another, oldest = self._syncs.of_another, self._syncs.marks[0].place
        delays: list[int | None] = []
        for place, came_at in zip(self._places, self._came_at, strict=True):
            mark = by_place.get(place - lag)
            if mark is not None and mark.on_bus_at is not None:
                delays.append(came_at - mark.on_bus_at)
            elif place - lag < oldest or not (of_another if mark is None else mark.hidden):
                return []
            else:
                delays.append(None)
        return delays

    def _may_have(self, lag: int, delays: list[int], few: int) -> bool:
        """Return whether at most one of so ``few`` readings comes sooner with this lag than its frame can.
        The SYNC before a reading may be none of its own either, but where its echo was stamped late."""
        if lag > 0:
            return True
        soonest = self._soonest - self._syncs.late_most
        return few * sum(delay < soonest for delay in delays) <= len(delays)

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
        by_place = self._by_place()
        of_lags = {lag: self._delays(lag, by_place) for lag in range(least_lag, min(lags, LAGS_MAX))}
        known = {lag: _known(delays) for lag, delays in of_lags.items() if delays}
        likely = [lag for lag, delays in known.items() if delays and self._may_have(lag, delays, RARE)]
        if not likely or len(self) < 2:
            return None
        least_deviation = min(_deviation(known[lag]) for lag in likely)
        variance = max(deviation_ns, RESOLUTION_NS, self._syncs.error_ns // 3, least_deviation) ** 2.0
        most = (OUTLYING_UNTIDY if untidy else OUTLYING) ** 2 / 2.0
        misfits = {
            lag: _misfits(of_lags[lag], delays, variance, most)
            for lag, delays in known.items()
            if self._may_have(lag, delays, HALF)
        }
        best = min(likely, key=lambda lag: _mean(misfits[lag]))
        others = (each for lag, each in misfits.items() if lag != best)
        return best if all(_excess(each, misfits[best]) > EXCLUDING for each in others) else None


def _deviation(delays: list[int]) -> float:
    middle = sorted(delays)[len(delays) // 2]
    return math.sqrt(sum(float(delay - middle) ** 2 for delay in delays) / max(1, len(delays) - 1))


def _misfits(delays: list[int | None], known: list[int], variance: float, most: float) -> list[float | None]:
    """Return for each reading the logarithm of how much likelier even delays would be."""
    middle = sorted(known)[len(known) // 2] if known else 0
    return [
        None if delay is None else min(float(delay - middle) ** 2 / variance / 2.0, most) for delay in delays
    ]


def _known(delays: list[int | None]) -> list[int]:
    return [delay for delay in delays if delay is not None]


def _mean(misfits: list[float | None]) -> float:
    known = [each for each in misfits if each is not None]
    return sum(known) / len(known)


def _excess(misfits: list[float | None], least: list[float | None]) -> float:
    """By how much ``misfits`` exceed the ``least``, of the readings that both know."""
    both = zip(misfits, least, strict=True)
    return sum(each - other for each, other in both if each is not None and other is not None)
