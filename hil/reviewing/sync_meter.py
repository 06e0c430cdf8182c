"""Distances of the SYNCs of an axis, beside those for which its controller is certified."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_US
from servobench.hil.loop.cycle_record import FATE_SAMPLE, NOTHING
from servobench.hil.rows.records import Rows

_RESOLUTION_NS: Final = NS_PER_US
"""By which a distance may miss its limits: stamps, and the limits of files, are told in whole us."""


def sync_instants(rows: Rows) -> NDArray[np.int64]:
    """Return (n,) when each SYNC ended, ns: on the bus, else by its sample; NOTHING if unknown."""
    on_bus = rows["sync_on_bus_at"]
    return np.where(on_bus == NOTHING, _samples(rows), on_bus)


def _samples(rows: Rows) -> NDArray[np.int64]:
    certain = (rows["fate"] == FATE_SAMPLE) & (rows["certain"] != 0)
    return np.where(certain, rows["sampled_at"], NOTHING)


class SyncMeter:
    """Measures them on the bus, and at the drive, by the samples, where they certainly differ from that.

    A distance over cycles without a known instant counts as so many equal ones.
    """

    def __init__(self, period_us: float, within_us: float) -> None:
        """``within_us``: largest departure of a distance from the period; 0: the period is constant."""
        self._period_us, self._within_us = period_us, within_us
        self._last: dict[str, NDArray[np.int64]] = {}
        """(3, 1) the last SYNC on the bus and at the drive: sequence, instant and its error, ns."""
        self._shortest_us, self._longest_us = math.inf, -math.inf
        self.left = False
        """True if a distance lies beyond the limits."""

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE, in order of sequence."""
        self._add("bus", rows, sync_instants(rows), np.zeros(rows.size, np.int64))
        self._add("drive", rows, _samples(rows), rows["sampled_at_error_ns"])

    def _add(self, where: str, rows: Rows, at: NDArray[np.int64], errors: NDArray[np.int64]) -> None:
        found = np.stack((rows["sequence"], at, errors))[:, at != NOTHING]
        if where in self._last:
            found = np.hstack((self._last[where], found))
        self._last[where] = found[:, -1:]
        if found.shape[1] < 2:
            return
        periods, distances, error = np.diff(found[0]), np.diff(found[1]), found[2, 1:] + found[2, :-1]
        # as near to the period as its error allows
        apart = distances - periods * self._period_us * NS_PER_US
        apart = np.sign(apart) * np.maximum(np.abs(apart) - error, 0.0)
        self.left |= bool((np.abs(apart) > periods * self._within_us * NS_PER_US + _RESOLUTION_NS).any())
        each_us = self._period_us + apart / (periods * NS_PER_US)
        self._shortest_us = min(self._shortest_us, float(each_us.min()))
        self._longest_us = max(self._longest_us, float(each_us.max()))

    def told(self) -> str:
        """Return the premise in words, with what was seen of it."""
        within_us, period_us = self._within_us, self._period_us
        made_for = f"a constant period of {period_us:g} us"
        if within_us:
            made_for = f"{period_us - within_us:g} to {period_us + within_us:g} us"
        seen = f"{self._shortest_us:.1f} to {self._longest_us:.1f} us"
        return f"SYNC: {seen} from one to the next, made for {made_for}"
