"""A participant's place on a simulated segment: its inbox, its sending, and the faults in front of both.

What comes in and what goes out can be given to a judge, who passes, loses or holds each frame. What
is held waits on the segment's own timeline, so a fault costs one event and no polling:

    segment -- end of frame --> judge -- at once, or at its release --> inbox -- receive --> owner
    owner -- transmit --> judge -- at once, or at its release --> transmit queue --> segment
    segment -- end of an own frame --> inbox
"""

from typing import Final

from can.typechecking import CanFilters

from drivers.timebase import NEVER, Instant
from drivers.wire.frame_port import EchoBasis, FramePort, accepts
from virtual_bus.bus.controller import ErrorState
from virtual_bus.bus.held_frames import HeldFrames
from virtual_bus.bus.judge import Direction, Judge
from virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Listener, Port
from virtual_bus.bus.segment import CanSegment
from virtual_bus.event_heap import Action
from virtual_bus.frame import Frame

RECEIVE_QUEUE_MAX: Final = 65_536
"""Frames that an inbox holds for its reader; later ones are lost and counted. Three seconds of a bus at
1 Mbit/s that is full of the shortest frames, some 20 000 a second."""


_SPENT_MAX: Final = 64
"""Places at the head that are kept before the rest is moved up: so a queue of any length is moved for one
frame in 64 at most."""


class ReceivedFrame:
    """A received frame, and the instant at which it came."""

    __slots__ = ("at", "frame", "own")

    def __init__(self, frame: Frame, at: Instant, own: bool) -> None:
        """``own``: the participant has sent it itself."""
        self.frame = frame
        self.at = at
        self.own = own


class Inbox:
    """First in, first out, with a bound."""

    __slots__ = ("_arrivals", "_most", "_taken")

    def __init__(self, most: int) -> None:
        self._arrivals: list[ReceivedFrame] = []
        self._taken = 0
        self._most = most

    def __len__(self) -> int:
        return len(self._arrivals) - self._taken

    def put(self, arrival: ReceivedFrame) -> bool:
        """Add ``arrival``; False if there is no room."""
        arrivals = self._arrivals
        if len(arrivals) - self._taken >= self._most:
            return False
        arrivals.append(arrival)
        return True

    def take(self) -> ReceivedFrame:
        """The first one. Error: IndexError."""
        arrivals = self._arrivals
        arrival = arrivals[self._taken]
        self._taken += 1
        if self._taken == len(arrivals):
            arrivals.clear()
            self._taken = 0
        elif self._taken >= _SPENT_MAX and self._taken * 2 > len(arrivals):
            del arrivals[: self._taken]
            self._taken = 0
        return arrival


class _Release(Action):
    """The instant at which a held frame goes on."""

    def __init__(self, owner: "HostPort", out: bool) -> None:
        self._owner = owner
        self._out = out

    def happen(self, now: Instant) -> None:
        if self._out:
            self._owner._let_out(now)
        else:
            self._owner._let_in(now)


class _Ear(Listener):
    """Hears the segment for a host port."""

    def __init__(self, owner: "HostPort") -> None:
        self._owner = owner

    def on_frame(self, frame: Frame, now: Instant) -> None:
        self._owner._on_frame(frame, now)


class HostPort(FramePort):
    """One participant of ``segment``."""

    def __init__(self, segment: CanSegment, name: str) -> None:
        super().__init__()
        self.timeline = segment.timeline
        self.received = Inbox(RECEIVE_QUEUE_MAX)
        self.overruns = 0
        """Frames lost because nobody fetched them."""
        self.filters: CanFilters | None = None
        """Acceptance filters, in front of the faults."""
        self.held_in = HeldFrames()
        self.held_out = HeldFrames()
        self._judge: Judge | None = None
        self._out = int(Direction.HOST_TO_DRIVE)
        self._in = int(Direction.DRIVE_TO_HOST)
        self._release_in = _Release(self, False)
        self._release_out = _Release(self, True)
        self._closed = False
        self.port: Port = segment.attach(name, _Ear(self))

    def put_before(self, judge: Judge, out: Direction) -> None:
        """Let ``judge`` decide about every frame from now on; ``out``: the way of the frames sent here."""
        self._judge = judge
        self._out = int(out)
        into_drive = out is Direction.DRIVE_TO_HOST
        self._in = int(Direction.HOST_TO_DRIVE if into_drive else Direction.DRIVE_TO_HOST)

    def receive(self, until: Instant) -> Frame | None:
        """The next frame; None if there is none up to ``until``.

        Time passes no further than to that frame, or to ``until``.
        """
        received = self.received
        if not received and not self.timeline.run_until_filled(until, received):
            return None
        arrival = received.take()
        self.came_at = arrival.at
        self.came_own = arrival.own
        return arrival.frame

    def transmit(self, frame: Frame) -> None:
        """Queue ``frame`` now. Raises can.CanOperationError if the transmit queue is full."""
        judge = self._judge
        if judge is None:
            self.port.send(frame)
            return
        now = self.timeline.now
        delay = judge.hold(self._out, frame.can_id, now, frame.extended)
        if delay < 0:
            for other, later in judge.replacements(frame):
                self._pass_out(other, later)
        elif delay == 0:
            self.port.send(frame)
        else:
            self._pass_out(frame, delay)

    def _pass_out(self, frame: Frame, delay: int) -> None:
        """Send ``frame`` after ``delay``."""
        if delay == 0:
            self.port.send(frame)
            return
        release = Instant(self.timeline.now + delay)
        if self.held_out.hold(frame, release):
            self.timeline.enter(release, self._release_out)

    def flush(self) -> None:
        """Forget what is held for sending."""
        self.held_out.clear()

    def hear_itself(self) -> None:
        """Let its own frames come back from now on, at their end of frame; they meet no fault."""
        self.echoes = EchoBasis.BUS
        self.port.on_sent = self._on_sent

    def _on_sent(self, frame: Frame, at: Instant) -> None:
        self._keep(frame, at, True)

    def _keep(self, frame: Frame, at: Instant, own: bool = False) -> None:
        """Put a frame into the inbox, if a filter lets it through and there is room."""
        if self.filters is not None and not accepts(self.filters, frame):
            return
        if not self.received.put(ReceivedFrame(frame, at, own)):
            self.overruns += 1

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
        self._closed = True
        self.port.detach()

    def _on_frame(self, frame: Frame, now: Instant) -> None:
        judge = self._judge
        if judge is None or (self.filters is not None and not accepts(self.filters, frame)):
            self._keep(frame, now)
            return
        delay = judge.hold(self._in, frame.can_id, now, frame.extended)
        if delay < 0:
            for other, later in judge.replacements(frame):
                self._pass_in(other, now, later)
        elif delay == 0:
            self._keep(frame, now)
        else:
            self._pass_in(frame, now, delay)

    def _pass_in(self, frame: Frame, at: Instant, delay: int) -> None:
        """Keep what came at ``at`` after ``delay``."""
        if delay == 0:
            self._keep(frame, at)
            return
        release = Instant(at + delay)
        if self.held_in.hold(frame, release):
            self.timeline.enter(release, self._release_in)

    def _let_in(self, now: Instant) -> None:
        held = self.held_in.take(now)
        if held is not None and not self._closed:
            self._keep(held[2], now)

    def _let_out(self, now: Instant) -> None:
        held = self.held_out.take(now)
        if held is not None and self.port.error_state is not ErrorState.BUS_OFF:
            self.port.send(held[2])
