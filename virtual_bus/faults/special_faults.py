"""Frame faults that neither lose nor just hold a frame: damaged data, duplicates, frames held out of order.

And the delay that is drawn from a histogram.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate

from drivers.timebase import Duration
from virtual_bus.faults.fault_plan import (
    Corruption,
    Duplication,
    Effect,
    MeasuredDelay,
    Reordering,
)
from virtual_bus.faults.strikes import Hold, Strike
from virtual_bus.frame import Frame

BIT_DRAWS = 8 * 840
"""A multiple of the data bits of every length, 8, 16 .. 64: each bit is drawn as often as the others."""
UNDAMAGED = -1

SpecialFault = Corruption | Duplication | Reordering
Instead = tuple[tuple[int, Duration], ...]
"""What goes on in a frame's place: for each copy which bit is inverted (UNDAMAGED: none), and its delay."""


class Special(Strike):
    """One such fault on one link. Two draws for every frame, so that none depends on a probability."""

    def __init__(
        self, label: str, fault: SpecialFault, begin: int, end: int, draw: Callable[[], float]
    ) -> None:
        super().__init__(label)
        self.fault = fault
        self.kind: str = fault.kind
        self.value = 0.0
        """The second draw for the last frame."""
        self._probability = fault.probability
        self._begin = begin
        self._end = end
        self._draw = draw

    def strikes(self, elapsed: int) -> bool:
        struck = self._draw() < self._probability
        self.value = self._draw()
        return struck and self._begin <= elapsed < self._end

    @property
    def keeps(self) -> bool:
        """Whether something of the frame goes on."""
        return not isinstance(self.fault, Corruption) or self.fault.effect is Effect.DATA

    def parameter(self) -> int:
        """What was drawn for the last frame: bit, distance of the copy (ns), or time held back (ns)."""
        fault = self.fault
        if isinstance(fault, Corruption):
            return int(self.value * BIT_DRAWS)
        if isinstance(fault, Duplication):
            return fault.later_ns
        return fault.min_ns + int(self.value * (fault.max_ns - fault.min_ns + 1))


def instead_of(kind: str, parameter: int, held: Duration) -> Instead:
    """What goes on in place of a frame that was struck by ``kind`` and is held for ``held``."""
    if kind == Duplication.kind:
        return (UNDAMAGED, held), (UNDAMAGED, Duration(held + parameter))
    return ((parameter, held),)


def damaged(frame: Frame, bit: int) -> Frame:
    """``frame`` with one bit of its data inverted; as it is if it has no data or ``bit`` is UNDAMAGED."""
    data = frame.data
    if bit == UNDAMAGED or not data:
        return frame
    place = bit % (8 * len(data))
    changed = bytearray(data)
    changed[place // 8] ^= 1 << place % 8
    made = Frame(frame.can_id, bytes(changed), frame.extended, frame.remote, frame.remote_length)
    made.handed_at = frame.handed_at
    return made


def replaced(frame: Frame, instead: Instead) -> Sequence[tuple[Frame, Duration]]:
    """The copies of ``frame`` that go on, each with its delay."""
    return [(damaged(frame, bit), delay) for bit, delay in instead]


class MeasuredHold(Hold):
    """Draws a bar by its count, then a time within it: two draws for every frame."""

    def __init__(self, fault: MeasuredDelay, begin: int, end: int, draw: Callable[[], float]) -> None:
        self._edges = fault.edges_ns
        self._sums = list(accumulate(fault.counts))
        self._begin = begin
        self._end = end
        self._draw = draw

    def holds(self, elapsed: int) -> int:
        edges, sums = self._edges, self._sums
        bar = bisect_right(sums, int(self._draw() * sums[-1]))
        low = edges[bar]
        held = low + int(self._draw() * (edges[bar + 1] - low))
        return held if self._begin <= elapsed < self._end else 0
