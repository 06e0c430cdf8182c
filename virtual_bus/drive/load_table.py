"""A load torque over time that the simulated shaft bears by itself, without a frame for it."""

from array import array
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
    def of(cls, times_s: "array[float]", torques_nm: "array[float]") -> "LoadTable":
        """The same points, copied."""
        return cls(np.array(times_s), np.array(torques_nm))

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
    for number in range(count):
        now_s = at_s + number * period_s
        while place < last and times_s[place + 1] <= now_s:
            place += 1
        load = torques_nm[place]
        if not held and place < last and now_s > times_s[place]:
            share = (now_s - times_s[place]) / (times_s[place + 1] - times_s[place])
            load += share * (torques_nm[place + 1] - load)
        loads[number] = load if now_s >= 0.0 else 0.0
    return place
