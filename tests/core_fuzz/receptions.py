"""Receptions of drawn TPDOs: any fields, frames of any length, callbacks that raise or receive themselves."""

import gc
import random
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from servobench.drivers.core.native import (
    CommandWatch,
    FollowReports,
    Inlet,
    LastStatusword,
    Reception,
    enter,
)
from servobench.drivers.timebase import Duration, Instant
from tests.core_fuzz.fates import ODD, Refused

_TIMES: Final = (1, 1000, 10**6, 10**9)


class _Syncs:
    def __init__(self, draw: random.Random) -> None:
        self._draw = draw

    @property
    def sync_count(self) -> Any:
        return self._draw.choice([self._draw.randrange(1 << 31), self._draw.randrange(100), *ODD])


def _fields(draw: random.Random, octets: int) -> tuple[Any, ...]:
    def drawn() -> Any:
        if draw.random() < 0.3:
            return None
        long = draw.choice([1, 2, 4, 4, draw.randrange(7)])
        return draw.randrange(max(1, octets - long + draw.randrange(20) // 19 + 1)), long, draw.random() < 0.5

    return tuple(drawn() for _ in range(8))


def _watch(draw: random.Random) -> CommandWatch:
    return CommandWatch(
        draw.choice([1, 2, 3, draw.randrange(2, 60)]),
        draw.choice([0, 2, 100, draw.getrandbits(62)]),
        equal=draw.random() < 0.5,
        share=draw.choice([0, 4, draw.getrandbits(62)]),
        least_raw=draw.choice([None, 1, draw.getrandbits(62)]),
        unit_cycles=draw.choice([0, 3, draw.getrandbits(62)]),
    )


def _add(inlets: list[Inlet], reception: Reception, octets: int, draw: random.Random) -> None:
    inlets.append(Inlet(reception, octets, _fields(draw, octets), draw.random() < 0.1))


def _used(draw: random.Random) -> "weakref.ref[_Syncs]":
    syncs = _Syncs(draw)
    inlets: list[Inlet] = []

    def changed(at: Instant) -> None:
        if draw.random() < 0.2:
            raise Refused(at)
        if draw.random() < 0.2:
            draw.choice(inlets)(draw.randbytes(draw.randrange(9)), at)
            inlets.pop(draw.randrange(len(inlets)))
        reception.watch = draw.choice([None, reception.watch])
        follow.lapsed = draw.random() < 0.5

    follow, told = FollowReports(changed, draw.randrange(-1, 6)), LastStatusword()
    scale = [draw.choice([draw.uniform(-1.0, 1.0), 1e300, float("nan")]) for _ in range(3)]
    period, count = (Duration(draw.choice([draw.choice([0, 10**9 + 1]), *_TIMES * 9])) for _ in range(2))
    leads, stamped = draw.random() < 0.5, draw.random() < 0.5
    reception = Reception(
        scale[0],
        scale[1],
        scale[2],
        period,
        draw.choice([0, 1, 32, 32, 33, *range(2, 33)]),
        count,
        leads,
        stamped,
        told,
        follow,
        syncs,
    )
    for _ in range(200):
        at, raw = Instant(draw.getrandbits(draw.randrange(63))), draw.getrandbits(draw.randrange(1, 33))
        octets = draw.randrange(-1, 10)
        inlets = inlets or [Inlet(reception, 8, ((0, 2, False), *(None,) * 7), False)]
        watch = reception.watch or _watch(draw)
        odd: Any = draw.choice([raw, -raw, *ODD])
        acts: list[Callable[[], object]] = [
            partial(_add, inlets, reception, octets, draw),
            partial(draw.choice(inlets), draw.randbytes(max(0, octets)), at),
            partial(draw.choice(inlets), draw.randbytes(8), at),
            draw.choice(inlets).keep,
            draw.choice(inlets).take_kept,
            partial(enter, draw.choice([{}, odd]), odd, odd),
            draw.choice([reception.readings, reception.readbacks, reception.changes]).clear,
            partial(reception.anchor_position, raw, at),
            partial(reception.position_rad, draw.choice([None, raw])),
            partial(reception.tell_watch, watch, odd),
            partial(setattr, reception, "watch", draw.choice([None, watch, syncs])),
            partial(watch.sent, draw.choice([raw, -raw, 1 << 62])),
            partial(follow.aim, draw.randrange(-3, 11), draw.choice([0, 0x1000])),
            partial(follow.mode_told, draw.randrange(-3, 11), at),
            partial(follow.status_told, draw.choice([0x237, 0x1237, 0xA37, raw]), at),
            follow.end,
            partial(told.take, raw, at),
        ]
        try:
            draw.choice(acts)()
        except (Refused, ValueError, TypeError, OverflowError, IndexError):
            continue
    return weakref.ref(syncs)


def receptions(draw: random.Random) -> None:
    """A reception that was used in any way is garbage at the end."""
    try:
        gone = _used(draw)
    except ValueError:
        return
    gc.collect()
    assert gone() is None
