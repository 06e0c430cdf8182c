"""Object 2100h of a simulated drive, manufacturer-specific: the load machine on its shaft.

A load torque over time that the simulated shaft bears by itself, without a frame for it.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final
from zlib import crc32

from servobench.drivers.canopen.write_list import Product

SIMULATED_DRIVE: Final = Product(0, 0x0001_0402, "servobench simulated servo drive")
"""The simulated drive by its 1018h and 1008h. In any other product 2100h is another object."""
LOAD_MACHINE: Final = 0x2100
LOAD_TORQUE_SUB: Final = 1
"""mN m against positive speed."""
LOAD_ACTUAL_SUB: Final = 2
LOAD_COURSE_SUB: Final = 3
"""A :class:`LoadCourse`."""
LOAD_NUMBER_SUB: Final = 4
"""Number of the load over time that the drive has; 0: none."""
LOAD_DELAY_SUB: Final = 5
"""us."""


class LoadCourse(IntEnum):
    """2100h:3: the delay of 2100h:5 after the next SYNC a load over time begins."""

    OFF = 0
    """The shaft bears 2100h:1."""
    STRAIGHT = 1
    """Straight between two points."""
    HELD = 2
    """Hold the value of the previous point."""


@dataclass(frozen=True, slots=True)
class LoadTable:
    """Points in time; between them straight or held, before the first and after the last as there."""

    times_s: bytes
    """Doubles, rising."""
    torques_nm: bytes
    """Doubles; positive opposes positive speed."""

    @property
    def number(self) -> int:
        """By which a bench sees that the drive has the points that it has itself: a CRC-32, never 0."""
        return crc32(self.torques_nm, crc32(self.times_s)) or 1
