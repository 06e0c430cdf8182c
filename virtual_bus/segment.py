"""One CAN segment in simulated time: arbitration, exact frame time, frame spacing, load.

Every frame is acknowledged and none is corrupted; a port that sends sees its own frame's end
through ``on_sent``. Two ports that send the same identifier at the same time are served in the
order in which they were attached (on a real bus their data would collide).

The next frame is chosen as soon as the bus is known to become free, and stays open to
contest until its start of frame: whatever else is queued by then, also at that very
instant, takes part in the arbitration. So a frame costs one event, and the outcome does
not depend on the order of events within an instant.
"""

from collections import deque
from collections.abc import Callable, Sequence
from heapq import heappop, heappush

import can
from can.typechecking import CanFilters

from drivers.timebase import Duration, Instant, instant_after
from virtual_bus.can_bus.arbitration import arbitration_key
from virtual_bus.can_bus.bit_length import INTERMISSION_BITS, LONGEST_FRAME_BITS, bits_duration, wire_bits
from virtual_bus.can_bus.bus_load import BusLoad
from virtual_bus.can_bus.cyclic_task import TimelineCyclicTask
from virtual_bus.can_bus.filters import accepts
from virtual_bus.can_bus.message import frame_of, message_of
from virtual_bus.frame import Frame
from virtual_bus.timeline import Timeline

OnFrame = Callable[[Frame, Instant], None]

TRANSMIT_QUEUE_MAX = 256
"""Frames that a port holds for the bus; one more is refused."""


def _ignore(_frame: Frame, _at: Instant) -> None:
    """What a detached port does with a frame."""


class Port:
    """A node's connection to a segment: a first-in first-out transmit queue and a callback."""

    __slots__ = ("_queue", "_rank", "_segment", "name", "on_frame", "on_sent")

    def __init__(self, segment: "Segment", rank: int, name: str, on_frame: OnFrame) -> None:
        self.name = name
        self.on_frame = on_frame
        self.on_sent: OnFrame | None = None
        self._segment = segment
        self._rank = rank
        self._queue: deque[tuple[int, Frame]] = deque()

    @property
    def pending(self) -> int:
        """Frames that wait for the bus, the one being sent included."""
        return len(self._queue)

    def send(self, frame: Frame) -> None:
        """Queue ``frame``. Raises can.CanOperationError if the queue is full or the port detached."""
        queue = self._queue
        if len(queue) >= TRANSMIT_QUEUE_MAX or self.on_frame is _ignore:
            raise self._refusal()
        can_id, _, extended, remote, _ = frame
        key = arbitration_key(frame) if extended or remote else can_id << 21
        queue.append((key, frame))
        if len(queue) == 1:
            self._segment._contend(key, self)

    def detach(self) -> None:
        """Receive no more and accept no more; what was queued still goes out, as from a controller."""
        self.on_frame = _ignore
        self.on_sent = None
        self._segment._forget(self)

    def _refusal(self) -> can.CanOperationError:
        if self.on_frame is _ignore:
            return can.CanOperationError(f"{self.name}: the port is detached from its segment")
        return can.CanOperationError(f"{self.name}: transmit queue is full ({TRANSMIT_QUEUE_MAX} frames)")


class Segment:
    """A bus of one bit rate on a timeline, with any number of ports."""

    __slots__ = (
        "_attached",
        "_contenders",
        "_delivering",
        "_durations",
        "_end_at",
        "_free_at",
        "_intermission",
        "_key",
        "_load",
        "_monitors",
        "_on_end",
        "_ports",
        "_sender",
        "_start_at",
        "bitrate_bit_s",
        "frames",
        "timeline",
    )

    def __init__(self, timeline: Timeline, bitrate: int = 1_000_000) -> None:
        if bitrate <= 0:
            raise ValueError(f"bitrate {bitrate} bit/s: it must be positive")
        self.timeline = timeline
        self.bitrate_bit_s = bitrate
        self.frames = 0
        self._durations = [bits_duration(bits, bitrate) for bits in range(LONGEST_FRAME_BITS + 1)]
        self._intermission = bits_duration(INTERMISSION_BITS, bitrate)
        self._load = BusLoad()
        self._ports: tuple[Port, ...] = ()
        self._attached = 0
        self._monitors: tuple[OnFrame, ...] = ()
        self._contenders: list[tuple[int, int, Port]] = []  # heads of queues, but for the sender's
        self._sender: Port | None = None
        self._key = 0
        self._start_at = Instant(0)
        self._end_at = Instant(0)
        self._free_at = Instant(0)
        self._delivering = False
        self._on_end = self._finish

    @property
    def busy_ns(self) -> Duration:
        """Time taken by completed frames and the intermission after each."""
        return self._load.busy_ns

    def load_percent(self, since: Instant, until: Instant) -> float:
        """Share of [since, until] that completed frames and intermissions took, percent."""
        return self._load.percent(since, until)

    def attach(self, name: str, on_frame: OnFrame) -> Port:
        """A port whose ``on_frame(frame, at)`` gets every other port's frame at its end of frame."""
        self._attached += 1
        port = Port(self, self._attached, name, on_frame)
        self._ports = (*self._ports, port)
        return port

    def add_monitor(self, on_frame: OnFrame) -> Callable[[], None]:
        """Show every frame, whoever sent it, to ``on_frame`` at its end; returns what ends that."""
        self._monitors = (*self._monitors, on_frame)

        def remove() -> None:
            self._monitors = tuple(monitor for monitor in self._monitors if monitor is not on_frame)

        return remove

    def _forget(self, port: Port) -> None:
        self._ports = tuple(other for other in self._ports if other is not port)

    def _contend(self, key: int, port: Port) -> None:
        """``port`` has a frame at the head of its queue, of arbitration key ``key``."""
        sender = self._sender
        if sender is None and not self._delivering:
            self._begin(key, port)
            return
        if (
            sender is not None
            and self.timeline.now <= self._start_at
            and (key, port._rank) < (self._key, sender._rank)
        ):  # the frame chosen before has not begun and loses
            heappush(self._contenders, (self._key, sender._rank, sender))
            self._begin(key, port)
            return
        heappush(self._contenders, (key, port._rank, port))

    def _begin(self, key: int, port: Port) -> None:
        """Let ``port`` send the head of its queue as soon as the bus is free."""
        timeline = self.timeline
        start = self._free_at
        if timeline.now > start:
            start = timeline.now
        _, data, _, remote, remote_length = port._queue[0][1]
        dlc = remote_length if remote else len(data)
        bits = wire_bits(key << 4 | dlc, int.from_bytes(data))
        self._sender = port
        self._key = key
        self._start_at = start
        self._end_at = end = Instant(start + self._durations[bits])
        timeline.post(end, self._on_end)

    def _finish(self, now: Instant) -> None:
        """The last bit of end of frame has passed: deliver, and choose the next frame."""
        sender = self._sender
        if sender is None or now != self._end_at:
            return  # the end of a frame that lost the arbitration before its start
        queue = sender._queue
        frame = queue.popleft()[1]
        self._sender = None
        self._free_at = free_at = Instant(now + self._intermission)
        self.frames += 1
        self._load.add(free_at - self._start_at, free_at)
        contenders = self._contenders
        if queue:
            heappush(contenders, (queue[0][0], sender._rank, sender))
        self._delivering = True
        try:
            for monitor in self._monitors:
                monitor(frame, now)
            for port in self._ports:
                if port is not sender:
                    port.on_frame(frame, now)
            if sender.on_sent is not None:
                sender.on_sent(frame, now)
        finally:
            self._delivering = False
            if contenders:
                key, _, port = heappop(contenders)
                self._begin(key, port)


RECEIVE_QUEUE_MAX = 65_536
"""Frames that a simulated bus holds for its reader; later ones are lost and counted."""

_NEVER = Instant(1 << 62)


class _OwnFrame(tuple[Frame, Instant]):
    """A received entry that came back to its sender."""


class SimulatedBus(can.BusABC):
    """python-can's view of a segment: ``can.Bus(interface="simulated", segment=segment)``.

    Without ``segment`` it makes its own, on a timeline of its own. ``recv`` lets simulated
    time pass until a frame is there; ``send`` queues at the present instant and lets none pass.
    A message's timestamp is its end of frame in seconds of simulated time.
    """

    def __init__(
        self,
        channel: str | None = None,
        can_filters: CanFilters | None = None,
        *,
        segment: Segment | None = None,
        bitrate: int = 1_000_000,
        receive_own_messages: bool = False,
        **_: object,
    ) -> None:
        self.segment = segment if segment is not None else Segment(Timeline(), bitrate)
        self.timeline = self.segment.timeline
        self.channel_info = f"simulated segment, port {channel or 'host'}"
        self.overruns = 0
        """Frames lost because nobody fetched them."""
        self._channel = channel
        self._received: deque[tuple[Frame, Instant]] = deque()
        self._port = self.segment.attach(channel or "host", self._store)
        if receive_own_messages:
            self._port.on_sent = self._store_own
        super().__init__(channel or "", can_filters)

    def recv_frame(self, until: Instant) -> tuple[Frame, Instant] | None:
        """The next frame and its end of frame; None if there is none up to ``until``.

        Time passes no further than to that frame, or to ``until``.
        """
        received = self._received
        if received or self.timeline.run_until_filled(until, received):
            return received.popleft()
        return None

    def send_frame(self, frame: Frame) -> None:
        """Queue ``frame`` now. Raises can.CanOperationError if the transmit queue is full."""
        self._port.send(frame)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message; None after ``timeout`` seconds of simulated time.

        Raises can.CanOperationError if the bus is shut down, and without a timeout also if
        no event is left that could bring a frame.
        """
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        if timeout is None:
            self._step_until(lambda: bool(self._received), _NEVER)
            if not self._received:
                raise can.CanOperationError(f"{self.channel_info}: no event is left that could bring a frame")
        received = self.recv_frame(instant_after(self.timeline.now, max(timeout or 0.0, 0.0)))
        if received is None:
            return None
        return message_of(*received, is_rx=not isinstance(received, _OwnFrame), channel=self._channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue ``msg`` now; if the queue is full, let up to ``timeout`` seconds pass for a free place.

        Raises can.CanOperationError if the queue stays full, the bus is shut down or the
        message is none of classical CAN.
        """
        frame = frame_of(msg)
        port = self._port
        if timeout and port.pending >= TRANSMIT_QUEUE_MAX:
            limit = instant_after(self.timeline.now, timeout)
            self._step_until(lambda: port.pending < TRANSMIT_QUEUE_MAX, limit)
        port.send(frame)

    def shutdown(self) -> None:
        """Leave the segment; frames already queued still go out as its time passes."""
        super().shutdown()
        self._port.detach()

    def _step_until(self, done: Callable[[], bool], limit: Instant) -> None:
        timeline = self.timeline
        while not done():
            upcoming = timeline.next_at()
            if upcoming is None or upcoming > limit:
                return
            timeline.step()

    def _store(self, frame: Frame, at: Instant) -> None:
        if self._filters is None and len(self._received) < RECEIVE_QUEUE_MAX:
            self._received.append((frame, at))
        else:
            self._keep((frame, at))

    def _store_own(self, frame: Frame, at: Instant) -> None:
        self._keep(_OwnFrame((frame, at)))

    def _keep(self, entry: tuple[Frame, Instant]) -> None:
        if self._filters is not None and not accepts(self._filters, entry[0]):
            return
        if len(self._received) < RECEIVE_QUEUE_MAX:
            self._received.append(entry)
        else:
            self.overruns += 1

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> TimelineCyclicTask:
        task = TimelineCyclicTask(self.timeline, self.send, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task
