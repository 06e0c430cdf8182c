"""Whether what a drive sends by its own clock comes later than it did, as readings that are longer on their
way do: SYNCs at equal distances do not tell a delay that grew by whole periods from losses.

    statuswords    |         |         |         |            |       every 25 ms, whatever the SYNCs do
    readings       ||||||||||||||||||||||||||  ||||||||||||||||||
                                             two are missing, and the next statusword comes two periods late:
                                             none was lost
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from servobench.drivers.timebase import Duration, Instant

KEPT: Final = 32
"""The last beats that are remembered."""
KNOWN: Final = 16
"""Those of them, before the readings in question, whose line says when the next ones are due."""
KNOWN_MIN: Final = 4
"""As few make such a line; through fewer it runs as steeply as the timer was set."""
LATE_MIN: Final = 2
"""So many show that all are late: one may have been held up."""
PARTS: Final = 4
"""By such a part of a period one may be off further than others: it is no whole one."""


class Beats:
    """When the statuswords of one drive came that it sends by a timer."""

    def __init__(self, period: Duration, timer: Duration) -> None:
        """``period``: of the SYNCs. ``timer``: of the drive; 0: it sends them with its readings."""
        self._period = period
        self._timer = timer
        self._came: list[Instant] = []
        self._last_at = Instant(0)
        self._asked = Instant(0), Instant(0), Instant(0)
        """What the last answer was to, and the beat that it rests on."""
        self._answer: int | None = None

    def take(self, at: Instant) -> None:
        """The last one came then."""
        if at != self._last_at and self._timer:
            self._last_at = at
            self._came.append(at)
            if len(self._came) > KEPT:
                del self._came[0]

    def periods_late(self, before: Instant, after: Instant, spread: int) -> int | None:
        """Return by how many periods those that came ``after`` are late, by those from ``before``; None if
        they do not say. ``spread``: of the delays of readings."""
        asked = before, after, self._last_at
        if asked != self._asked:
            self._asked = asked
            known = self._even([at for at in self._came if at < before])
            later = [at for at in self._came if at > after]
            self._answer = self._late(known, later, spread) if known and later else None
        return self._answer

    def _even(self, came: Sequence[Instant]) -> list[Instant]:
        """Return the last ones that came at whole distances: a change of the statusword is told at once, and
        the timer begins anew."""
        usual = self._usual_gap(came)
        even: list[Instant] = []
        for at in came:
            gap = at - even[-1] if even else usual
            if 4 * gap < usual:  # a copy, or a change
                continue
            places = (2 * gap + usual) // (2 * usual)
            if abs(gap - places * usual) > self._period // PARTS:
                even.clear()
            even.append(at)
        return even[-KNOWN:]

    def _usual_gap(self, came: Sequence[Instant]) -> int:
        gaps = sorted(at - last for last, at in pairwise(came))
        return max(1, gaps[len(gaps) // 2]) if len(gaps) >= KNOWN_MIN else self._timer

    def _late(self, known: Sequence[Instant], later: Sequence[Instant], spread: int) -> int | None:
        places, count = _places([*known, *later], self._usual_gap(known)), len(known)
        came = [float(at - known[0]) for at in (*known, *later)]
        few = count < KNOWN_MIN
        off = _off_line(places, came, count, float(self._timer) if few else _slope(places, came, count))
        low, high = min(off[:count]), max(off[:count])
        wide = max(high - low, float(spread)) if few else high - low
        if 2.0 * wide > self._period:
            return None
        least = min(off[count:])  # those that are copies, or were held up, come later
        if abs(least - low) < self._period / 2.0:
            return 0
        late = round((least - (low + high) / 2.0) / self._period)
        beyond = abs(least - (low + high) / 2.0 - late * self._period)
        within = self._period / PARTS + wide / 2.0
        return late if len(later) >= LATE_MIN and beyond <= within else None


def _places(came: Sequence[Instant], usual: int) -> list[int]:
    """Return which beat each is; one that is missing has a place as well."""
    places = [0]
    for last, at in pairwise(came):
        places.append(places[-1] + (2 * (at - last) + usual) // (2 * usual))
    return places


def _slope(places: Sequence[int], came: Sequence[float], count: int) -> float:
    """Return by how much a beat comes later than the one before, ns, on the line through the first ones."""
    middle, mean = sum(places[:count]) / count, sum(came[:count]) / count
    wide = sum((place - middle) ** 2 for place in places[:count])
    return sum((places[each] - middle) * (came[each] - mean) for each in range(count)) / max(1.0, wide)


def _off_line(places: Sequence[int], came: Sequence[float], count: int, slope: float) -> list[float]:
    """Return by how much each lies behind the line through the middle of the first ``count``, ns."""
    middle, mean = sum(places[:count]) / count, sum(came[:count]) / count
    return [at - mean - slope * (place - middle) for at, place in zip(came, places, strict=True)]
