"""Accounts of outstanding answers to requests and PDOs to SYNCs. Anything beyond them is unsolicited."""

from collections import deque
from typing import Final

from servobench.drivers.timebase import NS_PER_S, Duration, Instant

ANSWER_LATE_MAX: Final = Duration(5 * NS_PER_S)
"""A node that stores its parameters, or is simulated on a busy machine, answers a second or two late."""
ANSWERS_DUE_MAX: Final = 1 << 15
"""More requests than a bus carries in that time: 3700 a second at 1 Mbit/s, two frames of 135 bits each."""

_ABORT: Final = 4
_BLOCKS: Final = (5, 6)
_NAMING_REQUESTS: Final = (1, 2, *_BLOCKS)
_NAMING_ANSWERS: Final = (2, 3, _ABORT)
"""Command specifiers of CiA 301 7.2.4.3: an abort, blocks either way, and those that initiate a transfer."""


class Owed:
    """An account of outstanding items.

    A late item never counts as surplus, unless it is later than ``due_max`` others; each lost one hides one
    surplus, up to ``due_max``.
    """

    __slots__ = ("due", "due_max", "surplus")

    def __init__(self, due_max: int) -> None:
        self.due = 0
        self.due_max = due_max
        """Items outstanding beyond this number count as lost."""
        self.surplus = 0
        """Items beyond those due, so far."""

    def expect(self, count: int = 1) -> None:
        """Add to the items due."""
        self.due = min(self.due + count, self.due_max)

    def came(self, count: int = 1) -> int:
        """Take in items; return how many were not due."""
        beyond = max(0, count - self.due)
        self.due = max(0, self.due - count)
        self.surplus += beyond
        return beyond


class OwedAnswers:
    """The answers that a node owes on its SDO channel: one per request, however often that was repeated.

    An answer that names an object is owed to a request that named it, an abort to any if none did. What has
    not come within ANSWER_LATE_MAX is taken for lost, and hides no surplus any more.

        asked     6041h  607Ch  segment      6040h
        came      6041h  607Ch  segment      6040h  6061h: nobody asked
    """

    __slots__ = ("_asked", "_blocks_until", "_earlier_until", "surplus")

    def __init__(self, now: Instant) -> None:
        """``now``: another client may have asked just before; its answer comes before any other."""
        self._asked: deque[tuple[Instant, bytes]] = deque(maxlen=ANSWERS_DUE_MAX)
        """Instant of each request, and the object that its answer must name; empty: none."""
        self._earlier_until = Instant(now + ANSWER_LATE_MAX)
        self._blocks_until = Instant(0)
        """Blocks of another client may pass until then: the answers due to them are not tracked."""
        self.surplus = 0
        """Answers beyond those due, so far."""

    def expect(self, asked_at: Instant, request: bytes) -> None:
        """Note one more answer due; none for an abort."""
        command = request[0] >> 5 if request else 0
        if command in _BLOCKS:
            self._blocks_until = Instant(asked_at + ANSWER_LATE_MAX)
        if command != _ABORT:
            named = command in _NAMING_REQUESTS
            self._asked.append((asked_at, request[1:4] if named else b""))

    def came(self, at: Instant, answer: bytes) -> bool:
        """Take in an answer; return True if it was due."""
        asked = self._asked
        while asked and at - asked[0][0] > ANSWER_LATE_MAX:
            asked.popleft()
        command = answer[0] >> 5 if answer else 0
        name = answer[1:4] if command in _NAMING_ANSWERS else b""
        due = next((each for each in asked if each[1] == name), None)
        if due is None and command == _ABORT and asked:
            due = asked[0]
        if due is not None:
            asked.remove(due)
            self._earlier_until = Instant(0)
            return True
        if at <= self._earlier_until:
            self._earlier_until = Instant(0)
            return True
        if at <= self._blocks_until:
            return True
        self.surplus += 1
        return False
