"""A bus with faults in front of it: any python-can bus, simulated or real, from one side.

What the owner sends is lost, or held and put on the bus at its time; what the bus brings is lost,
or held and handed over at its time. All that takes time is the inner bus's own ``recv``: there is
no thread and no sleep, so a held frame goes out on time only while the owner is inside ``recv``.
One thread at a time may use it. On a simulated bus the faults sit inside, at its own inbox and
transmit queue, and its timeline lets go what is held, wherever the owner is.

Only one side of a bus should wear the same plan, or every frame meets each fault twice. Leave
``receive_own_messages`` off: an echo would be taken for a frame from the other side.
"""

import contextlib
import copy
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Any, Literal, Protocol, Self, runtime_checkable

import can
import can.typechecking
from can.broadcastmanager import CyclicSendTaskABC

from drivers.timebase import NS_PER_S, Clock, Duration, Instant
from virtual_bus.can_bus.host_port import HELD_MAX, Entry
from virtual_bus.can_bus.message import frame_of, message_of
from virtual_bus.fault_injection.fault_plan import Direction
from virtual_bus.faults import FOREVER, PASSED, Fate, FateSource
from virtual_bus.frame import Frame
from virtual_bus.simulated_bus import SimulatedBus

POLL_MAX = 4096
"""Frames looked at in one call after its deadline, so that a babbling bus cannot hold the caller."""

Side = Literal["host", "drive"]
_Held = tuple[Any, int, Any, int]
"""Release (an Instant), order of arrival, the frame or message, for how long it was held (ns)."""


@runtime_checkable
class LeanBus(Protocol):
    """A bus that also takes and gives plain frames, stamped on the clock's axis."""

    def recv_frame(self, until: Instant) -> tuple[Frame, Instant] | None: ...

    def send_frame(self, frame: Frame) -> None: ...


class FaultyBus(can.BusABC):
    """``bus`` seen through the fates of ``injector``.

    ``side``: whose bus this is; a host sends from host to drive. ``stamp_offset``: the stamps of
    ``bus`` minus ``clock``, ns (0 for a simulated bus and the hub), so that a delay counts from
    the frame's stamp; None if unknown, then it counts from its receipt. Stamps stay on the axis
    of ``bus``: each is moved by the time for which its frame was held.

    Given a :class:`SimulatedBus`, the constructor makes a :class:`SimulatedFaultyBus`; given another
    :class:`LeanBus`, a :class:`LeanFaultyBus`.
    """

    def __new__(cls, bus: can.BusABC, *_args: Any, **_kwargs: Any) -> Self:
        chosen: Any = cls
        if cls is FaultyBus and isinstance(bus, SimulatedBus):
            chosen = SimulatedFaultyBus
        elif cls is FaultyBus and isinstance(bus, LeanBus):
            chosen = LeanFaultyBus
        made: Self = super().__new__(chosen)
        return made

    def __init__(
        self,
        bus: can.BusABC,
        injector: FateSource,
        clock: Clock,
        side: Side = "host",
        stamp_offset: Duration | None = None,
    ) -> None:
        self.inner = bus
        self.injector = injector
        self.channel_info = f"{bus.channel_info}, with faults"
        self._can_protocol = bus.protocol
        self._clock = clock
        self._stamp_offset = stamp_offset
        ways = (Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST)
        self._out, self._in = ways if side == "host" else ways[::-1]
        self._outgoing: list[_Held] = []
        self._incoming: list[_Held] = []
        self._order = 0
        self._seen_until: int = -FOREVER
        self._overflow = dict.fromkeys(Direction, 0)
        super().__init__(channel="", can_filters=bus.filters)

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``; until then every frame passes."""
        self._overflow = dict.fromkeys(Direction, 0)
        self.injector.start(now)

    def stop(self) -> None:
        """From here on every frame passes; what is held is still delivered at its time."""
        self.injector.stop()

    def counts(self) -> dict[str, dict[str, int]]:
        """The injector's counts, and ``overflow``: frames lost because too many were held."""
        counted = self.injector.counts()
        return {way.label: {**counted[way.label], "overflow": self._overflow[way]} for way in Direction}

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message to come through, within ``timeout`` seconds; its stamp is that of its release."""
        self._require_open()
        until = FOREVER if timeout is None else Instant(self._clock.now() + round(timeout * NS_PER_S))
        held = self._next(until)
        return None if held is None else self._message(held)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Lose ``msg``, send it or hold it. A held one is sent without ``timeout``."""
        self._require_open()
        now = self._clock.now()
        self._send_due(now)
        dropped, delay = self.injector.fate(self._out, msg.arbitration_id, now, msg.is_extended_id)
        if dropped:
            for item, later in self._instead(self._item(msg)):
                self._hold_outgoing(item, now, later)
            self._send_due(now)
            return
        if delay > 0:
            self._hold_outgoing(self._item(msg), now, delay)
        else:
            self.inner.send(msg, timeout)

    def flush_tx_buffer(self) -> None:
        """Forget what is held for sending."""
        self._outgoing.clear()
        with contextlib.suppress(NotImplementedError):
            self.inner.flush_tx_buffer()

    def shutdown(self) -> None:
        """Send at once what is still held, as a last command may be among it, and close ``bus``."""
        if self._is_shutdown:
            return
        super().shutdown()
        try:
            self._send_due(FOREVER)
        except can.CanError:
            self._outgoing.clear()
        finally:
            self._incoming.clear()
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

    def _next(self, until: Instant) -> _Held | None:
        """The next that comes through, no later than ``until``; written out, for speed."""
        incoming, outgoing = self._incoming, self._outgoing
        polled = 0
        while True:
            now = self._clock.now()
            if outgoing and outgoing[0][0] <= now:
                self._send_due(now)
            wait: int = until
            if incoming:
                due = incoming[0][0]
                # A frame may go on only when no older one can still be waiting in the inner bus.
                if due <= now and due <= self._seen_until:
                    return heappop(incoming)
                if due < wait:
                    wait = due
            if outgoing and outgoing[0][0] < wait:
                wait = outgoing[0][0]
            if self._take(wait):
                polled += now >= until
                if polled > POLL_MAX:
                    return None
                continue
            if wait > self._seen_until:
                self._seen_until = wait
            if wait >= until and not (incoming and incoming[0][0] <= until):
                return None

    def _take(self, wait: int) -> bool:
        """Let one frame of the inner bus meet its fate; False if none came by ``wait``."""
        timeout = None if wait == FOREVER else max(0.0, (wait - self._clock.now()) / NS_PER_S)
        message = self.inner.recv(timeout)
        if message is None:
            return False
        came = self._clock.now()
        if self._stamp_offset is not None:
            came = min(came, Instant(round(message.timestamp * NS_PER_S) - self._stamp_offset))
        fate = PASSED
        if not message.is_error_frame:
            fate = self.injector.fate(self._in, message.arbitration_id, came, message.is_extended_id)
        self._judge(message, came, fate)
        return True

    def _instead(self, item: Any) -> Sequence[tuple[Any, Duration]]:
        """What goes on in place of an item that the last fate dropped; a CAN FD frame has nothing."""
        if item.is_fd:
            return ()
        found = []
        for frame, delay in self.injector.replacements(frame_of(item)):
            message = copy.deepcopy(item)
            message.data[:] = frame.data
            found.append((message, delay))
        return found

    def _judge(self, item: Any, came: int, fate: Fate) -> None:
        """Lose or hold what came at ``came``; nothing older is waiting in the inner bus."""
        if came > self._seen_until:
            self._seen_until = came
        dropped, delay = fate
        if dropped:
            for other, later in self._instead(item):
                self._hold_incoming(other, came, later)
            return
        self._hold_incoming(item, came, delay)

    def _hold_incoming(self, item: Any, came: int, delay: Duration) -> None:
        if len(self._incoming) >= HELD_MAX:
            self._overflow[self._in] += 1
            return
        self._order = order = self._order + 1
        heappush(self._incoming, (came + delay, order, item, delay))

    def _item(self, msg: can.Message) -> Any:
        """What is held of ``msg``: its owner may use it again at once, its data too."""
        return copy.deepcopy(msg)

    def _message(self, held: _Held) -> can.Message:
        message: can.Message = held[2]
        if held[3] > 0:
            message = copy.copy(message)
            message.timestamp += held[3] / NS_PER_S
        return message

    def _hold_outgoing(self, item: Any, now: Instant, delay: Duration) -> None:
        if len(self._outgoing) >= HELD_MAX:
            self._overflow[self._out] += 1
            return
        self._order = order = self._order + 1
        heappush(self._outgoing, (Instant(now + delay), order, item, delay))

    def _send_due(self, now: Instant) -> None:
        outgoing = self._outgoing
        while outgoing and outgoing[0][0] <= now:
            self._transmit(heappop(outgoing)[2])

    def _transmit(self, item: Any) -> None:
        self.inner.send(item)


class LeanFaultyBus(FaultyBus):
    """A :class:`FaultyBus` over a :class:`LeanBus`: everything goes the lean way, and the owner may too."""

    inner: Any

    def recv_frame(self, until: Instant) -> tuple[Frame, Instant] | None:
        """The next frame to come through by ``until``, with the instant of its release."""
        held = self._next(until)
        return None if held is None else (held[2], held[0])

    def send_frame(self, frame: Frame) -> None:
        """Lose ``frame``, send it or hold it."""
        now = self._clock.now()
        if self._outgoing and self._outgoing[0][0] <= now:
            self._send_due(now)
        dropped, delay = self.injector.fate(self._out, frame.can_id, now, frame.extended)
        if dropped:
            for item, later in self._instead(frame):
                self._hold_outgoing(item, now, later)
            self._send_due(now)
        elif delay > 0:
            self._hold_outgoing(frame, now, delay)
        else:
            self.inner.send_frame(frame)

    def _take(self, wait: int) -> bool:
        if wait == FOREVER:
            return self._take_message()
        got = self.inner.recv_frame(wait)
        if got is None:
            return False
        frame, came = got
        self._judge(frame, came, self.injector.fate(self._in, frame[0], came, frame[2]))
        return True

    def _take_message(self) -> bool:
        """Without a deadline: the inner bus knows when waiting is vain."""
        message = self.inner.recv(None)
        if message is None:
            return False
        frame = frame_of(message)
        came = Instant(round(message.timestamp * NS_PER_S))
        self._judge(frame, came, self.injector.fate(self._in, frame.can_id, came, frame.extended))
        return True

    def _item(self, msg: can.Message) -> Frame:
        return frame_of(msg)

    def _instead(self, item: Frame) -> Sequence[tuple[Frame, Duration]]:
        return self.injector.replacements(item)

    def _message(self, held: _Held) -> can.Message:
        return message_of(held[2], held[0])

    def _transmit(self, item: Frame) -> None:
        self.inner.send_frame(item)


class SimulatedFaultyBus(FaultyBus):
    """A :class:`FaultyBus` over a :class:`SimulatedBus`, whose port applies the faults itself."""

    inner: SimulatedBus

    def __init__(
        self,
        bus: SimulatedBus,
        injector: FateSource,
        clock: Clock,
        side: Side = "host",
        stamp_offset: Duration | None = None,
    ) -> None:
        super().__init__(bus, injector, clock, side, stamp_offset)
        self.timeline = bus.timeline
        self._host_port = bus.host_port
        self.frame_port = self._host_port
        self._host_port.put_before(injector, self._out)
        self.recv_frame: Callable[[Instant], Entry | None] = bus.recv_frame
        self.send_frame: Callable[[Frame], None] = bus.send_frame

    def start(self, now: Instant) -> None:
        self._host_port.overflow_in = self._host_port.overflow_out = 0
        super().start(now)

    def counts(self) -> dict[str, dict[str, int]]:
        self._overflow[self._out] = self._host_port.overflow_out
        self._overflow[self._in] = self._host_port.overflow_in
        return super().counts()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._require_open()
        return self.inner.recv(timeout)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._require_open()
        self.inner.send(msg, timeout)

    def _send_periodic_internal(self, *args: Any, **kwargs: Any) -> CyclicSendTaskABC:
        return self.inner._send_periodic_internal(*args, **kwargs)
