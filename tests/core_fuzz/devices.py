"""Devices that the core is given: PDOs of any mapping, and callables that raise, map anew and call back."""

import gc
import random
from collections.abc import Callable
from functools import partial
from typing import Any

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.timebase import NEVER, NS_PER_MS, Duration, Instant
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import (
    CyclicDevice,
    CyclicDrive,
    CyclicRpdo,
    CyclicTpdo,
    DeviceClock,
    DeviceSeat,
    InnerLoops,
    SyncTaker,
    Timeline,
    Timer,
)
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.pdo_parameters import Field, compiled
from servobench.virtual_bus.frame import Frame
from tests.core_fuzz.fates import Refused

ACTIONS = 60


class DrawnDevice(Listener):
    """A device whose parts do anything when they are called."""

    def __init__(self, draw: random.Random) -> None:
        self.draw = draw
        self.wake_at: Any = draw.choice([NEVER, Instant(0), Instant(5 * NS_PER_MS), None, "soon"])
        self.cycle = CyclicDevice(self)
        self.variables = [Variable(0x2000, place, "drawn", DataType.INTEGER16, low=-5) for place in range(4)]
        self.timers = [Timer(self.cycle, self.called) for _ in range(draw.randrange(4))]
        self.tpdos = [
            CyclicTpdo(self.cycle, self.called, self.codec(), self.codec()) for _ in range(draw.randrange(4))
        ]
        self.rpdos = [
            CyclicRpdo(self.cycle, self.called, Timer(self.cycle, self.called), self.stopped, self.codec())
            for _ in range(draw.randrange(3))
        ]
        self.cycle.carry(self.tpdos, self.rpdos)
        tick_after = draw.choice([None, lambda now: now + 1, self.called])
        first, drift, bits = draw.getrandbits(40), draw.getrandbits(30), draw.choice([16, 32])
        self.clock = DeviceClock(self.cycle, first, drift, 1000, 1000, bits, 0, True, tick_after)
        hold = draw.choice([None, self.held])
        self.taker = SyncTaker(self.cycle, self.clock, self.called, hold)
        for variable in self.variables:
            variable.on_write = draw.choice([None, self.called])
            variable.check = draw.choice([None, None, self.checked])
            variable.provider = draw.choice([None, None, self.clock.told, self.given])
        self.cycle.operational, self.cycle.takes_syncs = draw.random() < 0.9, draw.random() < 0.9
        if draw.random() < 0.3:
            loops = InnerLoops()
            loops.substeps = 1
            self.cycle.drive = CyclicDrive(
                loops, self.variables[0], self.followed, self.stopped, self.stopped
            )
        timeline = Timeline()
        self.segment = CanSegment(timeline)
        self.port = self.segment.attach("drawn", self)
        self.seat = DeviceSeat(self.cycle, self.port, Refused, self.called)
        self.heard: dict[int, Any] = {0x80: (self.taker,), 0x100: (self.called_with_frame,)}
        for number, rpdo in enumerate(self.rpdos):
            self.heard[0x200 + number] = (rpdo, self.called_with_frame)[: draw.randrange(1, 3)]
        self.port.hear_only(self.heard, self.seat)
        self.host = self.segment.attach("host", Listener())

    def codec(self) -> Any:
        """Some of the variables, and gaps."""
        chosen = [self.draw.choice([*self.variables, None]) for _ in range(self.draw.randrange(5))]
        return compiled([Field(variable, 16) for variable in chosen])

    def do_anything(self) -> None:
        """What a callable may do: raise, map anew, enter the device again."""
        draw, cycle = self.draw, self.cycle
        what: list[Callable[[], object]] = [
            lambda: gc.collect(0),
            lambda: cycle.carry(self.tpdos[:1], self.rpdos[:1]),
            lambda: cycle.send(Frame(draw.randrange(0x800))),
            lambda: setattr(cycle, "drive", None),
            cycle.forget_frames,
            cycle.take_frames,
            self.heard.clear,
        ]
        for tpdo in self.tpdos:
            what += [partial(tpdo.map, self.codec(), self.codec()), partial(cycle.watch, tpdo)]
            what += [partial(cycle.unwatch, tpdo)]
        what += [partial(rpdo.map, self.codec()) for rpdo in self.rpdos]
        later = Instant(cycle.now + draw.randrange(1, NS_PER_MS))
        what += [partial(timer.start, later) for timer in self.timers]
        if draw.random() < 0.1:
            raise Refused
        if draw.random() < 0.3:
            draw.choice(what)()

    def called(self, _now: int) -> Any:
        self.do_anything()
        return self.draw.choice([0, None, 1 << 70])

    def called_with_frame(self, _frame: Frame, _now: Instant) -> None:
        self.do_anything()

    def held(self, _counter: int, _now: Instant) -> None:
        self.do_anything()

    def checked(self, _value: int) -> Any:
        self.do_anything()
        return self.draw.choice([None, 5])

    def given(self) -> int:
        self.do_anything()
        return self.draw.randrange(-40_000, 40_000)

    def followed(self, _now: Instant) -> bool:
        self.do_anything()
        return self.draw.random() < 0.5

    stopped = do_anything

    def advance(self, _now: Instant) -> None:
        """See :class:`servobench.virtual_bus.device.station.Application`."""
        self.do_anything()

    def on_sync(self, _counter: int, _now: Instant) -> None:
        """See there."""
        self.do_anything()

    def on_frame(self, frame: Frame, now: Instant) -> None:  # noqa: ARG002
        self.do_anything()


def devices(draw: random.Random) -> None:
    """One device, on a segment and called from outside."""
    made = DrawnDevice(draw)
    cycle, timeline = made.cycle, made.segment.timeline
    for _ in range(ACTIONS):
        for tpdo in made.tpdos:
            tpdo.type, tpdo.follows_sync = draw.choice([0, 1, 2, 252, 255]), draw.random() < 0.8
            tpdo.left = tpdo.left or 1
        for rpdo in made.rpdos:
            rpdo.synchronous, rpdo.wrong_length = draw.random() < 0.5, draw.choice([0, 0, 5])
            rpdo.deadline_ns, rpdo.missed = Duration(draw.choice([0, 1000])), draw.random() < 0.5
        made.taker.open_window = draw.choice([None, made.called])
        made.taker.length = draw.choice([0, 1])
        if cycle.drive is not None:
            cycle.drive.tasked, cycle.drive.stopping = draw.random() < 0.3, draw.random() < 0.3
            cycle.drive.protects, cycle.drive.awaits_sync = draw.random() < 0.3, draw.random() < 0.3
        data = draw.randbytes(draw.randrange(9))
        handlers = draw.choice([*made.heard.values(), ()])
        now = Instant(timeline.now + draw.randrange(NS_PER_MS))
        for act in (
            lambda: made.host.send(Frame(draw.choice([0x80, 0x100, 0x200, 0x201]), data)),  # noqa: B023
            lambda: timeline.run_until(now),  # noqa: B023
            lambda: cycle.hear(handlers, Frame(1, data), now),  # noqa: B023
            lambda: cycle.wake(now),  # noqa: B023
            lambda: cycle.due_at,
        ):
            try:
                if draw.random() < 0.5:
                    act()
            except (Refused, ValueError, TypeError, OverflowError):
                continue
