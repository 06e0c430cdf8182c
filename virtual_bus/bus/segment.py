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

import errno
from collections.abc import Callable
from typing import Final

import can

from drivers.timebase import Duration, Instant
from virtual_bus.bus.arbitration import arbitration_key
from virtual_bus.bus.bit_length import INTERMISSION_BITS, LONGEST_FRAME_BITS, bits_duration, wire_bits
from virtual_bus.bus.bus_load import BusLoad
from virtual_bus.bus.controller import Controller
from virtual_bus.bus.disturbance import Disturb, OnError
from virtual_bus.bus.error_handling import ErrorHandling
from virtual_bus.bus.error_state import ErrorState
from virtual_bus.bus.listener import NOBODY, Listener, OnFrame, listener_of
from virtual_bus.event_heap import Action
from virtual_bus.frame import Frame
from virtual_bus.timeline import Timeline

OnErrorState = Callable[[ErrorState, Instant], None]

TRANSMIT_QUEUE_MAX: Final = 256
"""Frames that a port holds for the bus; one more is refused."""


class Port:
    """A node's connection to a segment: a first-in first-out transmit queue and a listener."""

    __slots__ = (
        "_key",
        "_queue",
        "_rank",
        "_room",
        "_segment",
        "controller",
        "listener",
        "name",
        "on_error_state",
        "on_sent",
        "recover_after_ns",
    )

    def __init__(self, segment: "Segment", rank: int, name: str, listener: Listener) -> None:
        self.name = name
        self.listener = listener
        """Gets every other port's frame."""
        self.on_sent: OnFrame | None = None
        self.on_error_state: OnErrorState | None = None
        """Told when the controller gets error active, error passive or bus-off."""
        self.recover_after_ns: int | None = None
        """So long after bus-off the controller begins to recover by itself; None: only on request."""
        self.controller = Controller(segment.bitrate_bit_s)
        self._segment = segment
        self._rank = rank
        self._queue: list[Frame] = []
        self._key = 0
        """Arbitration key of the frame at the head of the queue."""
        self._room = TRANSMIT_QUEUE_MAX

    @property
    def error_state(self) -> ErrorState:
        """Error active, error passive or bus-off."""
        return self.controller.state

    @property
    def transmit_errors(self) -> int:
        """The transmit error counter; 256 stands for bus-off."""
        return self.controller.transmit_errors

    @property
    def receive_errors(self) -> int:
        """The receive error counter, at most 255."""
        return self.controller.receive_errors

    @property
    def plugged(self) -> bool:
        """Whether it is on the wire."""
        return self.controller.plugged

    @property
    def listen_only(self) -> bool:
        """Whether it never drives the bus: no frame, no acknowledgement, no error flag."""
        return self.controller.listen_only

    @property
    def bitrate_bit_s(self) -> int:
        """The bit rate that the node is set to, bit/s; right if it is the segment's."""
        return self.controller.bitrate_bit_s

    @property
    def pending(self) -> int:
        """Frames that wait for the bus, the one being sent included."""
        return len(self._queue)

    def send(self, frame: Frame) -> None:
        """Queue ``frame``. Raises can.CanOperationError if the queue is full, or the port off or detached."""
        queue = self._queue
        if len(queue) >= self._room or self.listener is NOBODY:
            raise self._refusal()
        queue.append(frame)
        if len(queue) == 1:
            self._key = arbitration_key(frame)
            self._segment._contend(self)

    def detach(self) -> None:
        """Receive no more and accept no more; what was queued still goes out, as from a controller."""
        self.listener = NOBODY
        self.on_sent = None
        self._segment._forget(self)

    def go_bus_off(self) -> None:
        """Go bus-off at once: what was queued is discarded, and nothing is sent or received."""
        self._segment._handled().force_off(self)

    def recover(self) -> None:
        """Begin to recover from bus-off, which takes 128 times 11 recessive bits."""
        self._segment._handled().recover(self)

    def unplug(self) -> None:
        """Leave the wire: hear and send nothing, keep the queue; a frame under way is cut off."""
        if self.controller.plugged:
            handling = self._segment._handled()
            self.controller.plugged = False
            handling.pull_off(self)

    def plug(self) -> None:
        """Be on the wire again, from the next frame on."""
        if not self.controller.plugged:
            self.controller.plugged = True
            self._segment._handled().plug(self)

    def set_listen_only(self, listen_only: bool) -> None:
        """Never drive the bus, or do so again; what is queued waits."""
        handling = self._segment._handled()
        self.controller.listen_only = listen_only
        handling.choose()

    def set_bitrate(self, bitrate_bit_s: int) -> None:
        """Set the node to that bit rate; at another one than the segment's it destroys frames.

        Raises ValueError for a rate that is not positive.
        """
        if bitrate_bit_s <= 0:
            raise ValueError(f"bitrate {bitrate_bit_s} bit/s: it must be positive")
        if bitrate_bit_s == self.controller.bitrate_bit_s:
            return
        handling = self._segment._handled()
        self.controller.bitrate_bit_s = bitrate_bit_s
        handling.choose()

    def _reopen(self) -> None:
        """The controller is back from bus-off."""
        self._room = TRANSMIT_QUEUE_MAX

    def _refusal(self) -> can.CanOperationError:
        if self._room == 0:
            return can.CanOperationError(f"{self.name}: the controller is bus-off")
        if self.listener is NOBODY:
            return can.CanOperationError(f"{self.name}: the port is detached from its segment")
        full = f"{self.name}: transmit queue is full ({TRANSMIT_QUEUE_MAX} frames)"
        return can.CanOperationError(full, errno.ENOBUFS)


class _EndOfFrame(Action):
    """The last bit of the frame under way."""

    def __init__(self, segment: "Segment") -> None:
        self._segment = segment

    def happen(self, now: Instant) -> None:
        self._segment._finish(now)


class Segment:
    """A bus of one bit rate on a timeline, with any number of ports."""

    __slots__ = (
        "_attached",
        "_contenders",
        "_delivering",
        "_durations",
        "_end_at",
        "_error_monitors",
        "_free_at",
        "_handling",
        "_intermission",
        "_judge",
        "_load",
        "_monitors",
        "_on_end",
        "_ports",
        "_sender",
        "_start_at",
        "acknowledged",
        "bitrate_bit_s",
        "errors",
        "frames",
        "timeline",
    )

    def __init__(self, timeline: Timeline, bitrate: int = 1_000_000, acknowledged: bool = True) -> None:
        """``acknowledged``: something that is no port acknowledges every frame; else another port has to."""
        if bitrate <= 0:
            raise ValueError(f"bitrate {bitrate} bit/s: it must be positive")
        self.timeline = timeline
        self.bitrate_bit_s = bitrate
        self.acknowledged = acknowledged
        self.frames = 0
        self.errors = 0
        """Attempts that ended in an error frame."""
        self._durations = [bits_duration(bits, bitrate) for bits in range(LONGEST_FRAME_BITS + 1)]
        self._intermission = bits_duration(INTERMISSION_BITS, bitrate)
        self._load = BusLoad()
        self._ports: tuple[Port, ...] = ()
        self._attached = 0
        self._monitors: tuple[OnFrame, ...] = ()
        self._contenders: list[Port] = []  # those that wait, but for the sender
        self._sender: Port | None = None
        self._start_at = Instant(0)
        self._end_at = Instant(0)
        self._free_at = Instant(0)
        self._delivering = False
        self._on_end = _EndOfFrame(self)
        self._judge: Disturb | None = None
        self._error_monitors: tuple[OnError, ...] = ()
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

    def attach(self, name: str, owner: Listener | OnFrame) -> Port:
        """A port whose ``owner`` gets every other port's frame at its end of frame."""
        self._attached += 1
        port = Port(self, self._attached, name, listener_of(owner))
        self._ports = (*self._ports, port)
        return port

    def add_monitor(self, on_frame: OnFrame) -> Callable[[], None]:
        """Show every frame, whoever sent it, to ``on_frame`` at its end; returns what ends that."""
        self._monitors = (*self._monitors, on_frame)

        def remove() -> None:
            self._monitors = tuple(monitor for monitor in self._monitors if monitor is not on_frame)

        return remove

    def set_disturb(self, judge: Disturb | None) -> None:
        """Ask ``judge`` at each attempt to send what disturbs it; None: nothing any more."""
        self._judge = judge
        if judge is not None:
            self._handled()

    def add_error_monitor(self, on_error: OnError) -> Callable[[], None]:
        """Show every error frame to ``on_error`` at its end; returns what ends that."""
        self._error_monitors = (*self._error_monitors, on_error)

        def remove() -> None:
            self._error_monitors = tuple(one for one in self._error_monitors if one is not on_error)

        return remove

    def ports(self) -> tuple[Port, ...]:
        """The ports, in the order in which they were attached."""
        return self._ports

    def port(self, name: str) -> Port:
        """The port of that name. Raises LookupError if there is none or more than one."""
        found = [port for port in self._ports if port.name == name]
        if len(found) != 1:
            names = ", ".join(sorted(port.name for port in self._ports))
            raise LookupError(f"{len(found)} ports of the name {name!r}; there are {names or 'none'}")
        return found[0]

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
