"""Alterations of a signal's value: pure, each with its own random stream.

Every alteration draws the same number of times for every frame that carries its signal, in its window or not,
so that none of its draws depends on its own settings or on another fault. ``elapsed``: ns since the plan's
time zero. Values are raw, as the frame has them.
"""

import math
from collections.abc import Callable
from typing import Final

from servobench.drivers.timebase import NS_PER_S
from servobench.virtual_bus.faults.fault_streams import UniformStream

Change = Callable[[int, int, float], float]
"""From the raw value, the ns since the window opened, and a number drawn from the normal distribution of mean
0 and standard deviation 1."""
_LEAST: Final = 2.0**-53
"""The smallest number above 0 that a stream draws: a logarithm of 0 is none."""


def saturated(value: float, bits: int, signed: bool) -> int:
    """``value``, rounded half to even, inside what so many bits hold."""
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    return min(max(round(value), low), high)


class Alteration:
    """One signal on one link."""

    def __init__(
        self, window: tuple[int, int], probability: float, change: Change, stream: UniformStream
    ) -> None:
        self._begin, self._end = window
        self._probability = probability
        self._change = change
        self._stream = stream

    def altered(self, raw: int, elapsed: int) -> float | None:
        """Return the replacement of ``raw`` in the present frame; None: unchanged."""
        draw = self._stream.draw
        struck = draw() < self._probability
        radius, angle = draw(), draw()
        if not (struck and self._begin <= elapsed < self._end):
            return None
        # Box and Muller.
        normal = math.sqrt(-2.0 * math.log(max(radius, _LEAST))) * math.cos(math.tau * angle)
        return self._change(raw, elapsed - self._begin, normal)


def stuck(at_raw: int | None) -> Change:
    """Always ``at_raw``; None: the first value that it meets."""
    held: list[int] = [] if at_raw is None else [at_raw]

    def change(raw: int, _since_ns: int, _normal: float) -> float:
        if not held:
            held.append(raw)
        return held[0]

    return change


def offset(by_raw: float) -> Change:
    """So much more."""
    return lambda raw, _since_ns, _normal: raw + by_raw


def drift(by_raw_per_s: float) -> Change:
    """So much more for every second since the window opened."""
    return lambda raw, since_ns, _normal: raw + by_raw_per_s * since_ns / NS_PER_S


def noise(raw_rms: float) -> Change:
    """Normal, with that standard deviation, each frame by itself."""
    return lambda raw, _since_ns, normal: raw + raw_rms * normal


def scale(factor: float) -> Change:
    """So many times as much."""
    return lambda raw, _since_ns, _normal: raw * factor


def bits(set_mask: int, cleared_mask: int) -> Change:
    """Some bits always 1, some always 0."""
    return lambda raw, _since_ns, _normal: (raw | set_mask) & ~cleared_mask
