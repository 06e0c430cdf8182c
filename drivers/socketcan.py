"""python-can's SocketCAN bus with the lean path: kernel stamps on the bench's axis, no message objects."""

import select
import socket
from struct import Struct
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus

from drivers.lean_bus import WireFrame
from drivers.timebase import NS_PER_S, Clock, Duration, Instant, MonotonicClock, wall_clock_offset

RECEIVE_BUFFER_BYTES = 4 << 20
"""Some 5000 frames; the kernel's default holds under 300, and drops what does not fit."""

_FRAME = Struct("=IB3x8s")
"""struct can_frame: identifier with flags, length, data."""
_TIMESPEC = Struct("@ll")
_OVERFLOW = Struct("=I")
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_OVERFLOW.size)
_SO_TIMESTAMPNS, _SO_RXQ_OVFL, _SO_RCVBUFFORCE = 35, 40, 33
_OFFSET_KEPT_NS = NS_PER_S // 10


class StampedSocketcanBus(SocketcanBus):
    """A SocketCAN interface whose lean path maps the kernel's wall-clock stamps to the monotonic clock."""

    def __init__(self, channel: str, clock: Clock | None = None, **options: Any) -> None:
        try:
            super().__init__(channel=channel, **options)
        except OSError:
            opened = getattr(self, "socket", None)  # python-can leaves it open when it cannot bind it
            if opened is not None:
                opened.close()
            raise
        self.lost_frames = 0
        """Frames that the kernel dropped because the receive buffer was full, as far as is known."""
        self.error_frames = 0
        self._clock = clock or MonotonicClock()
        self._offset_ns = Duration(0)
        self._offset_expires_at = Instant(-1)
        self._enlarge_buffer()

    def recv_frame(self, until: Instant) -> tuple[WireFrame, Instant] | None:
        """The next frame and its stamp; None once ``until`` has come. Error frames are only counted."""
        while True:
            wait_s = max(0, until - self._clock.now()) / NS_PER_S
            try:
                if not select.select([self.socket], [], [], wait_s)[0]:
                    return None
                frame, ancillary, _, _ = self.socket.recvmsg(_FRAME.size, _ANCILLARY_BYTES)
            except OSError as error:
                raise can.CanOperationError(f"cannot receive: {error.strerror}", error.errno) from error
            word, length, data = _FRAME.unpack(frame)
            if not word & _ERROR:
                break
            self.error_frames += 1
        remote, extended = bool(word & _REMOTE), bool(word & _EXTENDED)
        can_id = word & (0x1FFFFFFF if extended else 0x7FF)
        payload = b"" if remote else data[:length]
        return WireFrame(can_id, payload, extended, remote, length if remote else 0), self._stamp(ancillary)

    def send_frame(self, frame: WireFrame) -> None:
        """Queue a frame; raises can.CanOperationError if the interface is down or its queue is full."""
        can_id, data, extended, remote, remote_length = frame
        word = can_id | (_EXTENDED if extended else 0) | (_REMOTE if remote else 0)
        length = remote_length if remote else len(data)
        try:
            self.socket.send(_FRAME.pack(word, length, data), socket.MSG_DONTWAIT)
        except OSError as error:
            raise can.CanOperationError(f"cannot transmit: {error.strerror}", error.errno) from error

    def _stamp(self, ancillary: list[tuple[int, int, bytes]]) -> Instant:
        now = self._clock.now()
        at = int(now)
        for _, kind, value in ancillary:
            if kind == _SO_TIMESTAMPNS:
                if now >= self._offset_expires_at:
                    self._offset_ns = wall_clock_offset()
                    self._offset_expires_at = Instant(now + _OFFSET_KEPT_NS)
                seconds, nanoseconds = _TIMESPEC.unpack(value[: _TIMESPEC.size])
                at = seconds * NS_PER_S + nanoseconds - self._offset_ns
            elif kind == _SO_RXQ_OVFL:
                (self.lost_frames,) = _OVERFLOW.unpack(value[: _OVERFLOW.size])
        # A wall clock that was stepped since the last comparison must not put a frame into the future.
        return Instant(min(at, now))

    def _enlarge_buffer(self) -> None:
        """Beyond net.core.rmem_max where the process may, up to it where not; losses are counted."""
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        except PermissionError:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
