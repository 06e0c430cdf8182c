"""Judges of frames that the core is given: drawn, raising, and used in the middle of what they decide."""

import math
import random
from struct import pack
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.bus.judge import Judge
from servobench.virtual_bus.core.native import (
    BURST,
    FIRST,
    INDEPENDENT,
    NUMBERED,
    PERIODIC,
    Hold,
    Route,
    Strike,
    UniformNumbers,
)
from servobench.virtual_bus.faults.fates import FateSource
from servobench.virtual_bus.faults.fault_log import FaultLog
from servobench.virtual_bus.frame import Frame

ODD: Final = (math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1.8e308, -1e300)


class Refused(Exception):
    """What a callback of a drawn bus raises."""


def odd_number(draw: random.Random) -> float:
    """Any, now and then a hostile one."""
    return draw.choice(ODD) if draw.random() < 0.1 else draw.uniform(-500.0, 500.0)


class _Fate(Judge):
    """Holds, loses and doubles frames, and raises."""

    def __init__(self, draw: random.Random) -> None:
        self._draw = draw

    def hold(self, way: int, can_id: int, now: Instant, extended: bool) -> int:  # noqa: ARG002
        if self._draw.random() < 0.01:
            raise Refused(can_id)
        return self._draw.choice([0, 0, -1, 1, self._draw.randrange(5 * NS_PER_MS)])

    def replacements(self, frame: Frame) -> list[tuple[Frame, Duration]]:
        return [(frame, Duration(self._draw.randrange(NS_PER_MS))) for _ in range(self._draw.randrange(4))]


class _Struck(Strike):
    """Strikes, raises, or takes its numbers out of another stream, whatever it was made of."""

    def __init__(self, draw: random.Random, numbers: UniformNumbers) -> None:
        super().__init__("loss", (0, draw.randrange(1 << 62)))
        self._draw = draw
        self._numbers = numbers

    def strikes(self, elapsed: int) -> bool:
        if self._draw.random() < 0.02:
            raise Refused(elapsed)
        self.by_chance(INDEPENDENT, self._numbers, self._draw.random())
        return super().strikes(elapsed)


class _Routed(FateSource):
    """Routes of strikes and holds of every shape; it starts anew in the middle of a fate."""

    def __init__(self, draw: random.Random) -> None:
        super().__init__(["loss", "duplicate"], frozenset(), _Log(draw), 0)
        self._draw = draw

    def route(self, way: int, can_id: int, extended: bool) -> Route:
        draw = self._draw
        if draw.random() < 0.02:
            self.start(Instant(draw.randrange(1 << 40)))
        queue = self.queue(way, can_id, extended) if draw.random() < 0.5 else None
        numbers = UniformNumbers(self._block)
        strikes, holds = [Strike("duplicate", (-5, 1 << 62)) for _ in range(4)], []
        strikes[0].by_chance(draw.choice([INDEPENDENT, NUMBERED]), numbers, odd_number(draw))
        strikes[1].by_chance(BURST, numbers, *(draw.random() for _ in range(4)))
        strikes[2].by_count(PERIODIC, draw.randrange(1, 9))
        strikes[3].by_count(FIRST, draw.randrange(1, 9))
        strikes[0].numbered(draw.randrange(-1, NS_PER_MS), draw.randrange(NS_PER_MS))
        for _ in range(draw.randrange(3)):
            hold = Hold((0, draw.randrange(1 << 62)), draw.random() < 0.5)
            edges = sorted(draw.randrange(NS_PER_MS) for _ in range(draw.randrange(2, 9)))
            hold.measured(numbers, edges, [draw.randrange(9) for _ in edges[1:]])
            if draw.random() < 0.5:
                hold.uniform(numbers, draw.randrange(NS_PER_MS), draw.randrange(NS_PER_MS))
            holds.append(hold)
        return Route(queue, [_Struck(draw, numbers), *draw.sample(strikes, draw.randrange(5))], holds)

    def _block(self) -> bytes:
        if self._draw.random() < 0.02:
            raise Refused("no numbers")
        count = self._draw.randrange(1, 9)
        return pack(f"={count}d", *(self._draw.random() for _ in range(count)))


class _Log(FaultLog):
    """Refuses a block now and then."""

    def __init__(self, draw: random.Random) -> None:
        super().__init__()
        self._draw = draw

    def flush(self) -> None:
        super().flush()
        if self._draw.random() < 0.1:
            raise Refused("full")


def drawn_judge(draw: random.Random) -> Judge:
    """Of Python alone, or with the core's fates in it."""
    if draw.random() < 0.3:
        return _Fate(draw)
    judge = _Routed(draw)
    judge.start(Instant(0))
    return judge
