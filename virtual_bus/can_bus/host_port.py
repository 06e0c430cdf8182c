"""A participant's place on a simulated segment: its inbox, its sending, and the faults in front of both.

What comes in and what goes out can be given to a judge, who passes, loses or holds each frame. What
is held waits on the segment's own timeline, so a fault costs one event and no polling:

    segment -- end of frame --> judge -- at once, or at its release --> inbox -- recv_frame --> owner
    owner -- send_frame --> judge -- at once, or at its release --> transmit queue --> segment
"""

from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from typing import Final

from can.typechecking import CanFilters

from drivers.timebase import Duration, Instant
from virtual_bus.can_bus.disturbance import BusError
from virtual_bus.can_bus.error_message import error_frame_of
from virtual_bus.can_bus.error_state import ErrorState
from virtual_bus.can_bus.filters import accepts
from virtual_bus.fault_injection.fault_plan import Direction
from virtual_bus.faults import FateSource
from virtual_bus.frame import Frame
from virtual_bus.segment import TRANSMIT_QUEUE_MAX, Port, Segment

RECEIVE_QUEUE_MAX: Final = 65_536
"""Frames that an inbox holds for its reader; later ones are lost and counted."""
HELD_MAX: Final = 4096
"""Frames held in one direction; one more is lost and counted."""

_push: Final = heappush
_pop: Final = heappop

Entry = tuple[Frame, Instant]
"""A received frame and the instant at which it came."""


class HostPort:
    """One participant of ``segment``."""

    def __init__(self, segment: Segment, name: str) -> None:
        self.timeline = segment.timeline
        self.received: deque[tuple[Frame, Instant, bool]] = deque()
        self.last_is_own = False
        """Whether the frame that was last fetched is one of its own that came back."""
        self.overruns = 0
        """Frames lost because nobody fetched them."""
        self.filters: CanFilters | None = None
        """Acceptance filters, in front of the faults."""
        self.overflow_in = 0
        self.overflow_out = 0
        """Frames lost because too many were held."""
        self._judge: FateSource | None = None
        self._out = Direction.HOST_TO_DRIVE
        self._in = Direction.DRIVE_TO_HOST
        self._incoming: list[tuple[Instant, int, Frame]] = []
        self._outgoing: list[tuple[Instant, int, Frame]] = []
        self._order = 0
        self._deaf_to_errors: Callable[[], None] | None = None
        self._release_in = self._let_in
        self._release_out = self._let_out
        self.port: Port = segment.attach(name, self._on_frame)

    def put_before(self, judge: FateSource, out: Direction) -> None:
        """Let ``judge`` decide about every frame from now on; ``out``: the way of the frames sent here."""
        self._judge = judge
        self._out = out
        into_drive = out is Direction.DRIVE_TO_HOST
        self._in = Direction.HOST_TO_DRIVE if into_drive else Direction.DRIVE_TO_HOST

    def recv_frame(self, until: Instant) -> Entry | None:
        """The next frame and the instant at which it came; None if there is none up to ``until``.

        Time passes no further than to that frame, or to ``until``.
        """
        received = self.received
        if received or self.timeline.run_until_filled(until, received):
            frame, at, self.last_is_own = received.popleft()
            return frame, at
        return None

    def send_frame(self, frame: Frame) -> None:
        """Queue ``frame`` now. Raises can.CanOperationError if the transmit queue is full."""
        judge = self._judge
        if judge is None:
            self.port.send(frame)
            return
        now = self.timeline.now
        dropped, delay = judge.fate(self._out, frame[0], now, frame[2])
        if dropped:
            for other, later in judge.replacements(frame):
                self._pass_out(other, later)
        elif delay == 0:
            self.port.send(frame)
        else:
            self._pass_out(frame, delay)

    def _pass_out(self, frame: Frame, delay: Duration) -> None:
        """Send ``frame`` after ``delay``."""
        if delay == 0:
            self.port.send(frame)
        elif len(self._outgoing) >= HELD_MAX:
            self.overflow_out += 1
        else:
            self._order += 1
            due = Instant(self.timeline.now + delay)
            _push(self._outgoing, (due, self._order, frame))
            self.timeline.post(due, self._release_out)

    def flush(self) -> None:
        """Forget what is held for sending."""
        self._outgoing.clear()

    def hear_itself(self) -> None:
        """Let its own frames come back from now on; they meet no fault."""
        self.port.on_sent = self._on_sent

    def hear_errors(self, segment: Segment) -> None:
        """Let error frames come in from now on, each as a frame whose identifier bears ERROR_FLAG."""
        self._deaf_to_errors = segment.add_error_monitor(self._on_error)

    def _on_error(self, error: BusError) -> None:
        if self.port.controller.on_bus:
            frame = error_frame_of(error, self.port.controller)
            if len(self.received) < RECEIVE_QUEUE_MAX:
                self.received.append((frame, error.at, False))
            else:
                self.overruns += 1

    def _on_sent(self, frame: Frame, at: Instant) -> None:
        self._keep(frame, at, True)

    def _keep(self, frame: Frame, at: Instant, own: bool = False) -> None:
        """Put a frame into the inbox, if a filter lets it through and there is room."""
        if self.filters is not None and not accepts(self.filters, frame):
            return
        if len(self.received) < RECEIVE_QUEUE_MAX:
            self.received.append((frame, at, own))
        else:
            self.overruns += 1

    def close(self) -> None:
        """Send at once what is held and has room, as a last command may be among it; leave the segment."""
        off = self.port.error_state is ErrorState.BUS_OFF
        room = 0 if off else TRANSMIT_QUEUE_MAX - self.port.pending
        while self._outgoing and room > 0:
            self.port.send(_pop(self._outgoing)[2])
            room -= 1
        self._outgoing.clear()
        self._incoming.clear()
        if self._deaf_to_errors is not None:
            self._deaf_to_errors()
        self.port.detach()

    def _on_frame(self, frame: Frame, at: Instant) -> None:
        judge = self._judge
        if judge is None or (self.filters is not None and not accepts(self.filters, frame)):
            self._keep(frame, at)
            return
        dropped, delay = judge.fate(self._in, frame[0], at, frame[2])
        if dropped:
            for other, later in judge.replacements(frame):
                self._pass_in(other, at, later)
        elif delay == 0:
            self._keep(frame, at)
        else:
            self._pass_in(frame, at, delay)

    def _pass_in(self, frame: Frame, at: Instant, delay: Duration) -> None:
        """Keep what came at ``at`` after ``delay``."""
        if delay == 0:
            self._keep(frame, at)
        elif len(self._incoming) >= HELD_MAX:
            self.overflow_in += 1
        else:
            self._order += 1
            due = Instant(at + delay)
            _push(self._incoming, (due, self._order, frame))
            self.timeline.post(due, self._release_in)

    def _let_in(self, now: Instant) -> None:
        incoming = self._incoming
        while incoming and incoming[0][0] <= now:
            due, _, frame = _pop(incoming)
            self._keep(frame, due)

    def _let_out(self, now: Instant) -> None:
        outgoing = self._outgoing
        off = self.port.error_state is ErrorState.BUS_OFF
        while outgoing and outgoing[0][0] <= now:
            frame = _pop(outgoing)[2]
            if not off:
                self.port.send(frame)
