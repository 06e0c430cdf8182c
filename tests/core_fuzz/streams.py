"""Streams of frames that the core is given: beside SYNCs in their order, and beside any."""

import random

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.core.native import RegularStream
from servobench.hil.loop.syncs import SyncMark
from tests.ports import kept_rows


def streams(draw: random.Random) -> None:
    """Frames beside SYNCs, at any places and instants, and frames by a timer."""
    step = draw.choice([0, 1, 1, 1, 5])
    stream = RegularStream(
        step, draw.randrange(2), draw.choice([0, 2, 64]), NS_PER_MS, False, draw.random() < 0.1
    )
    stream.held = draw.random() < 0.5
    marks: list[SyncMark] = []
    for number in range(1, 400):
        at = draw.choice([number * NS_PER_MS, number * NS_PER_MS, draw.randrange(1 << 61)])
        marks = [*marks, SyncMark(number, number, Instant(at))][-draw.choice([3, 128, 200]) :]
        marks[-1].place += number // 10 * draw.choice([1, 100])
        marks[-1].on_bus_at = draw.choice([None, Instant(at + draw.randrange(NS_PER_MS))])
        came = kept_rows(
            (draw.randbytes(draw.randrange(3)), Instant(at + draw.randrange(3)))
            for _ in range(draw.randrange(3))
        )
        if draw.random() < 0.05:
            came = draw.randbytes(draw.choice([1, 24, 48]))
        try:
            if draw.random() < 0.5:
                stream.take(number * step, draw.randrange(NS_PER_MS), draw.randbytes(draw.randrange(10)), at)
            elif draw.random() < 0.5:
                stream.compare(came, marks, draw.choice([at, 1 << 62]))
            else:
                stream.end()
        except ValueError:
            continue
