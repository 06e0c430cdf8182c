"""A node's connection to a segment, and what it and the error handling know of the segment."""

import errno
from collections.abc import Callable
from typing import Final

import can
from mypy_extensions import mypyc_attr

from drivers.timebase import Duration, Instant
from virtual_bus.bus.bit_length import INTERMISSION_BITS, arbitration_key, bits_duration
from virtual_bus.bus.bus_load import BusLoad
from virtual_bus.bus.controller import CanController, ErrorState
from virtual_bus.bus.disturbance import Disturb, OnError
from virtual_bus.frame import Frame
from virtual_bus.timeline import Timeline

OnFrame = Callable[[Frame, Instant], None]


@mypyc_attr(allow_interpreted_subclasses=True)
class Listener:
    """The owner of a port. This one ignores every frame, like a port that was detached."""

    def on_frame(self, frame: Frame, now: Instant) -> None:
        """Another port's frame ended at ``now``."""


NOBODY = Listener()


OnErrorState = Callable[[ErrorState, Instant], None]

TRANSMIT_QUEUE_MAX: Final = 256
"""Frames that a port holds for the bus; one more is refused. A sub-block of an SDO block transfer is sent at
once, 127 segments (CiA 301, 7.2.4.3), and PDOs go on beside it."""


class Handling:
    """In charge of the arbitration once something may go wrong with a frame or a port."""

    def choose(self) -> None:
        """Let the port begin that can do so first and, among several, wins the arbitration."""
        raise NotImplementedError

    def left(self, port: "Port") -> None:
        """``port`` was detached; what it has queued still goes out."""
        raise NotImplementedError

    def pull_off(self, port: "Port") -> None:
        """``port`` has just left the wire: a frame of its own under way breaks off."""
        raise NotImplementedError

    def plug(self, port: "Port") -> None:
        """``port`` is on the wire again."""
        raise NotImplementedError

    def force_off(self, port: "Port") -> None:
        """``port`` goes bus-off at once."""
        raise NotImplementedError

    def recover(self, port: "Port") -> None:
        """``port`` begins to recover from bus-off."""
        raise NotImplementedError


class BusMedium:
    """What the ports of a segment share, and who is sending; how a frame goes over it, the segment says."""

    def __init__(self, timeline: Timeline, bitrate: int, acknowledged: bool) -> None:
        if bitrate <= 0:
            raise ValueError(f"bitrate {bitrate} bit/s: it must be positive")
        self.timeline = timeline
        self.bitrate_bit_s = bitrate
        self.acknowledged = acknowledged
        self.frames = 0
        self.errors = 0
        """Attempts that ended in an error frame."""
        self._intermission: Duration = bits_duration(INTERMISSION_BITS, bitrate)
        self._load = BusLoad()
        self._ports: tuple[Port, ...] = ()
        self._monitors: tuple[OnFrame, ...] = ()
        self._contenders: list[Port] = []  # those that wait, but for the sender
        self._sender: Port | None = None
        self._start_at = Instant(0)
        self._end_at = Instant(0)
        self._free_at = Instant(0)
        self._delivering = False
        self._judge: Disturb | None = None
        self._error_monitors: tuple[OnError, ...] = ()

    def _handled(self) -> Handling:
        """The error handling, which is in charge from the first call on."""
        raise NotImplementedError

    def _forget(self, port: "Port") -> None:
        """``port`` is no longer one of the segment's."""
        raise NotImplementedError

    def _contend(self, port: "Port") -> None:
        """``port`` has a frame at the head of its queue."""
        raise NotImplementedError


class Port:
    """A node's connection to a segment: a first-in first-out transmit queue and a listener."""

    def __init__(self, segment: "BusMedium", rank: int, name: str, listener: Listener) -> None:
        self.name = name
        self.listener = listener
        """Gets every other port's frame."""
        self.on_sent: OnFrame | None = None
        self.on_error_state: OnErrorState | None = None
        """Told when the controller gets error active, error passive or bus-off."""
        self.recover_after_ns: int | None = None
        """So long after bus-off the controller begins to recover by itself; None: only on request."""
        self.controller = CanController(segment.bitrate_bit_s)
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
