"""The way of a cyclic set-point from its PDO into the loops: interpolation, and a filter.

What 60C2h says is the time in which a position set-point is reached; how, the drive's maker has decided:

    LINEAR   in a straight line
    CUBIC    in a cubic that has at each set-point the slope of the line to it: no corners
    NONE     at once, without a speed to feed forward
"""

import math
from dataclasses import dataclass
from enum import Enum


class Interpolation(Enum):
    """Between two position set-points of csp and ip."""

    LINEAR = "linear"
    CUBIC = "cubic"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class SetPointPath:
    """Between set-point and loops."""

    interpolation: Interpolation = Interpolation.LINEAR
    filter_hz: float | None = None
    """Corner of a first-order filter of positions, with the speed that is fed forward, and of speeds, in csp,
    ip and csv; None: no filter."""


STRAIGHT = SetPointPath()
"""The default of a simulated drive."""


class SetPointFilter:
    """First order, by Euler's backward rule, once a motion period."""

    def __init__(self, path: SetPointPath, period_s: float) -> None:
        corner_hz = path.filter_hz
        self._gain = 1.0 if corner_hz is None else period_s / (period_s + 1.0 / (math.tau * corner_hz))
        self._value = self._slope = 0.0

    def stand(self, value: float) -> None:
        """Begin at rest there."""
        self._value, self._slope = value, 0.0

    def follow(self, value: float, slope: float) -> tuple[float, float]:
        """The filtered value and slope, one period later."""
        if self._gain == 1.0:
            return value, slope
        self._value += self._gain * (value - self._value)
        self._slope += self._gain * (slope - self._slope)
        return self._value, self._slope
