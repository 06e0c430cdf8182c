"""How much may still come: answers to requests, PDOs to SYNCs. What comes beyond that, nobody asked for."""

from collections import deque
from typing import Final

from drivers.timebase import NS_PER_S, Duration, Instant

ANSWER_LATE_MAX: Final = Duration(5 * NS_PER_S)
"""A node that stores its parameters, or is simulated on a busy machine, answers a second or two late."""
ANSWERS_DUE_MAX: Final = 1 << 15
"""More requests than a bus carries in that time: 3700 a second at 1 Mbit/s, two frames of 135 bits each."""


class Owed:
    """An account of what is due.

    It never blames what is only late, unless it is later than ``due_max`` others; and what was lost hides as
    much that nobody asked for, up to ``due_max``.
    """

    __slots__ = ("due", "due_max", "surplus")

    def __init__(self, due_max: int) -> None:
        self.due = 0
        self.due_max = due_max
        """What has not come by the time that so much more is due is taken for lost."""
        self.surplus = 0
        """What came beyond what was due, so far."""

    def expect(self, count: int = 1) -> None:
        """So much more is due."""
        self.due = min(self.due + count, self.due_max)

    def came(self, count: int = 1) -> int:
        """So much has come; how much of it was not due."""
        beyond = max(0, count - self.due)
        self.due = max(0, self.due - count)
        self.surplus += beyond
        return beyond


class OwedAnswers:
    """As :class:`Owed`, one for each request, however often it was repeated.

    What has not come within ANSWER_LATE_MAX is taken for lost, and hides no surplus any more.
    """

    __slots__ = ("_asked_at", "surplus")

    def __init__(self) -> None:
        self._asked_at: deque[Instant] = deque(maxlen=ANSWERS_DUE_MAX)
        self.surplus = 0
        """What came beyond what was due, so far."""

    def expect(self, asked_at: Instant) -> None:
        """One more is due."""
        self._asked_at.append(asked_at)

    def came(self, at: Instant) -> bool:
        """One has come; whether it was due."""
        asked_at = self._asked_at
        while asked_at and at - asked_at[0] > ANSWER_LATE_MAX:
            asked_at.popleft()
        if asked_at:
            asked_at.popleft()
            return True
        self.surplus += 1
        return False
