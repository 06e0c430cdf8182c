"""Frames in and out of a python-can bus, stamped on the bench's clock.

The lean path of a bus (:mod:`drivers.lean_bus`) is used where it is there.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final, Literal, NoReturn

import can

from drivers.errors import BusDown
from drivers.lean_bus import LeanBus, WireFrame
from drivers.timebase import NS_PER_S, Clock, Duration, Instant, wall_clock_offset

Direction = Literal["tx", "rx"]
Tap = Callable[[Direction, int, bytes, bool, bool, Instant], None]
"""Sees every frame: direction, identifier, data, extended, remote, instant."""

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
        self._clock = clock
        self._stamps = stamps
        self._taps: tuple[Tap, ...] = ()
        self._offset_ns = Duration(0)
        self._offset_expires_at = Instant(-1)
        self._lean = isinstance(bus, LeanBus)
        if isinstance(bus, LeanBus):
            self._recv_frame, self._send_frame = bus.recv_frame, bus.send_frame

    def tap(self, callback: Tap) -> None:
        """Have ``callback`` see every frame from now on."""
        self._taps = (*self._taps, callback)

    def recv(self, until: Instant) -> Received | None:
        """The next data frame, or None once ``until`` has come and nothing is waiting.

        Lets time pass. Raises BusDown if the bus is gone.
        """
        return self._recv_lean(until) if self._lean else self._recv_message(until)

    def send(self, can_id: int, data: bytes) -> Instant:
        """Queue a frame; returns the instant just before the bus was given it.

        Raises BusDown if the bus is gone or its transmit queue is full.
        """
        return self._send_lean(can_id, data) if self._lean else self._send_message(can_id, data)

    def _send_lean(self, can_id: int, data: bytes) -> Instant:
        at = self._clock.now()
        try:
            self._send_frame(_new(_WIRE_FRAME, (can_id, data, False, False, 0)))
        except (can.CanError, OSError) as error:
            self._fail("send on", error)
        self.sent_frames += 1
        for tap in self._taps:
            tap("tx", can_id, data, False, False, at)
        return at

    def _recv_lean(self, until: Instant) -> Received | None:
        while True:
            try:
                item = self._recv_frame(until)
            except (can.CanError, OSError) as error:
                self._fail("receive from", error)
            if item is None:
                return None
            (can_id, data, extended, remote, _), at = item
            self.received_frames += 1
            for tap in self._taps:
                tap("rx", can_id, data, extended, remote, at)
            if not (extended or remote):
                return can_id, data, at
            self.ignored_frames += 1

    def _send_message(self, can_id: int, data: bytes) -> Instant:
        at = self._clock.now()
        try:
            self.bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=data))
        except (can.CanError, OSError) as error:
            self._fail("send on", error)
        self.sent_frames += 1
        for tap in self._taps:
            tap("tx", can_id, data, False, False, at)
        return at

    def _recv_message(self, until: Instant) -> Received | None:
        while True:
            wait_s = max(0, until - self._clock.now()) / NS_PER_S
            try:
                message = self.bus.recv(wait_s)
            except (can.CanError, OSError) as error:
                self._fail("receive from", error)
            if message is None:
                return None
            if message.is_error_frame:
                self.error_frames += 1
                continue
            self.received_frames += 1
            can_id, data = message.arbitration_id, bytes(message.data)
            at = self._stamp(message.timestamp)
            for tap in self._taps:
                tap("rx", can_id, data, message.is_extended_id, message.is_remote_frame, at)
            if not (message.is_extended_id or message.is_remote_frame):
                return can_id, data, at
            self.ignored_frames += 1

    def _stamp(self, timestamp_s: float) -> Instant:
        """A message's stamp on the bench's axis; never later than now, even if the wall clock was stepped."""
        now = self._clock.now()
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
