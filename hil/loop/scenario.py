"""Reference and load torque of an axis over a run.

Which quantity a drive takes as its set-point, by its mode of operation.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol

from librt.strings import read_f64_le
from mypy_extensions import i64

_DOUBLE: Final[i64] = 8
"""Bytes."""


class Quantity(Enum):
    """Quantity of a set-point or a reference."""

    TORQUE = "torque"
    SPEED = "speed"
    POSITION = "position"


class Segment(Protocol):
    """One piece of a reference, in the unit of its quantity: rad/s, rad or N m."""

    @property
    def at_s(self) -> float:
        """When the segment begins, s."""
        ...

    def value(self, elapsed_s: float, start: float) -> float:
        """The reference ``elapsed_s`` after the segment began at ``start``."""
        ...

    def rate(self, elapsed_s: float, start: float) -> float:
        """Its change, in its unit per second, towards later times; a jump has none."""
        ...


@dataclass(frozen=True, slots=True)
class LevelStep:
    """Jump to a level and stay."""

    at_s: float
    level: float

    def value(self, elapsed_s: float, start: float) -> float:  # noqa: ARG002
        return self.level

    def rate(self, elapsed_s: float, start: float) -> float:  # noqa: ARG002
        return 0.0


@dataclass(frozen=True, slots=True)
class Ramp:
    """Go linearly to a level within ``over_s``, then stay."""

    at_s: float
    level: float
    over_s: float

    def value(self, elapsed_s: float, start: float) -> float:
        if elapsed_s >= self.over_s:
            return self.level
        return start + (self.level - start) * (elapsed_s / self.over_s)

    def rate(self, elapsed_s: float, start: float) -> float:
        return 0.0 if elapsed_s >= self.over_s else (self.level - start) / self.over_s


@dataclass(frozen=True, slots=True)
class SCurve:
    """Go to a level within ``over_s``, at rest and without acceleration at both ends, then stay.

    The polynomial of the fifth degree, 10 x^3 - 15 x^4 + 6 x^5 of the way (VDI 2143, 3-4-5): its rate peaks
    at 15/8 of the mean, its second derivative at 10/sqrt(3) of the way per ``over_s`` squared.
    """

    at_s: float
    level: float
    over_s: float

    def value(self, elapsed_s: float, start: float) -> float:
        if elapsed_s >= self.over_s:
            return self.level
        x = elapsed_s / self.over_s
        return start + (self.level - start) * x * x * x * (10.0 + x * (6.0 * x - 15.0))

    def rate(self, elapsed_s: float, start: float) -> float:
        if elapsed_s >= self.over_s:
            return 0.0
        x = elapsed_s / self.over_s
        return (self.level - start) / self.over_s * 30.0 * x * x * (1.0 - x) * (1.0 - x)


@dataclass(frozen=True, slots=True)
class Sine:
    """Swing about the level at which the segment began."""

    at_s: float
    amplitude: float
    frequency_hz: float

    def value(self, elapsed_s: float, start: float) -> float:
        return start + self.amplitude * sine_of_turns(elapsed_s * self.frequency_hz)

    def rate(self, elapsed_s: float, start: float) -> float:  # noqa: ARG002
        cosine = sine_of_turns(elapsed_s * self.frequency_hz + 0.25)
        return 2.0 * math.pi * self.frequency_hz * self.amplitude * cosine


class Table:
    """Points in time, and between them straight or held; before the first that one, after the last the last.

    The piece that was asked for is kept. The next is sought as far on as that one was, and from there in
    steps that double: a million points cost what ten do.
    """

    def __init__(self, at_s: float, times_s: bytes, levels: bytes, held: bool) -> None:
        """``times_s``: (n,), rising, from ``at_s``. ``levels``: (n,). Both doubles, little-endian."""
        self.at_s: Final = at_s
        self._times_s = times_s
        self._levels = levels
        self._held = held
        self._last: i64 = len(times_s) // _DOUBLE - 1
        self._place: i64 = 0
        self._skipped: i64 = 0
        """Points between the last two pieces: so many may lie before the next, too."""
        self._from_s = self._until_s = self._level = self._rise = 0.0
        """The piece at hand: where it begins and ends, the level there, how far it rises."""
        self._enter(-math.inf)

    def value(self, elapsed_s: float, start: float) -> float:  # noqa: ARG002
        if not self._from_s <= elapsed_s < self._until_s:
            self._enter(elapsed_s)
        if self._rise == 0.0:
            return self._level
        return self._level + (elapsed_s - self._from_s) / (self._until_s - self._from_s) * self._rise

    def rate(self, elapsed_s: float, start: float) -> float:  # noqa: ARG002
        if not self._from_s <= elapsed_s < self._until_s:
            self._enter(elapsed_s)
        return 0.0 if self._rise == 0.0 else self._rise / (self._until_s - self._from_s)

    def _enter(self, elapsed_s: float) -> None:
        """Have the piece in which ``elapsed_s`` lies."""
        place = self._place = self._find(elapsed_s)
        self._level, self._rise = read_f64_le(self._levels, _DOUBLE * place), 0.0
        self._from_s, self._until_s = read_f64_le(self._times_s, _DOUBLE * place), math.inf
        if elapsed_s < self._from_s:
            self._from_s, self._until_s = -math.inf, self._from_s
        elif place < self._last:
            self._until_s = read_f64_le(self._times_s, _DOUBLE * place + _DOUBLE)
            if not self._held:
                self._rise = read_f64_le(self._levels, _DOUBLE * place + _DOUBLE) - self._level

    def _find(self, elapsed_s: float) -> i64:
        """The last point that is not later; the first where all are."""
        times_s, place, step = self._times_s, self._place, i64(1)
        ahead = place + self._skipped
        if ahead <= self._last and read_f64_le(times_s, _DOUBLE * ahead) <= elapsed_s:
            place = ahead
        elif read_f64_le(times_s, _DOUBLE * place) > elapsed_s:
            place = 0
        while place + step <= self._last and read_f64_le(times_s, _DOUBLE * (place + step)) <= elapsed_s:
            place += step
            step *= 2
        while step > 1:
            step >>= 1
            if place + step <= self._last and read_f64_le(times_s, _DOUBLE * (place + step)) <= elapsed_s:
                place += step
        self._skipped = place - self._place - 1 if place > self._place else 0
        return place


@dataclass(frozen=True, slots=True)
class Repeated:
    """A table over and over, each time ``advance`` further on: what a cam asks of a shaft."""

    at_s: float
    table: Table
    period_s: float
    advance: float

    def value(self, elapsed_s: float, start: float) -> float:
        turns = math.floor(elapsed_s / self.period_s)
        return turns * self.advance + self.table.value(elapsed_s - turns * self.period_s, start)

    def rate(self, elapsed_s: float, start: float) -> float:
        return self.table.rate(elapsed_s - math.floor(elapsed_s / self.period_s) * self.period_s, start)


class ReferenceProfile:
    """Reference or load torque of one axis: segments in order of time, 0 before the first.

    Of a position the segments count from where the shaft is when the run begins (:meth:`count_from`).
    """

    def __init__(self, segments: Sequence[Segment], quantity: Quantity = Quantity.SPEED) -> None:
        self.quantity: Final = quantity
        self._origin = 0.0
        self._segments = sorted(segments, key=lambda segment: segment.at_s)
        self._starts_s = [segment.at_s for segment in self._segments]
        self._start_levels = self._levels_at_starts()
        self._begun = 0
        """How many segments have begun at the time last asked for, and from when until when that is so."""
        self._from_s = self._until_s = 0.0

    def count_from(self, position_rad: float) -> None:
        """Where the shaft is when the run begins, counted as in a reading; for the axis alone to call. Of
        no meaning for a speed or a torque."""
        if self.quantity is Quantity.POSITION:
            self._origin = position_rad

    def value(self, time_s: float) -> float:
        """Reference ``time_s`` after the run began, in the unit of its quantity."""
        number = self._begun_at(time_s)
        if number == 0:
            return self._origin
        segment = self._segments[number - 1]
        if isinstance(segment, LevelStep):  # the usual one, without a call by name
            return self._origin + segment.level
        return self._origin + segment.value(time_s - self._from_s, self._start_levels[number - 1])

    def rate(self, time_s: float) -> float:
        """Its change per second at that time; of a position the speed. A jump has none."""
        number = self._begun_at(time_s)
        if number == 0:
            return 0.0
        segment = self._segments[number - 1]
        return segment.rate(time_s - self._from_s, self._start_levels[number - 1])

    def _begun_at(self, time_s: float) -> int:
        if not self._from_s <= time_s < self._until_s:
            starts_s = self._starts_s
            self._begun = begun = bisect_right(starts_s, time_s)
            self._from_s = starts_s[begun - 1] if begun else -math.inf
            self._until_s = starts_s[begun] if begun < len(starts_s) else math.inf
        return self._begun

    def _levels_at_starts(self) -> list[float]:
        levels: list[float] = []
        for number, segment in enumerate(self._segments):
            if number == 0:
                levels.append(0.0)
                continue
            before = self._segments[number - 1]
            levels.append(before.value(segment.at_s - before.at_s, levels[number - 1]))
        return levels


_TAYLOR = tuple((-1.0) ** k * (2.0 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(9))
"""The next term is (pi/2)^19/19! = 4e-14 at a quarter turn; with one less it would be 6e-12."""


def sine_of_turns(turns: float) -> float:
    """sin(2 pi turns), error below 1e-13, by plain arithmetic.

    The C library's sine may differ in its last bit between machines, and a
    simulated run must give the same records on all of them.
    """
    fraction = turns - math.floor(turns)
    quarter = fraction - 0.5
    if quarter > 0.25:
        quarter = 0.5 - quarter
    elif quarter < -0.25:
        quarter = -0.5 - quarter
    square = quarter * quarter
    total = 0.0
    for coefficient in reversed(_TAYLOR):
        total = total * square + coefficient
    return -total * quarter


QUANTITY_BY_MODE: Final = {
    "cst": Quantity.TORQUE,
    "csv": Quantity.SPEED,
    "csp": Quantity.POSITION,
    "ip": Quantity.POSITION,
    "vl": Quantity.SPEED,
}
