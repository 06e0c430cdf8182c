"""Losses and delays at work on one link: whether one takes a frame, and for how long one holds it.

``elapsed``: time since the plan's time zero, ns.
"""

from typing import Final

from mypy_extensions import mypyc_attr

from drivers.timebase import Instant
from virtual_bus.faults.fault_plan import (
    Blackout,
    BurstLoss,
    IndependentLoss,
    PeriodicLoss,
    Selection,
    UniformDelay,
)
from virtual_bus.faults.fault_streams import UniformStream

FOREVER: Final = Instant(2**63 - 1)


def window(selection: Selection) -> tuple[int, int]:
    """First ns in which a fault acts, and the first in which it does so no more."""
    return selection.from_ns, FOREVER if selection.until_ns is None else selection.until_ns


@mypyc_attr(allow_interpreted_subclasses=True)
class Strike:
    """A fault that takes frames."""

    def __init__(self, label: str) -> None:
        """``label``: its kind, or a name of its own."""
        self.label = label

    def strikes(self, elapsed: int) -> bool:
        """Whether it takes the frame that is there now; asked once for each."""
        raise NotImplementedError


@mypyc_attr(allow_interpreted_subclasses=True)
class Hold:
    """A fault that delays frames."""

    def holds(self, elapsed: int) -> int:
        """For how many ns it holds the frame that is there now; asked once for each."""
        raise NotImplementedError


class IndependentStrike(Strike):
    """Each frame by itself."""

    def __init__(self, fault: IndependentLoss, stream: UniformStream) -> None:
        super().__init__(fault.kind)
        self._probability = fault.probability
        self._begin, self._end = window(fault.selection)
        self._stream = stream

    def strikes(self, elapsed: int) -> bool:
        return self._stream.draw() < self._probability and self._begin <= elapsed < self._end


class BurstStrike(Strike):
    """Gilbert and Elliott's chain of two states.

    Two draws for every frame, so that the chain's path never depends on the loss probabilities.
    """

    def __init__(self, fault: BurstLoss, stream: UniformStream) -> None:
        super().__init__(fault.kind)
        self._fault = fault
        self._begin, self._end = window(fault.selection)
        self._stream = stream
        self._bad = False

    def strikes(self, elapsed: int) -> bool:
        fault = self._fault
        move, lose = self._stream.draw(), self._stream.draw()
        self._bad = move >= fault.p_bad_to_good if self._bad else move < fault.p_good_to_bad
        return (
            lose < (fault.loss_bad if self._bad else fault.loss_good) and self._begin <= elapsed < self._end
        )


class PeriodicStrike(Strike):
    """So many of each so many and one."""

    def __init__(self, fault: PeriodicLoss) -> None:
        super().__init__(fault.kind)
        self._begin, self._end = window(fault.selection)
        self._period = fault.lost + 1
        self._count = -1

    def strikes(self, elapsed: int) -> bool:
        if not self._begin <= elapsed < self._end:
            return False
        self._count += 1
        return self._count % self._period != 0


class BlackoutStrike(Strike):
    """All of a time, or so many."""

    def __init__(self, fault: Blackout) -> None:
        super().__init__(fault.kind)
        self._begin, self._end = window(fault.selection)
        self._left: int = FOREVER if fault.count is None else fault.count

    def strikes(self, elapsed: int) -> bool:
        if self._left == 0 or not self._begin <= elapsed < self._end:
            return False
        self._left -= 1
        return True


class UniformHold(Hold):
    """Any time between two, all alike."""

    def __init__(self, fault: UniformDelay, stream: UniformStream) -> None:
        self._begin, self._end = window(fault.selection)
        self._least = fault.min_ns
        self._width = fault.max_ns - fault.min_ns + 1
        self._stream = stream

    def holds(self, elapsed: int) -> int:
        held = self._least + int(self._stream.draw() * self._width)
        return held if self._begin <= elapsed < self._end else 0
