"""A bus with faults in front of it: any python-can bus, simulated or real, from one side.

What the owner sends is lost, or held and put on the bus at its time; what the bus brings is lost,
or held and handed over at its time. An echo of an own frame meets no fault: a frame that was lost here has
none, one that was held has it when it was really sent, each copy of a duplicated one has its own.

All that takes time is the inner bus's own ``receive``: there is no thread and no sleep, so a held frame goes
out on time only while the owner is inside ``receive``. One thread at a time may use it. On a simulated bus
the faults sit inside, at its own inbox and transmit queue, and its timeline lets go what is held, wherever
the owner is.

Only one side of a bus should wear the same plan, or every frame meets each fault twice.
"""

import contextlib
from typing import Any, Self

import can
import can.typechecking
from can.broadcastmanager import CyclicSendTaskABC

from servobench.drivers.timebase import NEVER, NS_PER_S, Clock, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, FramePort
from servobench.drivers.wire.message import frame_of, message_of
from servobench.drivers.wire.message_port import MessagePort, StampSource
from servobench.virtual_bus.bus.host_port import HostPort
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.core.native import HeldFrames
from servobench.virtual_bus.faults.fates import FateSource
from servobench.virtual_bus.faults.frame_fault import Side
from servobench.virtual_bus.frame import Frame

POLL_MAX = 4096
"""Frames looked at in one call after its deadline, so that a babbling bus cannot hold the caller."""


def ways(side: Side) -> tuple[Direction, Direction]:
    """The directions of what ``side`` sends and of what it receives."""
    both = Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST
    return both if side == "host" else both[::-1]


class FaultyPort(FramePort):
    """``inner`` seen through the fates of ``injector``. A frame's stamp is the instant of its release."""

    def __init__(self, inner: FramePort, injector: FateSource, clock: Clock, side: Side) -> None:
        super().__init__()
        self.echoes = inner.echoes
        self.needs_watching = True
        self.troubles = inner.troubles
        self.held_in = HeldFrames()
        self.held_out = HeldFrames()
        self._inner = inner
        self._injector = injector
        self._now = clock.now
        self._out, self._in = ways(side)
        self._seen_until: int = -NEVER

    def receive(self, until: Instant) -> Frame | None:
        """The next that comes through, no later than ``until``."""
        incoming = self.held_in
        polled = 0
        while True:
            now = self._now()
            self._send_due(now)
            # A frame may go on only when no older one can still be waiting in the inner bus.
            if incoming.next_at() <= min(now, self._seen_until):
                return self._hand_over()
            wait = min(until, incoming.next_at(), self.held_out.next_at())
            if self._take(Instant(wait)):
                polled += now >= until
                if polled > POLL_MAX:
                    return None
                continue
            self._seen_until = max(self._seen_until, wait)
            if wait >= until and not (incoming and incoming.next_at() <= until):
                return None

    def transmit(self, frame: Frame) -> None:
        """Lose ``frame``, send it or hold it."""
        now = self._now()
        self._send_due(now)
        for one, later in self._injector.goes_on(self._out, frame, now):
            if later > 0:
                self.held_out.hold(one, now + later)
            else:
                self._inner.transmit(one)

    def send_held(self) -> None:
        """Send at once what is held."""
        self._send_due(NEVER)

    def flush(self) -> None:
        """Forget what is held for sending."""
        self.held_out.clear()

    def _send_due(self, now: int) -> None:
        while (held := self.held_out.take(now)) is not None:
            self._inner.transmit(held[2])

    def _hand_over(self) -> Frame | None:
        held = self.held_in.take(NEVER)
        if held is None:
            return None
        at, _, frame, own = held
        self.came_at, self.came_own = Instant(at), bool(own)
        return frame

    def _take(self, wait: Instant) -> bool:
        """Let one frame of the inner bus meet its fate; False if none came by ``wait``."""
        inner = self._inner
        frame = inner.receive(wait)
        if frame is None:
            return False
        came = inner.came_at
        if came > self._seen_until:
            self._seen_until = came
        if inner.came_own:
            self.echoes = inner.echoes
            self.held_in.hold(frame, came, True)
        elif frame.can_id >= ERROR_FLAG:
            self.held_in.hold(frame, came)
        else:
            for one, later in self._injector.goes_on(self._in, frame, came):
                self.held_in.hold(one, came + later)
        return True


class FaultyBus(can.BusABC):
    """``bus`` seen through the fates of ``injector``, by its ``frame_port`` and as python-can sees it.

    ``stamps``: those of a bus that has no ``frame_port``. The stamps of what comes through are instants of
    release on the axis of ``clock``.

    Given a :class:`SimulatedBus`, the constructor makes a :class:`SimulatedFaultyBus`.
    """

    def __new__(cls, bus: can.BusABC, *_args: Any, **_kwargs: Any) -> Self:
        chosen: Any = cls
        if cls is FaultyBus and isinstance(bus, SimulatedBus):
            chosen = SimulatedFaultyBus
        made: Self = super().__new__(chosen)
        return made

    def __init__(
        self,
        bus: can.BusABC,
        injector: FateSource,
        clock: Clock,
        side: Side = "host",
        stamps: StampSource = StampSource.RECEIPT,
    ) -> None:
        self.inner = bus
        self.injector = injector
        self.channel_info = f"{bus.channel_info}, with faults"
        self._can_protocol = bus.protocol
        self._clock = clock
        self._side = side
        self.frame_port = self._make_port(stamps)
        super().__init__(channel="", can_filters=bus.filters)

    def _make_port(self, stamps: StampSource) -> FaultyPort | HostPort:
        inner: FramePort | None = getattr(self.inner, "frame_port", None)
        if inner is None:
            inner = MessagePort(self.inner, self._clock, stamps)
        return FaultyPort(inner, self.injector, self._clock, self._side)

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; until then every frame passes."""
        self.frame_port.held_in.overflow = self.frame_port.held_out.overflow = 0
        self.injector.start(now)

    def stop(self) -> None:
        """From here on every frame passes; what is held is still delivered at its time."""
        self.injector.stop()

    def counts(self) -> dict[str, dict[str, int]]:
        """The injector's counts, and ``overflow``: frames lost because too many were held."""
        port, counted = self.frame_port, self.injector.counts()
        overflows = zip(ways(self._side), (port.held_out.overflow, port.held_in.overflow), strict=True)
        return {way.label: {**counted[way.label], "overflow": lost} for way, lost in sorted(overflows)}

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message to come through, within ``timeout`` seconds; its stamp is that of its release."""
        self._require_open()
        until = NEVER if timeout is None else self._clock.now() + round(timeout * NS_PER_S)
        port = self.frame_port
        frame = port.receive(Instant(until))
        return None if frame is None else message_of(frame, port.came_at, is_rx=not port.came_own)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Lose ``msg``, send it or hold it; without waiting for room."""
        self._require_open()
        self.frame_port.transmit(frame_of(msg))

    def flush_tx_buffer(self) -> None:
        """Forget what is held for sending."""
        self.frame_port.flush()
        with contextlib.suppress(NotImplementedError):
            self.inner.flush_tx_buffer()

    def shutdown(self) -> None:
        """Send at once what is still held, as a last command may be among it, and close ``bus``."""
        if self._is_shutdown:
            return
        super().shutdown()
        try:
            self.frame_port.send_held()
        except can.CanError:
            self.frame_port.flush()
        finally:
            self.inner.shutdown()

    def set_filters(self, filters: can.typechecking.CanFilters | None = None) -> None:
        """Filter before the faults: what is filtered out has no fate."""
        self._filters = filters or None
        self.inner.set_filters(filters)

    @property
    def state(self) -> can.BusState:
        """That of the inner bus."""
        return self.inner.state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        self.inner.state = new_state

    def _require_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")

    def _send_periodic_internal(self, *_args: Any, **_kwargs: Any) -> CyclicSendTaskABC:
        raise NotImplementedError("a bus with faults is used by one thread: send periodic frames from there")


class SimulatedFaultyBus(FaultyBus):
    """A :class:`FaultyBus` over a :class:`SimulatedBus`, whose port applies the faults itself."""

    inner: SimulatedBus

    def _make_port(self, stamps: StampSource) -> HostPort:  # noqa: ARG002
        port = self.inner.frame_port
        port.put_before(self.injector, ways(self._side)[0])
        return port

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._require_open()
        return self.inner.recv(timeout)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._require_open()
        self.inner.send(msg, timeout)

    def _send_periodic_internal(self, *args: Any, **kwargs: Any) -> CyclicSendTaskABC:
        return self.inner._send_periodic_internal(*args, **kwargs)
