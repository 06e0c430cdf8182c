"""Links and pumps on ports that raise, lie and stay silent, with taps and handlers that raise and pump on."""

import gc
import random
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import can

from servobench.drivers.canopen.frame_pump import FramePump
from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NEVER, NS_PER_MS, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, FramePort, FrameTap, Trouble, WireFrame
from servobench.drivers.wire.link import BusLink
from servobench.virtual_bus.bus.host_port import HostPort
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import SimulatedClock, Timeline
from tests.core_fuzz.fates import Refused, drawn_judge


def drawn_frame(draw: random.Random) -> WireFrame:
    """Any frame, also one that is none of classical CAN."""
    can_id = draw.choice([0x80, 0x181, draw.randrange(1 << 11), ERROR_FLAG | 4, draw.getrandbits(30)])
    remote = draw.random() < 0.1
    return WireFrame(can_id, draw.randbytes(draw.randrange(10)), draw.random() < 0.1, remote, remote * 4)


class _DrawnPort(FramePort):
    """Gives any frame, nothing, no frame at all or an error, and takes some of them."""

    def __init__(self, draw: random.Random) -> None:
        super().__init__()
        self._draw = draw

    def receive(self, until: Instant) -> WireFrame | None:
        chance = self._draw.random()
        self.came_at, self.came_own = Instant(self._draw.randrange(1 << 40)), chance < 0.5
        if chance < 0.05:
            self.troubles.append(Trouble("fell asleep", until, chance < 0.02))
        elif chance < 0.1:
            raise self._draw.choice([OSError(5, "gone"), Refused(chance), can.CanOperationError("gone")])
        elif chance < 0.12:
            return b"no frame"  # type: ignore[return-value]
        return drawn_frame(self._draw) if chance < 0.7 else None

    def transmit(self, frame: WireFrame) -> None:
        chance = self._draw.random()
        if chance < 0.2:
            raise can.CanOperationError("full", self._draw.choice([105, 105, 105, 19]))
        if chance < 0.25:
            raise Refused(frame)


class _DrawnTap(FrameTap):
    def __init__(self, draw: random.Random, link: BusLink) -> None:
        self._draw, self._link = draw, link

    def frame(
        self,
        direction: str,
        can_id: int,  # noqa: ARG002
        data: bytes,  # noqa: ARG002
        extended: bool,  # noqa: ARG002
        remote: bool,  # noqa: ARG002
        at: Instant,
    ) -> None:
        chance = self._draw.random()
        if chance < 0.02:
            raise Refused(direction)
        if chance < 0.05:
            self._link.tap(_DrawnTap(self._draw, self._link))
        elif chance < 0.1 and direction == "rx":
            self._link.fetch(at)


def drawn_bus(draw: random.Random) -> tuple[Any, SimulatedClock]:
    """A bus of a drawn kind, and its clock."""
    timeline = Timeline()
    if draw.random() < 0.5:
        port: FramePort = _DrawnPort(draw)
    else:
        segment = CanSegment(timeline, 500_000)
        port = HostPort(segment, "host")
        other = segment.attach("other", HostPort(segment, "listener").received)
        for _ in range(draw.randrange(200)):
            other.send(WireFrame(draw.randrange(1 << 11), draw.randbytes(8)))
        port.hear_itself()
        if draw.random() < 0.5:
            port.put_before(drawn_judge(draw), 0)  # type: ignore[arg-type]
    return type("Bus", (), {"frame_port": port, "channel_info": "drawn"})(), SimulatedClock(timeline)


def _used_link(draw: random.Random) -> "weakref.ref[BusLink]":
    bus, clock = drawn_bus(draw)
    link = BusLink(bus, clock)

    def handle(*given: Any) -> None:
        chance = draw.random()
        if chance < 0.05:
            raise Refused(given)
        if chance < 0.1:
            pump.pump_one(given[-1])
        elif chance < 0.2:
            pump.handlers[draw.randrange(1 << 11)] = handle
            pump.handlers.pop(0x181, None)

    def keep_house(now: Instant) -> None:
        if draw.random() < 0.9:
            pump.housekeeping_at = NEVER if draw.random() < 0.5 else Instant(now + draw.randrange(NS_PER_MS))

    pump = FramePump(link, clock, handle, keep_house)
    pump.handlers[0x181] = pump.echo_handlers[0x181] = handle
    for _ in range(draw.randrange(3)):
        link.tap(_DrawnTap(draw, link))
    for _ in range(100):
        until = Instant(clock.now() + draw.randrange(NS_PER_MS))
        frame = drawn_frame(draw)
        acts: list[Callable[[], object]] = [
            partial(pump.pump_one, until),
            partial(link.fetch, until),
            partial(pump.rest if link.needs_watching else pump.pump_one, until),
            partial(keep_house, until),
            partial(link.send, frame.can_id, frame.data),
            partial(link.hand_over, frame),
        ]
        try:
            draw.choice(acts)()
        except (Refused, BusDown, RuntimeError, ValueError, TypeError, can.CanOperationError):
            continue
    return weakref.ref(link)


def links(draw: random.Random) -> None:
    """A link that was used in any way is garbage at the end."""
    gone = _used_link(draw)
    gc.collect()
    assert gone() is None
