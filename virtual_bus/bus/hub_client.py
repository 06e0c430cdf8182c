"""A hub's end of the connection to one client: what waits to be sent to it, and whether it takes it."""

import socket
from collections import deque
from itertools import islice
from typing import Final

from servobench.drivers.timebase import NEVER, Instant
from servobench.virtual_bus.bus.hub_protocol import BATCH_FRAMES_MAX, ECHO_HELD_NS, FRAME_BYTES, encode_frame
from servobench.virtual_bus.bus.listener import Listener
from servobench.virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Port
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Event

OUTBOX_MAX: Final = 8_192
"""Frames kept for a client beyond what its socket holds: about a second of a full bus at 1 Mbit/s."""


class Client(Listener):
    """One connection: a socket, and a port once it has said hello."""

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.socket = connection
        self.descriptor = connection.fileno()
        self.number = number
        self.port: Port | None = None
        self.batches = False
        self.wire: WireImage | None = None
        self.outbox: deque[bytes] = deque()
        self.due = NEVER
        """When to send from the outbox; never while the socket is full."""
        self.full = False
        """Its socket takes nothing for now."""
        self.reading = False
        """It has made room in a full socket: it fetches its frames."""
        self.thinned_out = False
        self.watched = 0
        """Events of its socket that the broker waits for."""
        self.parted = False
        self.deaf = False
        """Its end is closed or it was too slow: it gets nothing more, and what it sent is still read."""
        self.hello_deadline: Event | None = None
        self._older: list[bytes] = []
        """Packets that are no frames, from those removed by :meth:`thin_out`."""

    def __str__(self) -> str:
        return f"client {self.number}"

    @property
    def readable(self) -> bool:
        """True if there is room for its packets."""
        return self.port is None or self.port.pending < TRANSMIT_QUEUE_MAX

    def on_frame(self, frame: Frame, now: Instant) -> None:  # noqa: ARG002
        if self.wire is not None:
            self.push(self.wire.packet, now)

    def echo(self, frame: Frame, at: Instant) -> None:
        """A frame of its own ended at ``at``."""
        self.push(encode_frame(frame, at, own=True), Instant(at + ECHO_HELD_NS) if self.batches else at)

    def push(self, packet: bytes, due: Instant) -> None:
        """Send by ``due``; the outbox's bound is the broker's business."""
        if self.deaf:
            return
        self.outbox.append(packet)
        if due < self.due and not self.full:
            self.due = due

    def flush(self) -> None:
        """Send from the outbox what its socket takes."""
        outbox = self.outbox
        if self._older:
            outbox.extendleft(reversed(self._older))
            self._older.clear()
        self.due = NEVER
        was_full, self.full = self.full, False
        try:
            while outbox:
                count = self._next_batch()
                self.socket.send(outbox[0] if count == 1 else b"".join(islice(outbox, count)))
                self.reading |= was_full
                for _ in range(count):
                    outbox.popleft()
        except BlockingIOError:
            self.full = True
        except OSError:
            self.deaf = True
            outbox.clear()

    def thin_out(self) -> None:
        """Keep the newest :data:`OUTBOX_MAX` packets of the outbox, and of the older all but frames."""
        self.thinned_out = True
        outbox = self.outbox
        while len(outbox) > OUTBOX_MAX:
            packet = outbox.popleft()
            if len(packet) != FRAME_BYTES:
                self._older.append(packet)

    def _next_batch(self) -> int:
        """How many records at the head of the outbox go into one packet."""
        if not self.batches:
            return 1
        count = 0
        for packet in islice(self.outbox, BATCH_FRAMES_MAX):
            if len(packet) != FRAME_BYTES:
                break
            count += 1
        return max(count, 1)


class WireImage:
    """The frame that ends now, encoded once for all clients."""

    def __init__(self) -> None:
        self.packet = b""

    def on_frame(self, frame: Frame, at: Instant) -> None:
        """For a monitor of the segment, which it serves before its ports."""
        self.packet = encode_frame(frame, at)
