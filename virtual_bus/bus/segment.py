"""One CAN segment in simulated time: arbitration, exact frame time, frame spacing, load.

Unless asked for something else, every frame is acknowledged and none is corrupted: disturbed frames,
error counters, bus-off, missing acknowledgement, unplugged nodes and the like are the business of
:mod:`virtual_bus.bus.error_handling`, which takes over once any of them is used. A port that
sends sees its own frame's end through ``on_sent``. Two ports that send the same identifier at the
same time are served in the order in which they were attached (on a real bus their data would collide).

The next frame is chosen as soon as the bus is known to become free, and stays open to
contest until its start of frame: whatever else is queued by then, also at that very
instant, takes part in the arbitration. So a frame costs one event, and the outcome does
not depend on the order of events within an instant.
"""

from drivers.timebase import Duration, Instant
from virtual_bus.bus.bit_length import LONGEST_FRAME_BITS, arbitration_key, bits_duration
from virtual_bus.bus.disturbance import Disturb, OnError
from virtual_bus.bus.error_handling import ErrorHandling
from virtual_bus.bus.port import BusMedium, Listener, OnFrame, Port
from virtual_bus.core.native import wire_bits
from virtual_bus.event_heap import Action
from virtual_bus.timeline import Timeline


class _EndOfFrame(Action):
    """The last bit of the frame under way."""

    def __init__(self, segment: "CanSegment") -> None:
        self._segment = segment

    def happen(self, now: Instant) -> None:
        self._segment._finish(now)


class CanSegment(BusMedium):
    """A bus of one bit rate on a timeline, with any number of ports."""

    def __init__(self, timeline: Timeline, bitrate: int = 1_000_000, acknowledged: bool = True) -> None:
        """``acknowledged``: something that is no port acknowledges every frame; else another port has to."""
        super().__init__(timeline, bitrate, acknowledged)
        self._durations = [bits_duration(bits, bitrate) for bits in range(LONGEST_FRAME_BITS + 1)]
        self._attached = 0
        self._on_end = _EndOfFrame(self)
        self._handling: ErrorHandling | None = None
        if not acknowledged:
            self._handled()

    @property
    def busy_ns(self) -> Duration:
        """Time taken by completed frames and the intermission after each."""
        return self._load.busy_ns

    def load_percent(self, since: Instant, until: Instant) -> float:
        """Share of [since, until] that completed frames and intermissions took, percent."""
        return self._load.percent(since, until)

    def attach(self, name: str, owner: Listener) -> Port:
        """A port whose ``owner`` gets every other port's frame at its end of frame."""
        self._attached += 1
        port = Port(self, self._attached, name, owner)
        self._ports = (*self._ports, port)
        return port

    def add_monitor(self, on_frame: OnFrame) -> None:
        """Show every frame, whoever sent it, to ``on_frame`` at its end."""
        self._monitors = (*self._monitors, on_frame)

    def set_disturb(self, judge: Disturb | None) -> None:
        """Ask ``judge`` at each attempt to send what disturbs it; None: nothing any more."""
        self._judge = judge
        if judge is not None:
            self._handled()

    def add_error_monitor(self, on_error: OnError) -> None:
        """Show every error frame to ``on_error`` at its end."""
        self._error_monitors = (*self._error_monitors, on_error)

    def port(self, name: str) -> Port:
        """The port of that name. Raises LookupError if there is none or more than one."""
        named = [port for port in self._ports if port.name == name]
        if len(named) != 1:
            names = ", ".join(sorted(port.name for port in self._ports))
            raise LookupError(f"{len(named)} ports of the name {name!r}; there are {names or 'none'}")
        return named[0]

    def _handled(self) -> ErrorHandling:
        """The error handling, which is in charge from the first call on."""
        handling = self._handling
        if handling is None:
            self._handling = handling = ErrorHandling(self)
        return handling

    def _forget(self, port: Port) -> None:
        if port in self._ports and self._handling is not None:
            self._handling.left(port)
        self._ports = tuple(other for other in self._ports if other is not port)

    def _contend(self, port: Port) -> None:
        """``port`` has a frame at the head of its queue."""
        if self._handling is not None:
            self._handling.choose()
            return
        sender = self._sender
        if sender is None and not self._delivering:
            self._begin(port)
        elif sender is not None and self.timeline.now <= self._start_at and _wins(port, sender):
            self._contenders.append(sender)  # the frame chosen before has not begun and loses
            self._begin(port)
        else:
            self._contenders.append(port)

    def _begin(self, port: Port) -> None:
        """Let ``port`` send the head of its queue as soon as the bus is free."""
        timeline = self.timeline
        start = self._free_at
        if timeline.now > start:
            start = timeline.now
        frame = port._queue[0]
        data = frame.data
        dlc = frame.remote_length if frame.remote else len(data)
        bits = wire_bits(port._key << 4 | dlc, data)
        self._sender = port
        self._start_at = start
        self._end_at = end = Instant(start + self._durations[bits])
        timeline.enter(end, self._on_end)

    def _finish(self, now: Instant) -> None:
        """The last bit of end of frame has passed: deliver, and choose the next frame."""
        sender = self._sender
        if sender is None or now != self._end_at:
            return  # the end of a frame that lost the arbitration before its start
        queue = sender._queue
        frame = queue.pop(0)
        self._sender = None
        self._free_at = free_at = Instant(now + self._intermission)
        self.frames += 1
        self._load.add(free_at - self._start_at, free_at)
        if queue:
            sender._key = arbitration_key(queue[0])
            self._contenders.append(sender)
        self._delivering = True
        try:
            for monitor in self._monitors:
                monitor(frame, now)
            for port in self._ports:
                if port is not sender:
                    port.listener.on_frame(frame, now)
            if sender.on_sent is not None:
                sender.on_sent(frame, now)
        finally:
            self._delivering = False
            if self._handling is not None:
                self._handling.choose()
            elif self._contenders:
                self._begin(self._take_winner())

    def _take_winner(self) -> Port:
        """The contender that wins the arbitration."""
        contenders = self._contenders
        winner = contenders[0]
        for port in contenders:
            if _wins(port, winner):
                winner = port
        contenders.remove(winner)
        return winner


def _wins(port: Port, other: Port) -> bool:
    """Whether ``port`` wins the arbitration against ``other``."""
    return port._key < other._key or (port._key == other._key and port._rank < other._rank)
