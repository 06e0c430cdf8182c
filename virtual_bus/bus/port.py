"""A node's connection to a segment: its queue and arbitration (core/segment.c), and its CAN controller."""

import errno
from collections.abc import Callable
from typing import Final, Protocol

import can

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.controller import CanController, ErrorState
from servobench.virtual_bus.bus.listener import Listener as Listener
from servobench.virtual_bus.bus.listener import OnFrame as OnFrame
from servobench.virtual_bus.core import native

OnErrorState = Callable[[ErrorState, Instant], None]

TRANSMIT_QUEUE_MAX: Final = native.TRANSMIT_QUEUE_MAX
"""Frames that a port holds for the bus; one more is refused. A sub-block of an SDO block transfer is sent at
once, 127 segments (CiA 301, 7.2.4.3), and PDOs go on beside it."""


class Handling(Protocol):
    """The error handling of a segment, as a port sees it."""

    def choose(self) -> None:
        """Let the port begin that can do so first and, among several, wins the arbitration."""

    def left(self, port: "Port") -> None:
        """``port`` was detached; what it has queued still goes out."""

    def pull_off(self, port: "Port") -> None:
        """``port`` has just left the wire: a frame of its own under way breaks off."""

    def plug(self, port: "Port") -> None:
        """``port`` is on the wire again."""

    def force_off(self, port: "Port") -> None:
        """``port`` goes bus-off at once."""

    def recover(self, port: "Port") -> None:
        """``port`` begins to recover from bus-off."""


class Medium(native.Segment):
    """The segment of a port."""

    def handled(self) -> Handling:
        """The error handling, which is in charge from the first call on."""
        raise NotImplementedError


class Port(native.Port):
    """A first-in first-out transmit queue and a listener; ``send`` raises can.CanOperationError if the queue
    is full, or the port off or detached."""

    def __init__(self, segment: Medium, rank: int, name: str, listener: Listener | native.HostPlace) -> None:  # noqa: ARG002
        self.on_error_state: OnErrorState | None = None
        """Told when the controller gets error active, error passive or bus-off."""
        self.recover_after_ns: int | None = None
        """So long after bus-off the controller begins to recover by itself; None: only on request."""
        self.controller = CanController(segment.bitrate_bit_s)
        self._segment = segment

    @property
    def error_state(self) -> ErrorState:
        """Error active, error passive or bus-off."""
        return self.controller.state

    def detach(self) -> None:
        """Receive no more and accept no more; what was queued still goes out, as from a controller."""
        self.listener = None
        self.on_sent = None
        segment = self._segment
        if self in segment.ports and segment.handling is not None:
            segment.handled().left(self)
        segment.remove_port(self)

    def go_bus_off(self) -> None:
        """Go bus-off at once: what was queued is discarded, and nothing is sent or received."""
        self._segment.handled().force_off(self)

    def recover(self) -> None:
        """Begin to recover from bus-off, which takes 128 times 11 recessive bits."""
        self._segment.handled().recover(self)

    def unplug(self) -> None:
        """Leave the wire: hear and send nothing, keep the queue; a frame under way is cut off."""
        if self.controller.plugged:
            handling = self._segment.handled()
            self.controller.plugged = False
            handling.pull_off(self)

    def plug(self) -> None:
        """Be on the wire again, from the next frame on."""
        if not self.controller.plugged:
            self.controller.plugged = True
            self._segment.handled().plug(self)

    def set_listen_only(self, listen_only: bool) -> None:
        """Never drive the bus, or do so again; what is queued waits."""
        handling = self._segment.handled()
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
        handling = self._segment.handled()
        self.controller.bitrate_bit_s = bitrate_bit_s
        handling.choose()

    def reopen(self) -> None:
        """The controller is back from bus-off."""
        self.room = TRANSMIT_QUEUE_MAX

    def refusal(self) -> can.CanOperationError:
        """The error of a frame that it does not take."""
        if self.room == 0:
            return can.CanOperationError(f"{self.name}: the controller is bus-off")
        if self.listener is None:
            return can.CanOperationError(f"{self.name}: the port is detached from its segment")
        full = f"{self.name}: transmit queue is full ({TRANSMIT_QUEUE_MAX} frames)"
        return can.CanOperationError(full, errno.ENOBUFS)
