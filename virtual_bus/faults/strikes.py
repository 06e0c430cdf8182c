"""Faults of frames at work on one link: whether one strikes a frame, and for how long one holds it.

``elapsed``: time since the plan's time zero, ns. Each draws the same number of times for every frame, struck
or not, in its window or not, so that none of its draws depends on its own settings or on another fault.
"""

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate

from mypy_extensions import mypyc_attr

from servobench.virtual_bus.faults.fault_streams import UniformStream


@mypyc_attr(allow_interpreted_subclasses=True)
class Strike:
    """A fault that strikes frames."""

    def __init__(self, kind: str, window: tuple[int, int]) -> None:
        """``kind``: of its entries in the log, which says what goes on in place of a struck frame;
        ``window``: the first ns in which it acts, and the first in which it does so no more."""
        self.kind = kind
        self.begin, self.end = window

    def strikes(self, elapsed: int) -> bool:
        """Whether it strikes the frame that is there now; asked once for each."""
        raise NotImplementedError

    def number(self) -> int:
        """The first number of the entry for the frame just struck; NONE if the frame is lost after all."""
        return 0


@mypyc_attr(allow_interpreted_subclasses=True)
class Hold:
    """A fault that delays frames."""

    def __init__(self, window: tuple[int, int], in_order: bool) -> None:
        """``in_order``: frames of a link may not overtake one another."""
        self.begin, self.end = window
        self.in_order = in_order

    def holds(self, elapsed: int) -> int:
        """For how many ns it holds the frame that is there now; asked once for each."""
        raise NotImplementedError


class IndependentStrike(Strike):
    """Each frame by itself."""

    def __init__(self, kind: str, window: tuple[int, int], probability: float, stream: UniformStream) -> None:
        super().__init__(kind, window)
        self._probability = probability
        self._stream = stream

    def strikes(self, elapsed: int) -> bool:
        return self._stream.draw() < self._probability and self.begin <= elapsed < self.end


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
        self.value = 0.0
        """The second draw for the last frame."""
        self._probability = probability
        self._least = least
        self._width = width
        self._stream = stream

    def strikes(self, elapsed: int) -> bool:
        struck = self._stream.draw() < self._probability
        self.value = self._stream.draw()
        return struck and self.begin <= elapsed < self.end

    def number(self) -> int:
        return self._least + int(self.value * self._width)


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
        self._leave_good, self._leave_bad = moves
        self._loss_good, self._loss_bad = losses
        self._stream = stream
        self._bad = False

    def strikes(self, elapsed: int) -> bool:
        move, lose = self._stream.draw(), self._stream.draw()
        self._bad = move >= self._leave_bad if self._bad else move < self._leave_good
        return lose < (self._loss_bad if self._bad else self._loss_good) and self.begin <= elapsed < self.end


class PeriodicStrike(Strike):
    """So many of each so many and one."""

    def __init__(self, kind: str, window: tuple[int, int], lost: int) -> None:
        super().__init__(kind, window)
        self._period = lost + 1
        self._count = -1

    def strikes(self, elapsed: int) -> bool:
        if not self.begin <= elapsed < self.end:
            return False
        self._count += 1
        return self._count % self._period != 0


class FirstStrikes(Strike):
    """The first ``count`` of a time."""

    def __init__(self, kind: str, window: tuple[int, int], count: int) -> None:
        super().__init__(kind, window)
        self._left = count

    def strikes(self, elapsed: int) -> bool:
        if self._left == 0 or not self.begin <= elapsed < self.end:
            return False
        self._left -= 1
        return True


class UniformHold(Hold):
    """Any time from ``least`` on, ``width`` of them, all alike."""

    def __init__(
        self, window: tuple[int, int], in_order: bool, least: int, width: int, stream: UniformStream
    ) -> None:
        super().__init__(window, in_order)
        self._least = least
        self._width = width
        self._stream = stream

    def holds(self, elapsed: int) -> int:
        held = self._least + int(self._stream.draw() * self._width)
        return held if self.begin <= elapsed < self.end else 0


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
        self._edges = list(edges_ns)
        self._sums = list(accumulate(counts))
        self._stream = stream

    def holds(self, elapsed: int) -> int:
        edges, sums = self._edges, self._sums
        bar = bisect_right(sums, int(self._stream.draw() * sums[-1]))
        low = edges[bar]
        held = low + int(self._stream.draw() * (edges[bar + 1] - low))
        return held if self.begin <= elapsed < self.end else 0
