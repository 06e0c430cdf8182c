"""What a hub does: one segment in real time, with a port for each client.

It runs the same segment as a simulation, on a timeline that follows CLOCK_MONOTONIC: an
event due is run as soon as the clock has passed it, and stamps are the computed instants,
so a late wake-up delays a delivery but never bends the bus's own timing.

What goes to a client is sent at the end of each turn, several frames in one packet if it takes batches.

No client can hurt another. Nothing blocks: a client that stops fetching its frames fills
its socket, then a bounded outbox, and is then dropped. One that has not begun to fetch is
still starting, and keeps the newest frames only. One that sends faster than the bus
is no longer read until its transmit queue has room, so that its own ``send`` fails. What a
client had sent before it died still goes out, as from a controller with a full queue.
Connections without a hello are few: a further one takes the place of the oldest.

The broker leaves when no client was there for ``LINGER_NS``, under the same lock under
which it is started.
"""

import gc
import os
import select
import socket
import sys
from collections import deque
from itertools import islice
from typing import Final

from drivers.timebase import NEVER, NS_PER_MS, NS_PER_S, Clock, Instant
from virtual_bus.bus.controller import ErrorState
from virtual_bus.bus.hub_place import HubPlace, try_lock
from virtual_bus.bus.hub_protocol import (
    ACTIONS,
    BATCH_FRAMES_MAX,
    ECHO_HELD_NS,
    FRAME_BYTES,
    PACKET_BYTES_MAX,
    Hello,
    MalformedRecord,
    decode_frame,
    decode_hello,
    decode_request,
    encode_frame,
    encode_refusal,
    encode_status,
    encode_welcome,
)
from virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Listener, Port
from virtual_bus.bus.segment import CanSegment
from virtual_bus.frame import Frame
from virtual_bus.timeline import Event, Timeline

CLIENTS_MAX: Final = 64
"""More than a lab has on one bus; each costs the broker a copy of every frame."""
OUTBOX_MAX: Final = 8_192
"""Frames kept for a client beyond what its socket holds: about a second of a full bus at 1 Mbit/s."""
STARTING_MAX: Final = OUTBOX_MAX // 2
"""Frames kept, beyond its socket's, for a client that has not begun to read; half, so that they are thinned
out once in thousands of frames."""
KNOCKING_MAX: Final = 32
"""Connections that have not said hello: with :data:`CLIENTS_MAX` below the 1024 descriptors of ``select``."""
LINGER_NS: Final = 2 * NS_PER_S
"""Between the end of a run and the next one the bus stays, with its place and its clock."""
_HELLO_PATIENCE_NS: Final = 5 * NS_PER_S
"""A client says who it is at once; a process of a busy machine may be kept waiting for seconds."""
_RETRY_LEAVING_NS: Final = 100 * NS_PER_MS
"""Somebody holds the lock of the place, who is about to join: a moment."""
_WAIT_MAX_NS: Final = 60 * NS_PER_S
"""Of one ``select``; nothing is due, and a longer wait brings nothing."""
_PACKETS_PER_TURN: Final = 64
"""Of one client in a row, so that one that floods does not keep the others from the bus."""


class Client(Listener):
    """One connection: a socket, and a port once it has said hello."""

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.socket = connection
        self.descriptor = connection.fileno()
        self.number = number
        self.port: Port | None = None
        self.batches = False
        self.wire: _Wire | None = None
        self.outbox: deque[bytes] = deque()
        self.due = NEVER
        """When to send from the outbox; never while the socket is full."""
        self.full = False
        """Its socket takes nothing for now."""
        self.reading = False
        """It has made room in a full socket: it fetches its frames."""
        self.thinned_out = False
        self.deaf = False
        """Its end is closed or it was too slow: it gets nothing more, and what it sent is still read."""
        self.hello_deadline: Event | None = None

    def __str__(self) -> str:
        return f"client {self.number}"

    @property
    def readable(self) -> bool:
        """Whether there is room for what it sends."""
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
        """Keep the newest :data:`STARTING_MAX` packets of the outbox, and of the older all but frames."""
        self.thinned_out = True
        older = len(self.outbox) - STARTING_MAX
        packets = enumerate(self.outbox)
        self.outbox = deque(packet for n, packet in packets if n >= older or len(packet) != FRAME_BYTES)

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


class _Wire:
    """The frame that ends now, encoded once for all clients."""

    def __init__(self) -> None:
        self.packet = b""

    def on_frame(self, frame: Frame, at: Instant) -> None:
        """For a monitor of the segment, which it serves before its ports."""
        self.packet = encode_frame(frame, at)


class Broker:
    """Serves one hub until nobody needs it any more."""

    def __init__(
        self, place: HubPlace, listener: socket.socket, alive: int, clock: Clock, bitrate: int
    ) -> None:
        """``alive``: descriptor of the hub's sign of life, which is closed when it leaves."""
        self._place = place
        self._alive = alive
        self._listener = listener
        self._clock = clock
        self._timeline = Timeline()
        self._timeline.run_until(clock.now())
        self._segment = CanSegment(self._timeline, bitrate)
        self._clients: list[Client] = []
        self._accepted = 0
        self._wire = _Wire()
        self._leaving: Event | None = None
        self._done = False
        self.dropped = 0
        """Clients dropped because they did not take their frames or sent what is no frame."""
        self._segment.add_monitor(self._wire.on_frame)

    def run(self) -> None:
        """Serve; returns with the socket gone and the lock free."""
        self._start_leaving()
        while not self._done:
            readable, writable = self._wait()
            self._timeline.run_until(self._clock.now())
            listening = self._listener.fileno() in readable
            clients = self._clients.copy()
            for client in clients:
                if client.descriptor in writable:
                    client.flush()
            self._send_due()
            for client in clients:
                if client.descriptor in readable:
                    self._read(client)
            if listening:
                self._accept()
            self._send_due()
            self._dismiss()

    def _wait(self) -> tuple[list[int], list[int]]:
        """Until the next event or a socket is ready. select's time-out is good to 1 us, epoll's to 1 ms."""
        due = self._timeline.next_at()
        wake_at: int = NEVER if due is None else due
        sources = [self._listener.fileno()]
        full = []
        for client in self._clients:
            wake_at = min(wake_at, client.due)
            if client.readable:
                sources.append(client.descriptor)
            if client.full:
                full.append(client.descriptor)
        wait_ns = max(0, min(wake_at - self._clock.now(), _WAIT_MAX_NS))
        readable, writable, _ = select.select(sources, full, [], wait_ns / NS_PER_S)
        return readable, writable

    def _send_due(self) -> None:
        now = self._timeline.now
        for client in self._clients:
            if client.due <= now:
                client.flush()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it went away again
            return
        connection.setblocking(False)
        knocking = [client for client in self._clients if client.port is None]
        if len(knocking) >= KNOCKING_MAX:
            self._drop(knocking[0], "said no hello")
        self._accepted += 1
        client = Client(connection, self._accepted)
        self._clients.append(client)
        if self._leaving is not None:
            self._leaving.cancel()
            self._leaving = None
        due = Instant(self._timeline.now + _HELLO_PATIENCE_NS)
        client.hello_deadline = self._timeline.call_at(due, lambda _now: self._drop(client, "said no hello"))

    def _read(self, client: Client) -> None:
        """Take what the client sent, as far as its transmit queue and fairness allow."""
        if client not in self._clients:
            return  # parted from since select saw it
        for _ in range(_PACKETS_PER_TURN):
            if not client.readable:
                return
            try:
                packet = client.socket.recv(PACKET_BYTES_MAX)
            except BlockingIOError:
                return
            except ConnectionResetError:
                # Reported once, if it left without reading all; what it sent is still there.
                client.deaf = True
                continue
            # What it sent may be younger than this turn, and must not go out before it was sent.
            self._timeline.run_until(self._clock.now())
            if client not in self._clients:
                return
            if not packet:
                self._part(client)
                return
            try:
                self._take(client, packet)
            except MalformedRecord as error:
                self._drop(client, f"sent a malformed packet: {error}")
                return
            if client not in self._clients:
                return

    def _take(self, client: Client, packet: bytes) -> None:
        if client.port is not None:
            self._serve(client, client.port, packet)
            return
        try:
            hello = decode_hello(packet)
        except MalformedRecord as error:
            self._refuse(client, str(error))
            return
        if sum(other.port is not None for other in self._clients) >= CLIENTS_MAX:
            self._refuse(client, f"hub {self._place.name!r} has {CLIENTS_MAX} clients already; no more fit")
            return
        bitrate = self._segment.bitrate_bit_s
        if hello.bitrate_bit_s not in (0, bitrate):
            self._refuse(
                client,
                f"hub {self._place.name!r} runs at {bitrate} bit/s, and {hello.bitrate_bit_s} bit/s was asked"
                " for; join with the hub's bit rate, or wait until its other clients have left",
            )
            return
        self._welcome(client, hello)

    def _serve(self, client: Client, port: Port, packet: bytes) -> None:
        """A frame to send, which a controller that is bus-off forgets, or a request to the controller."""
        request = decode_request(packet)
        if request is not None:
            ACTIONS[request](port)
            client.push(self._status(port, asked=True), self._timeline.now)
            return
        frame = decode_frame(packet).frame
        if port.error_state is not ErrorState.BUS_OFF:
            port.send(frame)

    def _status(self, port: Port, *, asked: bool) -> bytes:
        segment, now = self._segment, self._timeline.now
        load = segment.load_percent(Instant(now - NS_PER_S), now)
        alone = len(self._clients) == 1
        return encode_status(port, load, segment.frames, asked=asked, alone=alone)

    def _welcome(self, client: Client, hello: Hello) -> None:
        if client.hello_deadline is not None:
            client.hello_deadline.cancel()
        client.batches = hello.batches
        client.wire = self._wire
        client.port = port = self._segment.attach(str(client), client)
        port.on_error_state = lambda _state, at: client.push(self._status(port, asked=False), at)
        if hello.receive_own:
            port.on_sent = client.echo
        client.push(encode_welcome(self._segment.bitrate_bit_s), self._timeline.now)

    def _refuse(self, client: Client, reason: str) -> None:
        client.push(encode_refusal(reason), self._timeline.now)
        client.flush()
        self._part(client)

    def _drop(self, client: Client, why: str) -> None:
        self.dropped += 1
        print(f"{client} {why}; dropped ({self.dropped} so far)", file=sys.stderr, flush=True)
        self._part(client)

    def _dismiss(self) -> None:
        """Part from the clients that let their outbox overflow, but not from those that still start."""
        for client in [client for client in self._clients if len(client.outbox) > OUTBOX_MAX]:
            if client.reading:
                self._drop(client, f"did not take its frames: {OUTBOX_MAX} are waiting")
                continue
            if not client.thinned_out:
                print(
                    f"{client} has not begun to read: older frames are not kept", file=sys.stderr, flush=True
                )
            client.thin_out()

    def _part(self, client: Client) -> None:
        """Close the connection; what is in its transmit queue still goes out."""
        if client not in self._clients:
            return
        self._clients.remove(client)
        if client.hello_deadline is not None:
            client.hello_deadline.cancel()
        client.socket.close()
        if client.port is not None:
            client.port.detach()
            gc.collect()  # some milliseconds, which one that only knocks may not cost
        if not self._clients:
            self._start_leaving()

    def _start_leaving(self) -> None:
        self._leaving = self._timeline.call_at(Instant(self._timeline.now + LINGER_NS), self._leave)

    def _leave(self, now: Instant) -> None:
        """End, unless somebody is just joining: whoever starts a hub holds the lock."""
        lock = try_lock(self._place.lock)
        if lock is None:
            self._leaving = self._timeline.call_at(Instant(now + _RETRY_LEAVING_NS), self._leave)
            return
        try:
            self._leaving = None
            if select.select([self._listener], [], [], 0)[0]:
                self._accept()
            if not self._clients:
                self._done = True
                self._place.clear()
                self._listener.close()
                os.close(self._alive)
        finally:
            os.close(lock)


def listen(place: HubPlace) -> socket.socket:
    """The hub's socket; call it only under the hub's lock, as it removes what a killed broker left."""
    place.socket.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(place.socket))
    listener.listen(CLIENTS_MAX)
    listener.setblocking(False)
    return listener
