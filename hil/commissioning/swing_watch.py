"""Ends the exercise of a shaft that swings, where its loop is unstable."""

import math
from typing import Final

from servobench.drivers.errors import LimitExceeded
from servobench.drivers.exchange import Reading
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Instant

_MEAN_S: Final = 0.05
"""Time constant of the mean about which a shaft swings: above the period of every loop worth tuning."""
_HALF_SWING_S: Final = 0.03
"""Longest half of a swing: slower ones are the ramps'."""
_SWINGS: Final = 4
"""Turns in a row at which a swing is one: two periods, so that it ends within 100 ms down to 20 Hz."""


class SwingWatch:
    """Watches a shaft that is to turn evenly; raises LimitExceeded where its speed goes to and fro about its
    mean, or its torque from one reading to the next."""

    def __init__(self, speed_rad_s: float, torque_nm: float) -> None:
        """Further to either side is a swing; of the torque, as root mean square."""
        self._speed_rad_s, self._torque_nm = speed_rad_s, torque_nm
        self._mean = self._side = self._square = 0.0
        self._torque = math.nan
        self._last = self._turned_at = Instant(0)
        self._turns = 0

    def look(self, readings: list[Reading]) -> None:
        """Take readings."""
        for each in readings:
            passed = min((each.received_at - self._last) / NS_PER_S / _MEAN_S, 1.0)
            self._last = each.received_at
            off = each.velocity_rad_s - self._mean
            self._mean += passed * off
            self._turn(off, each.received_at)
            change, self._torque = each.torque_nm - self._torque, each.torque_nm
            if not math.isnan(change):
                self._square += 2.0 * passed * (change * change - self._square)
            if self._turns >= _SWINGS:
                raise _swung(f"{abs(off) / RAD_S_PER_RPM:.3g} r/min")
            if self._square > self._torque_nm**2:
                raise _swung(f"{math.sqrt(self._square):.3g} N m rms")

    def _turn(self, off: float, at: Instant) -> None:
        """Count the sides of the mean that follow each other."""
        if abs(off) < self._speed_rad_s:
            return
        if off * self._side < 0.0:
            soon = at - self._turned_at < _HALF_SWING_S * NS_PER_S
            self._turns = self._turns + 1 if soon else 1
            self._turned_at = at
        self._side = off


def _swung(by: str) -> LimitExceeded:
    return LimitExceeded(f"the shaft swings by {by}", "", "the gains are taken back: ask for less")
