"""The one place where frames wait for their release: at a host's port, before any bus, around a device."""

from heapq import heappop, heappush
from typing import Final

from drivers.timebase import NEVER
from virtual_bus.frame import Frame

HELD_MAX: Final = 4096
"""Frames held in one place; one more is lost and counted: both TPDOs of a cycle of 1 ms for two seconds."""


class HeldFrames:
    """Let go in the order of their release, those of one instant in the order in which they came."""

    __slots__ = ("_heap", "_order", "overflow")

    def __init__(self) -> None:
        self.overflow = 0
        """Frames lost because too many were held."""
        self._heap: list[tuple[int, int, Frame, int]] = []
        self._order = 0

    def __len__(self) -> int:
        return len(self._heap)

    def hold(self, frame: Frame, release: int, mark: int = 0) -> bool:
        """Keep ``frame`` until ``release`` (an Instant); False if there is no room. ``mark``: the owner's."""
        if len(self._heap) >= HELD_MAX:
            self.overflow += 1
            return False
        self._order += 1
        heappush(self._heap, (release, self._order, frame, mark))
        return True

    def next_at(self) -> int:
        """When the next one goes; NEVER if none is held."""
        return self._heap[0][0] if self._heap else NEVER

    def take(self, now: int) -> tuple[int, int, Frame, int] | None:
        """The next one that goes by ``now``: release, order, frame, mark."""
        heap = self._heap
        return heappop(heap) if heap and heap[0][0] <= now else None

    def clear(self) -> None:
        """Forget all that is held."""
        self._heap.clear()
