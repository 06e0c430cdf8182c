"""The way of a set-point from its PDO into the loops: interpolation, filters, a notch.

What 60C2h says is the time in which a position set-point is reached; how, the drive's maker has decided:

    LINEAR   in a straight line
    CUBIC    in a cubic that has at each set-point the slope of the line to it: no corners
    NONE     at once, without a speed to feed forward
"""

import math
from dataclasses import dataclass
from enum import Enum

from servobench.virtual_bus.core.native import InnerLoops, sine_cosine


class Interpolation(Enum):
    """Between two position set-points of csp and ip."""

    LINEAR = "linear"
    CUBIC = "cubic"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Notch:
    """(s^2 + depth width w s + w^2) / (s^2 + width w s + w^2), by the bilinear rule at the inner rate."""

    frequency_hz: float
    depth: float = 0.1
    """Share of the torque that is left at its frequency."""
    width: float = 0.7


@dataclass(frozen=True, slots=True)
class SetPointPath:
    """Between set-point and loops."""

    interpolation: Interpolation = Interpolation.LINEAR
    filter_hz: float | None = None
    """Corner of a first-order filter of positions, with the speed that is fed forward, and of speeds, in csp,
    ip and csv; None: no filter."""
    torque_filter_hz: float | None = None
    """Corner of a first-order filter of the torque demand, whatever asks for it; None: no filter."""
    notch: Notch | None = None
    """Behind that; None: none."""
    torque_slope: bool = False
    """Torques of cst are reached by 6087h, and not at once."""
    holds_stale: bool = False
    """csp begins where the shaft is, and stays there until 607Ah or 60B0h is written anew."""


STRAIGHT = SetPointPath()
"""The default of a simulated drive."""


def check_path(rate_hz: int, path: SetPointPath) -> None:
    """Error: ValueError for a notch that no inner loop of that rate has."""
    if path.notch is not None and not 0.0 < path.notch.frequency_hz < 0.4 * rate_hz:
        expected = f"below two fifths of the inner rate, {0.4 * rate_hz:g} Hz, expected"
        raise ValueError(f"notch at {path.notch.frequency_hz:g} Hz: {expected}")


def fill_path(inner: InnerLoops, path: SetPointPath, period_s: float) -> None:
    """Give ``inner`` the filters of the torque demand; ``path`` is checked already."""
    inner.low_gain = _gain(path.torque_filter_hz, period_s)
    inner.notch_b0 = 1.0
    if path.notch is not None:
        _fill_notch(inner, path.notch, period_s)
    inner.torque_path = path.torque_filter_hz is not None or path.notch is not None


def _fill_notch(inner: InnerLoops, notch: Notch, period_s: float) -> None:
    sine, cosine = sine_cosine(math.tau * notch.frequency_hz * period_s)
    wide = 0.5 * notch.width * sine
    inner.notch_b0 = (1.0 + notch.depth * wide) / (1.0 + wide)
    inner.notch_b1 = inner.notch_a1 = -2.0 * cosine / (1.0 + wide)
    inner.notch_b2 = (1.0 - notch.depth * wide) / (1.0 + wide)
    inner.notch_a2 = (1.0 - wide) / (1.0 + wide)


def _gain(corner_hz: float | None, period_s: float) -> float:
    return 1.0 if corner_hz is None else period_s / (period_s + 1.0 / (math.tau * corner_hz))


class SetPointFilter:
    """First order, by Euler's backward rule, once a motion period."""

    def __init__(self, path: SetPointPath, period_s: float) -> None:
        self._gain = _gain(path.filter_hz, period_s)
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
