"""A load torque over time that the simulated shaft bears by itself, without a frame for it."""

import math
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from virtual_bus.drive.motor_kernel import FloatArray, compiled


@dataclass(frozen=True, slots=True, eq=False)
class LoadTable:
    """Points in time; between them straight or held, before the first and after the last as there."""

    times_s: FloatArray
    """(n,), rising."""
    torques_nm: FloatArray
    """(n,); positive opposes positive speed."""

    @classmethod
    def of(cls, times_s: bytes, torques_nm: bytes) -> "LoadTable":
        """The same points, little-endian doubles, where they are: who looks them up after finds them near."""
        return cls(np.frombuffer(times_s, "<f8"), np.frombuffer(torques_nm, "<f8"))

    @property
    def number(self) -> int:
        """By which a bench sees that the drive has the points that it has itself: a CRC-32, never 0."""
        return crc32(self.torques_nm.tobytes(), crc32(self.times_s.tobytes())) or 1


@compiled
def fill_loads(
    loads: FloatArray,
    times_s: FloatArray,
    torques_nm: FloatArray,
    held: bool,
    at_s: float,
    period_s: float,
    count: int,
    place: int,
) -> int:
    """Put into ``loads`` the torques of a table at ``count`` instants from ``at_s`` on; 0 N m before 0 s.

    ``place``: a point not later than the first instant, or the first of all. Returns that of the last.
    """
    last = len(times_s) - 1
    from_s, until_s, level, span_s, rise = 0.0, -math.inf, 0.0, 1.0, 0.0  # of a piece between two points
    skipped = 0  # points between the last two pieces: so many may lie before the next
    for number in range(count):
        now_s = at_s + number * period_s
        if now_s >= until_s:
            before = place
            if place + skipped < last and times_s[place + skipped] <= now_s:
                place += skipped
            while place < last and times_s[place + 1] <= now_s:
                place += 1
            skipped = max(place - before - 1, 0)
            from_s, until_s, level, span_s, rise = times_s[place], math.inf, torques_nm[place], 1.0, 0.0
            if now_s < from_s:
                until_s = from_s
            elif place < last:
                until_s = times_s[place + 1]
                if not held:
                    span_s, rise = until_s - from_s, torques_nm[place + 1] - level
        loads[number] = level + (now_s - from_s) / span_s * rise if now_s >= 0.0 else 0.0
    return place
