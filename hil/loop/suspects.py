"""Readings that put the question whether a drive's clock was set, and the lines on which they may lie."""

import math
from typing import Final, NamedTuple

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import Instant
from servobench.hil.loop.syncs import SURPLUS, SyncMark

STEP_COST: Final = 3
"""Of a way to place suspects: that a clock was set,"""
DELAY_COST: Final = 3
"""that the smallest delay changed by more than half a period,"""
LOSS_COST_MAX: Final = 2
"""and that readings were lost just then, one each up to this: a step and a change of delay are as rare as one
another, while losses are common and come in bursts."""
LIKELY_COST_MAX: Final = STEP_COST + LOSS_COST_MAX
"""One of the two, and losses."""


class Suspect:
    """A reading that came while it is open whether the clock was set."""

    def __init__(
        self,
        device_ns: int,
        received_at: Instant,
        known: int | None = None,
        early: bool = False,
        velocity_rad_s: float = math.nan,
    ) -> None:
        """``known``: the stamp of the SYNC on which it lies, if that has one already."""
        self.device_ns = device_ns
        self.received_at = received_at
        self._velocity_rad_s = velocity_rad_s
        self.second = known is not None
        """True if it lies on a SYNC that has a reading already,"""
        self.repeats = known == device_ns
        """with the same stamp, as a clock makes some again that is set back."""
        self.twice = False
        """True if another reading told the same since."""
        self.early = early
        """True if it would have come before its SYNC if the clock was not set."""
        self.guess = SURPLUS
        """The cycle in which it was placed, uncertain."""
        self.beside = SURPLUS
        """The cycle, in doubt since then, whose SYNC has the other stamp; :data:`SURPLUS` without one."""

    def is_copied_by(self, reading: Reading) -> bool:
        """Return whether ``reading`` tells the same: a clock that is set back makes its stamps again."""
        return reading.device_time_ns == self.device_ns and reading.velocity_rad_s == self._velocity_rad_s


def note_copy(suspects: list[Suspect], reading: Reading) -> bool:
    """Return whether ``reading`` tells the same as one of the ``suspects``, and take note of it there."""
    for suspect in suspects:
        if suspect.is_copied_by(reading):
            suspect.twice = True
            return True
    return False


class Line(NamedTuple):
    """A way to place the last suspects."""

    cost: int
    delay_change: int
    """By how much the smallest delay would have changed, ns; it decides between equals, but not at once."""
    marks: tuple[SyncMark | None, ...]
    """The SYNC of each; None where it was not heard, which the first one's was."""
    steps: bool
    """True if the clock was set."""
    misfit: float
    """Logarithm of how much likelier no line would be, by how far they lie off it."""
    moved_by: int
    """By how much later than the map it has stamps, ns."""
    others: bool
    """True if the smallest delay has changed by so much that delays are others."""

    @property
    def first_at(self) -> Instant:
        """The end of the SYNC of the first one."""
        first = self.marks[0]
        assert first is not None
        assert first.on_bus_at is not None
        return first.on_bus_at

    @property
    def unlikely(self) -> bool:
        """True if more than losses must have happened."""
        return self.cost >= STEP_COST
