"""One CAN segment in simulated time: arbitration, exact frame time, frame spacing, load.

Unless asked for something else, every frame is acknowledged and none is corrupted: disturbed frames,
error counters, bus-off, missing acknowledgement, unplugged nodes and the like are the business of
:mod:`virtual_bus.can_bus.error_handling`, which takes over once any of them is used. A port that
sends sees its own frame's end through ``on_sent``. Two ports that send the same identifier at the
same time are served in the order in which they were attached (on a real bus their data would collide).

The next frame is chosen as soon as the bus is known to become free, and stays open to
contest until its start of frame: whatever else is queued by then, also at that very
instant, takes part in the arbitration. So a frame costs one event, and the outcome does
not depend on the order of events within an instant.
"""

from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from typing import Final

import can

from drivers.timebase import Duration, Instant
from virtual_bus.can_bus.arbitration import arbitration_key
from virtual_bus.can_bus.bit_length import INTERMISSION_BITS, LONGEST_FRAME_BITS, bits_duration, wire_bits
from virtual_bus.can_bus.bus_load import BusLoad
from virtual_bus.can_bus.controller import Controller
from virtual_bus.can_bus.disturbance import Disturb, OnError
from virtual_bus.can_bus.error_handling import ErrorHandling
from virtual_bus.can_bus.error_state import ErrorState
from virtual_bus.frame import Frame
from virtual_bus.timeline import Timeline

_push: Final = heappush
_pop: Final = heappop

OnFrame = Callable[[Frame, Instant], None]
OnErrorState = Callable[[ErrorState, Instant], None]

TRANSMIT_QUEUE_MAX: Final = 256
"""Frames that a port holds for the bus; one more is refused."""


def _ignore(_frame: Frame, _at: Instant) -> None:
    """What a detached port does with a frame."""


_IGNORE: Final = _ignore


class Port:
    """A node's connection to a segment: a first-in first-out transmit queue and a callback."""

    __slots__ = (
        "_queue",
        "_rank",
        "_room",
        "_segment",
        "controller",
        "name",
        "on_error_state",
        "on_frame",
        "on_sent",
        "recover_after_ns",
    )

    def __init__(self, segment: "Segment", rank: int, name: str, on_frame: OnFrame) -> None:
        self.name = name
        self.on_frame = on_frame
        self.on_sent: OnFrame | None = None
        self.on_error_state: OnErrorState | None = None
        """Told when the controller gets error active, error passive or bus-off."""
        self.recover_after_ns: int | None = None
        """So long after bus-off the controller begins to recover by itself; None: only on request."""
        self.controller = Controller(segment.bitrate_bit_s)
        self._segment = segment
        self._rank = rank
        self._queue: deque[tuple[int, Frame]] = deque()
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
        if len(queue) >= self._room or self.on_frame is _IGNORE:
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
        handling = self._segment._handled()
        self.controller.bitrate_bit_s = bitrate_bit_s
        handling.choose()

    def _reopen(self) -> None:
        """The controller is back from bus-off."""
        self._room = TRANSMIT_QUEUE_MAX

    def _refusal(self) -> can.CanOperationError:
        if self._room == 0:
            return can.CanOperationError(f"{self.name}: the controller is bus-off")
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
        "_error_monitors",
        "_free_at",
        "_handling",
        "_intermission",
        "_judge",
        "_key",
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
        self._contenders: list[tuple[int, int, Port]] = []  # heads of queues, but for the sender's
        self._sender: Port | None = None
        self._key = 0
        self._start_at = Instant(0)
        self._end_at = Instant(0)
        self._free_at = Instant(0)
        self._delivering = False
        self._on_end = self._finish
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

    def _contend(self, key: int, port: Port) -> None:
        """``port`` has a frame at the head of its queue, of arbitration key ``key``."""
        if self._handling is not None:
            self._handling.choose()
            return
        sender = self._sender
        if sender is None and not self._delivering:
            self._begin(key, port)
            return
        if (
            sender is not None
            and self.timeline.now <= self._start_at
            and (key, port._rank) < (self._key, sender._rank)
        ):  # the frame chosen before has not begun and loses
            _push(self._contenders, (self._key, sender._rank, sender))
            self._begin(key, port)
            return
        _push(self._contenders, (key, port._rank, port))

    def _begin(self, key: int, port: Port) -> None:
        """Let ``port`` send the head of its queue as soon as the bus is free."""
        timeline = self.timeline
        start = self._free_at
        if timeline.now > start:
            start = timeline.now
        _, data, _, remote, remote_length = port._queue[0][1]
        dlc = remote_length if remote else len(data)
        bits = wire_bits(key << 4 | dlc, data)
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
            _push(contenders, (queue[0][0], sender._rank, sender))
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
            if self._handling is not None:
                self._handling.choose()
            elif contenders:
                key, _, port = _pop(contenders)
                self._begin(key, port)
