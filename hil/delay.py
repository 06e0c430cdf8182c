"""What became of each SYNC's reading, and how long it took.

    SYNC        1      2      3      4      5
    reading     |--1   |------:---2  |--4   |--5
    fate        used   late   lost   used   used       ':' is the deadline

A sequence keeps its place until its reading has come or the horizon has passed;
fates are handed out in order of sequence.
"""

from typing import Final

from drivers.timebase import Duration, Instant
from hil.samples import Dropout, DropoutCause, Observation, Sample

UNKNOWN_DELAY: Final = Duration(-1)


class Fate:
    """The end of one sequence."""

    __slots__ = ("delay", "observation", "sequence")

    def __init__(self, sequence: int, observation: Observation, delay: Duration) -> None:
        """``delay``: sampled to received; :data:`UNKNOWN_DELAY` if it never came."""
        self.sequence = sequence
        self.observation = observation
        self.delay = delay


class _Outstanding:
    """A SYNC whose reading is still awaited, or has come but waits for earlier ones."""

    __slots__ = ("due_at", "fate", "sequence")

    def __init__(self, sequence: int, due_at: Instant) -> None:
        self.sequence = sequence
        self.due_at = due_at
        self.fate: Fate | None = None


class DelayMeter:
    """Follows the readings of one axis from SYNC to fate."""

    def __init__(self, deadline: Duration, horizon: int) -> None:
        """``deadline``: oldest usable age on arrival; ``horizon``: SYNCs after which one is lost."""
        self._deadline = deadline
        self._horizon = horizon
        self._outstanding: list[_Outstanding] = []
        self._newest = 0
        self._typical_ns = 0.0
        self.unmatched = 0
        """Readings that answered no outstanding SYNC: duplicates, or later than the horizon."""

    @property
    def typical_delay(self) -> Duration:
        """Running median of the delay, ns; 0 before the first reading."""
        return Duration(int(self._typical_ns))

    @property
    def newest(self) -> int:
        """Largest sequence of which a reading has come; 0 before the first."""
        return self._newest

    def sync_sent(self, sequence: int, due_at: Instant) -> None:
        """A SYNC has gone out; sequences must rise."""
        self._outstanding.append(_Outstanding(sequence, due_at))

    def arrived(self, sample: Sample) -> bool:
        """A reading has come; whether the loop may use it."""
        sequence, reading, sampled_at, _ = sample
        place = self._find(sequence)
        if place is None or place.fate is not None:
            self.unmatched += 1
            return False
        delay = Duration(reading.received_at - sampled_at)
        self.learn(delay)
        cause = None
        if delay > self._deadline:
            cause = DropoutCause.LATE
        elif sequence < self._newest:
            cause = DropoutCause.STALE
        observation: Observation = sample
        if cause is not None:
            observation = Dropout(sequence, Instant(place.due_at + self._deadline), cause)
        self._newest = max(self._newest, sequence)
        place.fate = Fate(sequence, observation, delay)
        return cause is None

    def settle(self) -> list[Fate]:
        """The fates that have become final since the last call, in order of sequence."""
        outstanding = self._outstanding
        fates: list[Fate] = []
        while outstanding:
            fate = outstanding[0].fate
            if fate is None:
                if len(outstanding) <= self._horizon:
                    break
                fate = self._lost(outstanding[0])
            fates.append(fate)
            outstanding.pop(0)
        return fates

    def settle_all(self) -> list[Fate]:
        """End of the run: what has not come by now is lost."""
        fates = [place.fate or self._lost(place) for place in self._outstanding]
        self._outstanding.clear()
        return fates

    def _find(self, sequence: int) -> _Outstanding | None:
        if not self._outstanding:
            return None
        index = sequence - self._outstanding[0].sequence
        if 0 <= index < len(self._outstanding):
            return self._outstanding[index]
        return None

    def _lost(self, place: _Outstanding) -> Fate:
        dropout = Dropout(place.sequence, Instant(place.due_at + self._deadline), DropoutCause.LOST)
        return Fate(place.sequence, dropout, UNKNOWN_DELAY)

    def learn(self, delay: Duration) -> None:
        """Take a delay into :attr:`typical_delay`.

        Median by stochastic approximation: a step up or down, as long as a twentieth of the value.
        """
        if self._typical_ns == 0.0:
            self._typical_ns = float(delay)
            return
        step = self._typical_ns / 20.0
        difference = delay - self._typical_ns
        self._typical_ns += min(max(difference, -step), step)
