"""The frame port of a python-can bus that lacks one: messages in, stamps mapped, messages out."""

from enum import Enum
from typing import Final

import can

from servobench.drivers.timebase import NS_PER_S, Clock, Duration, Instant, wall_clock_offset
from servobench.drivers.wire.frame_port import ERROR_FLAG, FramePort, WireFrame
from servobench.drivers.wire.message import frame_of, message_of


class StampSource(Enum):
    """Origin of a bus's ``Message.timestamp``."""

    MONOTONIC = "monotonic"
    """The bench's own axis."""
    WALL_CLOCK = "wall clock"
    """The host's wall clock: converted to the bench's axis here."""
    RECEIPT = "receipt"
    """Another origin, or none: the instant of receipt is used."""


_OFFSET_KEPT_NS: Final = NS_PER_S // 10
"""Validity of a comparison of wall clock and bench clock."""


class MessagePort(FramePort):
    """Wraps ``bus`` by its ``recv`` and ``send``.

    Own frames are not distinguished from others: ``Message.is_rx`` is not reliable (python-can's SocketCAN
    bus says False of every frame on a virtual interface), so no echo is claimed. CAN FD messages are dropped.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, stamps: StampSource) -> None:
        super().__init__()
        self.needs_watching = stamps is StampSource.RECEIPT
        self._bus = bus
        self._now = clock.now
        self._stamps = stamps
        self._offset_ns = Duration(0)
        self._offset_expires_at = Instant(-1)

    def receive(self, until: Instant) -> WireFrame | None:
        while True:
            message = self._bus.recv(max(0, until - self._now()) / NS_PER_S)
            if message is None:
                return None
            if message.is_fd:
                continue
            self.came_at = self._stamp(message.timestamp)
            if message.is_error_frame:
                return WireFrame(ERROR_FLAG | message.arbitration_id, bytes(message.data))
            return frame_of(message)

    def transmit(self, frame: WireFrame) -> None:
        self._bus.send(message_of(frame, Instant(0)))

    def _stamp(self, timestamp_s: float) -> Instant:
        """Convert a message's stamp to the bench's axis; never later than now, even if the wall clock was
        stepped."""
        now = self._now()
        if self._stamps is StampSource.RECEIPT:
            return now
        stamp_ns = round(timestamp_s * NS_PER_S)
        if self._stamps is StampSource.WALL_CLOCK:
            if now >= self._offset_expires_at:
                self._offset_ns = wall_clock_offset()
                self._offset_expires_at = Instant(now + _OFFSET_KEPT_NS)
            stamp_ns -= self._offset_ns
        return Instant(min(stamp_ns, now))
