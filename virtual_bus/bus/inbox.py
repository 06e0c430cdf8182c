"""What a participant has received and not yet fetched."""

from typing import Final

from drivers.timebase import Instant
from virtual_bus.frame import Frame

_SPENT_MAX: Final = 64
"""Places at the head that are kept before the rest is moved up."""


class ReceivedFrame:
    """A received frame, and the instant at which it came."""

    __slots__ = ("at", "frame", "own")

    def __init__(self, frame: Frame, at: Instant, own: bool) -> None:
        """``own``: the participant has sent it itself."""
        self.frame = frame
        self.at = at
        self.own = own


class Inbox:
    """First in, first out, with a bound."""

    __slots__ = ("_arrivals", "_most", "_taken")

    def __init__(self, most: int) -> None:
        self._arrivals: list[ReceivedFrame] = []
        self._taken = 0
        self._most = most

    def __len__(self) -> int:
        return len(self._arrivals) - self._taken

    def put(self, arrival: ReceivedFrame) -> bool:
        """Add ``arrival``; False if there is no room."""
        arrivals = self._arrivals
        if len(arrivals) - self._taken >= self._most:
            return False
        arrivals.append(arrival)
        return True

    def take(self) -> ReceivedFrame:
        """The first one. Error: IndexError."""
        arrivals = self._arrivals
        arrival = arrivals[self._taken]
        self._taken += 1
        if self._taken == len(arrivals):
            arrivals.clear()
            self._taken = 0
        elif self._taken >= _SPENT_MAX and self._taken * 2 > len(arrivals):
            del arrivals[: self._taken]
            self._taken = 0
        return arrival
