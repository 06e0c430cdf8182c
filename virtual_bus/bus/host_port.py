"""A participant's place on a simulated segment: its inbox, its sending, and the faults in front of both
(core/host_place.c).
"""

from functools import partial

from can.typechecking import CanFilters

from servobench.drivers.timebase import NEVER, Instant
from servobench.drivers.wire.frame_port import EchoBasis, FramePort, accepts
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.judge import Direction, Judge
from servobench.virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Port
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import HostPlace
from servobench.virtual_bus.frame import Frame


class HostPort(FramePort):
    """One participant of ``segment``."""

    def __init__(self, segment: CanSegment, name: str) -> None:
        super().__init__()
        self.timeline = segment.timeline
        self.received = HostPlace(segment.timeline)
        """Frames to be fetched."""
        self.native = self.received
        self.held_in = self.received.held_in
        self.held_out = self.received.held_out
        self.port: Port = segment.attach(name, self.received)
        self.received.take_port(self.port)
        self._receive, self._transmit = self.received.receive, self.received.transmit

    @property
    def overruns(self) -> int:
        """Frames lost because nobody fetched them."""
        return self.received.overruns

    def filter(self, filters: CanFilters | None) -> None:
        """Let only those through that ``filters`` accept: they stand in front of the faults."""
        self.received.accepts = None if filters is None else partial(accepts, filters)

    def put_before(self, judge: Judge, out: Direction) -> None:
        """Let ``judge`` decide about every frame from now on; ``out``: the way of the frames sent here."""
        self.received.put_before(judge, int(out))

    def receive(self, until: Instant) -> Frame | None:
        """The next frame; None if there is none up to ``until``.

        Time passes no further than to that frame, or to ``until``.
        """
        received = self._receive(until)
        if received is None:
            return None
        frame, self.came_at, self.came_own = received
        return frame

    def transmit(self, frame: Frame) -> None:
        """Queue ``frame`` now. Raises can.CanOperationError if the transmit queue is full."""
        self._transmit(frame)

    def flush(self) -> None:
        """Forget what is held for sending."""
        self.held_out.clear()

    def hear_itself(self) -> None:
        """Let its own frames come back from now on, at their end of frame; they meet no fault."""
        self.echoes = EchoBasis.BUS
        self.port.on_sent = self.received.on_sent

    def send_held(self) -> None:
        """Send at once what is held and has room."""
        off = self.port.error_state is ErrorState.BUS_OFF
        room = 0 if off else TRANSMIT_QUEUE_MAX - self.port.pending
        while room > 0 and (held := self.held_out.take(NEVER)) is not None:
            self.port.send(held[2])
            room -= 1
        self.flush()

    def close(self) -> None:
        """Send what is held, as a last command may be among it, and leave the segment."""
        self.send_held()
        self.received.closed = True
        self.port.detach()
