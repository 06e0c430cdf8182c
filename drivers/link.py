"""Frames in and out of a python-can bus, stamped on the bench's clock.

The lean path of a bus (:mod:`drivers.lean_bus`) is used where it is there.
"""

from enum import Enum
from typing import Final, NoReturn

import can

from drivers.errors import BusDown
from drivers.frame_port import CallbackTap, FramePort, FrameTap
from drivers.frame_port import Direction as Direction
from drivers.frame_port import Tap as Tap
from drivers.lean_bus import LeanBus, PortOfLeanBus, WireFrame
from drivers.timebase import NS_PER_S, Clock, Duration, Instant, wall_clock_offset

Received = tuple[int, bytes, Instant]
"""Identifier, data, and the bus's stamp of the frame."""


class StampSource(Enum):
    """What a bus's ``Message.timestamp`` counts from."""

    MONOTONIC = "monotonic"
    """The bench's own axis."""
    WALL_CLOCK = "wall clock"
    """The kernel's or the host's wall clock: mapped to the bench's axis here."""
    RECEIPT = "receipt"
    """Something else, or nothing: the instant of receipt stands in for it."""


_OFFSET_KEPT_NS: Final = NS_PER_S // 10
"""How long a comparison of wall clock and bench clock holds; slewing shifts it by 500 ppm at most."""


_new: Final = tuple.__new__
_WIRE_FRAME: Final = WireFrame
"""``_new(_WIRE_FRAME, values)`` takes a third of the time of ``WireFrame(*values)``."""


class BusLink:
    """The one place through which a master's frames leave and arrive.

    Only data frames with an 11-bit identifier are handed on: CANopen uses no others. Error frames, remote
    frames and extended frames reach the tap and the count ``ignored_frames``.
    """

    def __init__(
        self, bus: can.BusABC, clock: Clock, stamps: StampSource = StampSource.RECEIPT, name: str = ""
    ) -> None:
        self.bus = bus
        self.name = name or str(getattr(bus, "channel_info", "") or type(bus).__name__)
        """How an error names this bus."""
        self.sent_frames = 0
        self.received_frames = 0
        self.ignored_frames = 0
        self.error_frames = 0
        self.last_id = 0
        """Identifier of the frame that was last fetched; ``last_data`` and ``last_at`` are its own too."""
        self.last_data = b""
        self.last_at = Instant(0)
        self._now = clock.now
        self._stamps = stamps
        self._taps: list[FrameTap] = []
        self._offset_ns = Duration(0)
        self._offset_expires_at = Instant(-1)
        self._port: FramePort | None = getattr(bus, "frame_port", None)
        if self._port is None and isinstance(bus, LeanBus):
            self._port = PortOfLeanBus(bus)

    def tap(self, tap: Tap | FrameTap) -> None:
        """Have ``tap`` see every frame from now on."""
        self._taps.append(tap if isinstance(tap, FrameTap) else CallbackTap(tap))

    def recv(self, until: Instant) -> Received | None:
        """The next data frame, or None once ``until`` has come and nothing is waiting.

        Lets time pass. Raises BusDown if the bus is gone.
        """
        return (self.last_id, self.last_data, self.last_at) if self.fetch(until) else None

    def fetch(self, until: Instant) -> bool:
        """As :meth:`recv`, but leaves the frame in ``last_id``, ``last_data`` and ``last_at``; whether one
        came."""
        port = self._port
        return self._fetch_message(until) if port is None else self._fetch_frame(port, until)

    def send(self, can_id: int, data: bytes) -> Instant:
        """Queue a frame; returns the instant just before the bus was given it.

        Raises BusDown if the bus is gone or its transmit queue is full.
        """
        port = self._port
        if port is None:
            return self._send_message(can_id, data)
        at = self._now()
        try:
            port.transmit(_new(_WIRE_FRAME, (can_id, data, False, False, 0)))
        except (can.CanError, OSError) as error:
            self._fail("send on", error)
        self.sent_frames += 1
        for tap in self._taps:
            tap.frame("tx", can_id, data, False, False, at)
        return at

    def _fetch_frame(self, port: FramePort, until: Instant) -> bool:
        while True:
            try:
                item = port.receive(until)
            except (can.CanError, OSError) as error:
                self._fail("receive from", error)
            if item is None:
                return False
            can_id, data, extended, remote, _ = item
            at = port.came_at
            self.received_frames += 1
            for tap in self._taps:
                tap.frame("rx", can_id, data, extended, remote, at)
            if not (extended or remote):
                self.last_id, self.last_data, self.last_at = can_id, data, at
                return True
            self.ignored_frames += 1

    def _send_message(self, can_id: int, data: bytes) -> Instant:
        at = self._now()
        try:
            self.bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=data))
        except (can.CanError, OSError) as error:
            self._fail("send on", error)
        self.sent_frames += 1
        for tap in self._taps:
            tap.frame("tx", can_id, data, False, False, at)
        return at

    def _fetch_message(self, until: Instant) -> bool:
        while True:
            wait_s = max(0, until - self._now()) / NS_PER_S
            try:
                message = self.bus.recv(wait_s)
            except (can.CanError, OSError) as error:
                self._fail("receive from", error)
            if message is None:
                return False
            if message.is_error_frame:
                self.error_frames += 1
                continue
            self.received_frames += 1
            can_id, data = message.arbitration_id, bytes(message.data)
            at = self._stamp(message.timestamp)
            for tap in self._taps:
                tap.frame("rx", can_id, data, message.is_extended_id, message.is_remote_frame, at)
            if not (message.is_extended_id or message.is_remote_frame):
                self.last_id, self.last_data, self.last_at = can_id, data, at
                return True
            self.ignored_frames += 1

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

    def _fail(self, action: str, error: Exception) -> NoReturn:
        raise BusDown(
            f"cannot {action} {self.name}", str(error), "check that the interface is up and the cable is in"
        ) from error
