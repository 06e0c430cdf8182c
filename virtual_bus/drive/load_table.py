"""A load torque over time that the simulated shaft bears by itself, without a frame for it."""

from dataclasses import dataclass
from zlib import crc32


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
