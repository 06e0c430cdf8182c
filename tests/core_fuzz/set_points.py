"""Set-points on ports that raise: any fields and values, echoes of anything, commands that hold a frame."""

import gc
import random
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import can

from servobench.drivers.core.native import SetPointFrame
from servobench.drivers.errors import BusDown
from servobench.drivers.exchange import SentCommand
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.link import BusLink
from tests.core_fuzz.fates import ODD, Refused
from tests.core_fuzz.links import drawn_bus

_ERRORS: Final = (
    Refused, BusDown, ValueError, TypeError, OverflowError, AttributeError, can.CanOperationError
)  # fmt: skip


class _Command:
    """Refuses what it is told, or sends once more."""

    def __init__(self, draw: random.Random, frame: SetPointFrame) -> None:
        self.frame = frame
        self._draw = draw

    def __setattr__(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)
        if name not in ("on_bus_at", "unsent", "maybe_at"):
            return
        if self._draw.random() < 0.2:
            raise Refused(name)
        if self._draw.random() < 0.3:
            self.frame.await_echo(self)


def _used(draw: random.Random) -> "weakref.ref[BusLink]":
    bus, clock = drawn_bus(draw)
    link = BusLink(bus, clock)
    fields = [(draw.choice([1, 2, 4, 4, 8, draw.randrange(10)]), draw.randrange(4)) for _ in range(4)]
    frame = SetPointFrame(link, draw.getrandbits(11), tuple(fields[: draw.randrange(5)]))
    few = [draw.randbytes(draw.randrange(9)) for _ in range(3)]
    for number in range(400):
        at = Instant(draw.randrange(1000))
        odd: Any = draw.choice([0, 1, -1, draw.getrandbits(64), None, few[0], *ODD])
        sent = SentCommand(number, 0, at)
        command: object = draw.choice([sent, sent, _Command(draw, frame), None])
        acts: list[Callable[[], object]] = [
            partial(frame.hold, draw.randrange(-1, 5), odd),
            frame.send,
            partial(frame.await_echo, command),
            partial(frame.await_echo, command),
            partial(frame.given_up, draw.choice([at, clock.now()])),
            partial(frame, draw.choice([*few, bytes(8)]), at, draw.choice([at, clock.now(), Instant(-1)])),
        ]
        try:
            draw.choice(acts)()
        except _ERRORS:
            continue
    return weakref.ref(link)


def set_points(draw: random.Random) -> None:
    """A link whose set-points were used in any way is garbage at the end."""
    try:
        gone = _used(draw)
    except ValueError:
        return
    gc.collect()
    assert gone() is None
