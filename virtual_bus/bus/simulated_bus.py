"""python-can's view of a simulated segment."""

from collections.abc import Callable, Sequence

import can
from can.broadcastmanager import (
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)
from can.typechecking import CanFilters

from servobench.drivers.timebase import NEVER, Instant, instant_after
from servobench.drivers.wire.message import frame_of, message_of
from servobench.virtual_bus.bus.error_message import bus_state
from servobench.virtual_bus.bus.host_port import HostPort
from servobench.virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Port
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.timeline import Event, Timeline


class TimelineCyclicTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """In the place of python-can's thread: sends its messages in turn, one each period, from ``start`` on.

    The due times are start + k * period: they do not drift. A message that the transmit
    queue refuses is counted in ``refused`` and not sent later.
    """

    def __init__(
        self,
        timeline: Timeline,
        send: Callable[[can.Message], None],
        messages: Sequence[can.Message] | can.Message,
        period_s: float,
        limit_s: float | None,
        modify: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period_s, limit_s)
        self._timeline = timeline
        self._send = send
        self._modify = modify
        self._event: Event | None = None
        self._started_at = Instant(0)
        self._turn = 0
        self.refused = 0

    def start(self) -> None:
        """Send the first message now; no effect while running."""
        if self._event is None:
            self._started_at = self._timeline.now
            self._turn = 0
            self._event = self._timeline.call_at(self._started_at, self._fire)

    def stop(self) -> None:
        """Send no more; no effect if stopped."""
        if self._event is not None:
            self._event.cancel()
            self._event = None

    def _fire(self, _now: Instant) -> None:
        message = self.messages[self._turn % len(self.messages)]
        if self._modify is not None:
            self._modify(message)
        try:
            self._send(message)
        except can.CanOperationError:
            self.refused += 1
        self._turn += 1
        due = Instant(self._started_at + self._turn * self.period_ns)
        if self.duration is not None and due >= instant_after(self._started_at, self.duration):
            self._event = None
        else:
            self._event = self._timeline.call_at(due, self._fire)


class SimulatedBus(can.BusABC):
    """``can.Bus(interface="simulated", segment=segment)``.

    Without ``segment`` it makes its own, on a timeline of its own. ``recv`` lets simulated
    time pass until a frame is there; ``send`` queues at the present instant and lets none pass.
    A message's timestamp is its end of frame in seconds of simulated time, or that of its release
    if a fault held it.
    """

    def __init__(
        self,
        channel: str | None = None,
        can_filters: CanFilters | None = None,
        *,
        segment: CanSegment | None = None,
        bitrate: int = 1_000_000,
        receive_own_messages: bool = False,
        **_: object,
    ) -> None:
        self.segment = segment if segment is not None else CanSegment(Timeline(), bitrate)
        self.timeline = self.segment.timeline
        self.channel_info = f"simulated segment, port {channel or 'host'}"
        self._channel = channel
        self.frame_port = host_port = HostPort(self.segment, channel or "host")
        """Its frames without python-can."""
        if receive_own_messages:
            host_port.hear_itself()
        super().__init__(channel or "", can_filters)

    @property
    def overruns(self) -> int:
        """Frames lost because nobody fetched them."""
        return self.frame_port.overruns

    @property
    def port(self) -> Port:
        """Its place on the segment: to unplug, to take off the bus, to ask for error counters."""
        return self.frame_port.port

    @property
    def state(self) -> can.BusState:
        """ACTIVE or PASSIVE for an error active or passive controller; ERROR: bus-off."""
        return bus_state(self.frame_port.port.error_state)

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        """Raises NotImplementedError: the state is what the counters make it."""
        raise NotImplementedError("the error state follows the error counters; see port.set_listen_only")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message; None after ``timeout`` seconds of simulated time.

        Raises can.CanOperationError if the bus is shut down, and without a timeout also if
        no event is left that could bring a frame.
        """
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        inbox = self.frame_port.received
        if timeout is None:
            self._step_until(lambda: bool(inbox), NEVER)
            if not inbox:
                raise can.CanOperationError(f"{self.channel_info}: no event is left that could bring a frame")
        port = self.frame_port
        frame = port.receive(instant_after(self.timeline.now, max(timeout or 0.0, 0.0)))
        if frame is None:
            return None
        return message_of(frame, port.came_at, is_rx=not port.came_own, channel=self._channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue ``msg`` now; if the queue is full, let up to ``timeout`` seconds pass for a free place.

        Raises can.CanOperationError if the queue stays full, the bus is shut down or the
        message is none of classical CAN.
        """
        frame = frame_of(msg)
        port = self.frame_port.port
        if timeout and port.pending >= TRANSMIT_QUEUE_MAX:
            limit = instant_after(self.timeline.now, timeout)
            self._step_until(lambda: port.pending < TRANSMIT_QUEUE_MAX, limit)
        self.frame_port.transmit(frame)

    def flush_tx_buffer(self) -> None:
        """Forget what a fault holds back from sending."""
        self.frame_port.flush()

    def shutdown(self) -> None:
        """Leave the segment; frames already queued still go out as its time passes."""
        if self._is_shutdown:
            return
        super().shutdown()
        self.frame_port.close()

    def _apply_filters(self, filters: CanFilters | None) -> None:
        self.frame_port.filter(filters)

    def _step_until(self, done: Callable[[], bool], limit: Instant) -> None:
        timeline = self.timeline
        while not done():
            upcoming = timeline.next_at()
            if upcoming is None or upcoming > limit:
                return
            timeline.step()

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
