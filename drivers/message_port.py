"""The frame port of a python-can bus that has none of its own: messages in, stamps mapped, messages out."""

from typing import Final

import can

from drivers.frame_port import FramePort, WireFrame
from drivers.link import StampSource as StampSource
from drivers.timebase import NS_PER_S, Clock, Duration, Instant, wall_clock_offset

ERROR_FLAG: Final = 0x2000_0000
_OFFSET_KEPT_NS: Final = NS_PER_S // 10
"""How long a comparison of wall clock and bench clock holds."""


class MessagePort(FramePort):
    """``bus`` by its ``recv`` and ``send``.

    Own frames that it may bring are not told from others: ``Message.is_rx`` is not reliable (python-can's
    SocketCAN bus says False of every frame on a virtual interface), so no echo is claimed. CAN FD messages
    are dropped.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, stamps: StampSource) -> None:
        super().__init__()
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
            can_id = message.arbitration_id
            if message.is_error_frame:
                return WireFrame(ERROR_FLAG | can_id, bytes(message.data))
            if message.is_remote_frame:
                return WireFrame(can_id, b"", message.is_extended_id, True, message.dlc)
            return WireFrame(can_id, bytes(message.data), message.is_extended_id)

    def transmit(self, frame: WireFrame) -> None:
        can_id, data, extended, remote, remote_length = frame
        self._bus.send(
            can.Message(
                arbitration_id=can_id,
                is_extended_id=extended,
                is_remote_frame=remote,
                dlc=remote_length if remote else len(data),
                data=None if remote else data,
            )
        )

    def _stamp(self, timestamp_s: float) -> Instant:
        """A message's stamp on the bench's axis; never later than now, even if the wall clock was stepped."""
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
