"""A drive whose process stands still now and then, in simulated time, as firmware does that is busy.

SYNC ends        1        2        3        4        5
stands still              |-----------------------|
frames wait      :                                2 3 4: sampled at one instant    :
answers wait     :        :        :        :     2 3 4 leave at one instant       :
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from random import Random
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Instant
from servobench.virtual_bus.frame import Frame

UNTIL: Final = 60 * NS_PER_S
"""Longer than any run of a plan."""


class Waiting(Enum):
    """What waits for the end of a standstill."""

    QUEUE = "all frames wait"
    NEWEST = "the newest frame of each identifier waits"
    OLDEST = "the oldest frame of each identifier waits"
    ANSWERS = "answers wait"


@dataclass(frozen=True, slots=True)
class Standstills:
    """How often a drive stands still, for how long, and what waits."""

    every_us: float
    """On average, from the end of one to the begin of the next."""
    longest_us: float
    """Drawn evenly, down to none."""
    waiting: Waiting


class StandingDrive:
    """Stands in front of a drive, and passes on all else that it is asked for."""

    def __init__(self, device: Any, drawn: Standstills, seed: int) -> None:
        self._device = device
        self._waiting = drawn.waiting
        self._frames: list[Frame] = []
        self._answers: list[Frame] = []
        self._begins: list[int] = []
        self._ends: list[int] = [0]
        draw = Random(f"standstills {seed} {device.node_id}")
        while self._ends[-1] < UNTIL:
            self._begins.append(self._ends[-1] + round(draw.expovariate(1.0) * drawn.every_us * NS_PER_US))
            self._ends.append(self._begins[-1] + round(draw.random() * drawn.longest_us * NS_PER_US))
        self._until = Instant(0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    @property
    def wake_at(self) -> Instant | None:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        due: Instant | None = self._device.wake_at
        if due is not None and self._waiting is not Waiting.ANSWERS:
            due = self._stands_until(due)
        if self._frames or self._answers:
            return self._until if due is None else min(due, self._until)
        return due

    def start(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        frames: Sequence[Frame] = self._device.start(now)
        return frames

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        if self._waiting is Waiting.ANSWERS:
            return self._answer(self._device.receive(frame, now), now)
        self._until = self._stands_until(now)
        if self._until == now:
            return [*self._catch_up(now), *self._device.receive(frame, now)]
        others = [other for other in self._frames if other.can_id != frame.can_id]
        if self._waiting is Waiting.NEWEST:
            self._frames = others
        if self._waiting is not Waiting.OLDEST or len(others) == len(self._frames):
            self._frames.append(frame)
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        """See :class:`servobench.virtual_bus.frame.Device`."""
        due = self._device.wake_at
        answers = self._device.wake(now) if due is not None and due <= now else ()
        return self._answer([*answers, *self._catch_up(now)], now)

    def _stands_until(self, now: int) -> Instant:
        """``now``, unless it stands still then."""
        return Instant(max(now, self._ends[bisect_right(self._begins, now)]))

    def _catch_up(self, now: Instant) -> Sequence[Frame]:
        """Hear all that waits."""
        waited, self._frames = self._frames, []
        return [answer for frame in waited for answer in self._device.receive(frame, now)]

    def _answer(self, answers: Sequence[Frame], now: Instant) -> Sequence[Frame]:
        self._answers += answers
        if self._waiting is Waiting.ANSWERS:
            self._until = self._stands_until(now)
            if self._until > now:
                return ()
        leaving, self._answers = self._answers, []
        return leaving
