"""Faults of frames at work on one link: whether one strikes a frame, and for how long one holds it
(core/strikes.c).

``elapsed``: time since the plan's time zero, ns. Each draws the same number of times for every frame, struck
or not, in its window or not, so that none of its draws depends on its own settings or on another fault.
"""

from collections.abc import Sequence

from servobench.virtual_bus.core import native
from servobench.virtual_bus.core.native import Hold as Hold
from servobench.virtual_bus.core.native import Strike as Strike
from servobench.virtual_bus.faults.fault_streams import UniformStream


class IndependentStrike(Strike):
    """Each frame by itself."""

    def __init__(self, kind: str, window: tuple[int, int], probability: float, stream: UniformStream) -> None:
        super().__init__(kind, window)
        self.by_chance(native.INDEPENDENT, stream, probability)


class NumberedStrike(Strike):
    """Each frame by itself, with a number from ``least`` on, ``width`` of them, drawn evenly."""

    def __init__(
        self,
        kind: str,
        window: tuple[int, int],
        probability: float,
        least: int,
        width: int,
        stream: UniformStream,
    ) -> None:
        """``width`` 0: always ``least``."""
        super().__init__(kind, window)
        self.by_chance(native.NUMBERED, stream, probability)
        self.numbered(least, width)


class BurstStrike(Strike):
    """Gilbert and Elliott's chain of two states."""

    def __init__(
        self,
        kind: str,
        window: tuple[int, int],
        moves: tuple[float, float],
        losses: tuple[float, float],
        stream: UniformStream,
    ) -> None:
        """``moves``: probabilities of leaving the good state and the bad; ``losses``: of losses in each."""
        super().__init__(kind, window)
        self.by_chance(native.BURST, stream, *moves, *losses)


class PeriodicStrike(Strike):
    """So many of each so many and one."""

    def __init__(self, kind: str, window: tuple[int, int], lost: int) -> None:
        super().__init__(kind, window)
        self.by_count(native.PERIODIC, lost + 1)


class FirstStrikes(Strike):
    """The first ``count`` of a time."""

    def __init__(self, kind: str, window: tuple[int, int], count: int) -> None:
        super().__init__(kind, window)
        self.by_count(native.FIRST, count)


class UniformHold(Hold):
    """Any time from ``least`` on, ``width`` of them, all alike."""

    def __init__(
        self, window: tuple[int, int], in_order: bool, least: int, width: int, stream: UniformStream
    ) -> None:
        super().__init__(window, in_order)
        self.uniform(stream, least, width)


class MeasuredHold(Hold):
    """Draws a bar of a histogram by its count, then a time within it."""

    def __init__(
        self,
        window: tuple[int, int],
        in_order: bool,
        edges_ns: Sequence[int],
        counts: Sequence[int],
        stream: UniformStream,
    ) -> None:
        super().__init__(window, in_order)
        self.measured(stream, edges_ns, counts)
