"""python-can's SocketCAN bus with a frame port: stamps on the bench's axis, echoes, no message objects."""

import errno
import select
import socket
from contextlib import suppress
from struct import Struct
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus

from servobench.drivers.timebase import NS_PER_S, Clock, Instant, MonotonicClock, wall_between
from servobench.drivers.wire.error_frames import controller_cure, controller_state_text
from servobench.drivers.wire.frame_port import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    REMOTE_FLAG,
    STANDARD_ID_MAX,
    EchoBasis,
    FramePort,
    Trouble,
    WireFrame,
)
from servobench.drivers.wire.socketcan_stamps import (
    ANCILLARY_BYTES,
    HARDWARE_STAMPS,
    SO_RXQ_OVFL,
    SO_TIMESTAMPING,
    AdapterClock,
    Ancillary,
    WallStamps,
    parse_ancillary,
)

RECEIVE_BUFFER_BYTES = 4 << 20
"""Some 5000 frames; the kernel's default holds under 300, and drops the rest."""

_PRIORITY = 6
"""TC_PRIO_INTERACTIVE (linux/pkt_sched.h), the highest without privilege. Linux gives CAN interfaces
pfifo_fast, whose first band has a queue of its own and goes first: who fills the others' leaves it room."""

_FRAME = Struct("=IB3x8s")
"""struct can_frame: identifier with flags, length, data."""
_SO_RCVBUFFORCE = 33
"""asm-generic/socket.h."""
_FIRST_COMPARISONS = 8
"""Comparisons of the clocks before the first frame: one alone is off by half of the processor's delay in
between, seen as 105 us on a busy machine; every frame adds one more."""
_UNPLUGGED = (errno.ENXIO, errno.ENODEV)
_WHY = {
    errno.ENOBUFS: "the transmit queue of the interface is full",
    errno.ENETDOWN: "the interface is down",
    **dict.fromkeys(_UNPLUGGED, "the adapter was unplugged"),
}
"""Meanings of the kernel's errors here."""
_MSG_CONFIRM = 0x800
"""Flag of an own frame that comes back (linux/can.h). MSG_DONTROUTE, which python-can uses to recognise own
frames, is set on every frame of this machine: on a virtual interface on all."""


class SocketcanPort(FramePort):
    """The frames of a SocketCAN socket, with the adapter's stamps if it has some, else the kernel's.

    Hardware stamps were never seen here except made up by tests.
    """

    def __init__(self, opened: socket.socket, clock: Clock, receive_own: bool, channel: str) -> None:
        super().__init__()
        self._channel = channel
        if receive_own:
            self.echoes = EchoBasis.KERNEL
        self.lost_frames = 0
        """Frames that the kernel dropped because the receive buffer was full, as far as is known."""
        self._socket = opened
        self._now = clock.now
        self._wall = WallStamps()
        self._adapter = AdapterClock()
        self._down = False
        """True if the interface was down at the last look."""
        self._down_since = Instant(0)
        """When that was first seen, if so."""
        self._controller = ""
        """Controller state of the last error frame."""
        self._far_off = 0
        for _ in range(_FIRST_COMPARISONS):
            self._compare()

    def receive(self, until: Instant) -> WireFrame | None:
        """Return the next frame, error frames included; None once ``until`` has come.

        An interface that goes down brings none until it is up again. Raises can.CanOperationError if the
        adapter was unplugged.
        """
        while True:
            now = self._now()
            try:
                if not select.select([self._socket], [], [], max(0, until - now) / NS_PER_S)[0]:
                    self._compare()
                    self._wall.emptied(max(now, until))
                    return None
                frame, ancillary, flags, _ = self._socket.recvmsg(_FRAME.size, ANCILLARY_BYTES)
                break
            except OSError as error:
                if error.errno != errno.ENETDOWN:
                    raise self._refusal("receive", error) from error
                self._note_down(True)
        self.came_own = bool(flags & _MSG_CONFIRM)
        self.came_at = self._stamp(ancillary)
        if self._down and self.came_at > self._down_since:  # others had waited in the buffer
            self._note_down(False)
        word, length, data = _FRAME.unpack(frame)
        remote, extended = bool(word & REMOTE_FLAG), bool(word & EXTENDED_FLAG)
        if word & ERROR_FLAG:
            self._note_controller(word & EXTENDED_ID_MAX, data[:length])
            return WireFrame(word & (ERROR_FLAG | EXTENDED_ID_MAX), data[:length])
        can_id = word & (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX)
        payload = b"" if remote else data[:length]
        return WireFrame(can_id, payload, extended, remote, length if remote else 0)

    def transmit(self, frame: WireFrame) -> None:
        """Queue a frame. Raises can.CanOperationError: ENOBUFS if the interface's queue is full, ENETDOWN if
        it is down, another code if the adapter was unplugged."""
        can_id, data, extended = frame.can_id, frame.data, frame.extended
        remote, remote_length = frame.remote, frame.remote_length
        word = can_id | (EXTENDED_FLAG if extended else 0) | (REMOTE_FLAG if remote else 0)
        length = remote_length if remote else len(data)
        try:
            self._socket.send(_FRAME.pack(word, length, data), socket.MSG_DONTWAIT)
        except OSError as error:
            if error.errno == errno.ENETDOWN:
                self._note_down(True)
            raise self._refusal("transmit", error) from error
        self._note_down(False)

    def _refusal(self, action: str, error: OSError) -> can.CanOperationError:
        if error.errno in _UNPLUGGED:
            self.cure = "plug it in again; hil scan tells the name that it has then"
        why = _WHY.get(error.errno or 0, error.strerror)
        return can.CanOperationError(f"cannot {action}: {why}", error.errno)

    def _note_down(self, down: bool) -> None:
        if down != self._down:
            self._down, self._down_since = down, self._now()
            self.cure = f"ip link set {self._channel} up" if down else ""
            if down:
                self._tell("is down: nothing is sent or heard")
            else:
                self._tell("is up again", unheard=True)

    def _note_controller(self, classes: int, data: bytes) -> None:
        text = controller_state_text(classes, data)
        if text and text != self._controller:
            self._controller = text
            self.cure = controller_cure(classes, data, self._channel)
            self._tell(text)

    def _tell(self, text: str, unheard: bool = False) -> None:
        self.troubles.append(Trouble(text, self._now(), unheard))

    def _compare(self) -> Instant:
        before, wall, after = wall_between()
        self._wall.compare(before, wall, after)
        return after

    def _stamp(self, ancillary: Ancillary) -> Instant:
        now = self._compare()
        stamps = parse_ancillary(ancillary)
        if stamps.lost_frames is not None and stamps.lost_frames != self.lost_frames:
            lost = stamps.lost_frames - self.lost_frames
            self.lost_frames = stamps.lost_frames
            self._tell(f"dropped {lost} frames: they came faster than they were fetched", unheard=True)
        if stamps.software_ns is None:
            return now
        at = self._wall.instant(stamps.software_ns, now)
        if self._wall.far_off != self._far_off:
            if not self._far_off:
                self._tell("stamps frames far off its clock: such stamps are not used")
            self._far_off = self._wall.far_off
        if stamps.hardware_ns is None or self._adapter.useless:
            return at
        at = self._adapter.instant(stamps.hardware_ns, at)
        if self._adapter.useless:
            self._tell("has stamps of its own that jump: the kernel's are used instead")
            self.echoes = EchoBasis.KERNEL if self.echoes is EchoBasis.HARDWARE else self.echoes
        elif self.came_own:
            self.echoes = EchoBasis.HARDWARE
        return at


class StampedSocketcanBus(SocketcanBus):
    """A SocketCAN interface with a ``frame_port``."""

    def __init__(self, channel: str, receive_own_messages: bool = False, **options: Any) -> None:
        try:
            super().__init__(channel=channel, receive_own_messages=receive_own_messages, **options)
        except OSError:
            opened = getattr(self, "socket", None)  # python-can leaves it open when it cannot bind it
            if opened is not None:
                opened.close()
            raise
        self._enlarge_buffer()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY)
        with suppress(OSError):  # a kernel without them: the software stamps stay
            self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, HARDWARE_STAMPS)
        self.frame_port = SocketcanPort(self.socket, MonotonicClock(), receive_own_messages, channel)

    def _enlarge_buffer(self) -> None:
        """Enlarge the buffer beyond net.core.rmem_max if permitted, else up to it; losses are counted."""
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        except PermissionError:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
