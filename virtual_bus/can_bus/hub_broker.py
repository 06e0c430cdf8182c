"""The process behind ``hub:NAME``: one segment in real time, with a port for each client.

It runs the same segment as a simulation, on a timeline that follows CLOCK_MONOTONIC: an
event due is run as soon as the clock has passed it, and stamps are the computed instants,
so a late wake-up delays a delivery but never bends the bus's own timing.

No client can hurt another. Nothing blocks: a client that does not fetch its frames fills
its socket, then a bounded outbox, and is then dropped; one that sends faster than the bus
is no longer read until its transmit queue has room, so that its own ``send`` fails. What a
client had sent before it died still goes out, as from a controller with a full queue.

The broker leaves when no client was there for ``LINGER_NS``, under the same lock under
which it is started.
"""

import gc
import os
import select
import socket
import sys
from collections import deque

from drivers.timebase import NS_PER_MS, NS_PER_S, Clock, Instant, MonotonicClock
from virtual_bus.can_bus.error_state import ErrorState
from virtual_bus.can_bus.hub_control import decode_request, encode_status, obey
from virtual_bus.can_bus.hub_place import HubPlace, try_lock
from virtual_bus.can_bus.hub_protocol import (
    PACKET_BYTES_MAX,
    Hello,
    MalformedRecord,
    decode_frame,
    decode_hello,
    encode_frame,
    encode_refusal,
    encode_welcome,
)
from virtual_bus.can_bus.punctuality import ask_for_punctuality
from virtual_bus.frame import Frame
from virtual_bus.segment import TRANSMIT_QUEUE_MAX, Port, Segment
from virtual_bus.timeline import Event, Timeline

CLIENTS_MAX = 64
OUTBOX_MAX = 8_192
"""Frames kept for a client beyond what its socket holds: about a second of a full bus at 1 Mbit/s."""
LINGER_NS = 2 * NS_PER_S
_HELLO_PATIENCE_NS = 5 * NS_PER_S
_RETRY_LEAVING_NS = 100 * NS_PER_MS
_WAIT_MAX_NS = 60 * NS_PER_S
_PACKETS_PER_TURN = 64


class _Client:
    """One connection: a socket, and a port once it has said hello."""

    __slots__ = ("deaf", "hello_deadline", "number", "outbox", "port", "socket")

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.socket = connection
        self.number = number
        self.port: Port | None = None
        self.outbox: deque[bytes] = deque()
        self.deaf = False
        """Its end is closed or it was too slow: it gets nothing more, and what it sent is still read."""
        self.hello_deadline: Event | None = None

    def __str__(self) -> str:
        return f"client {self.number}"

    def fileno(self) -> int:
        """For select."""
        return self.socket.fileno()

    @property
    def readable(self) -> bool:
        """Whether there is room for what it sends."""
        return self.port is None or self.port.pending < TRANSMIT_QUEUE_MAX

    def push(self, packet: bytes) -> None:
        """Send, or keep for later; the outbox's bound is the broker's business."""
        if self.deaf:
            return
        if self.outbox:
            self.outbox.append(packet)
            return
        try:
            self.socket.send(packet)
        except BlockingIOError:
            self.outbox.append(packet)
        except OSError:
            self.deaf = True

    def flush(self) -> None:
        """Send from the outbox what its socket takes."""
        try:
            while self.outbox:
                self.socket.send(self.outbox[0])
                self.outbox.popleft()
        except BlockingIOError:
            pass
        except OSError:
            self.deaf = True
            self.outbox.clear()


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
        self._segment = Segment(self._timeline, bitrate)
        self._clients: list[_Client] = []
        self._accepted = 0
        self._packet = b""
        self._leaving: Event | None = None
        self._done = False
        self.dropped = 0
        """Clients dropped because they did not take their frames or sent what is no frame."""
        self._segment.add_monitor(self._encode)

    def run(self) -> None:
        """Serve; returns with the socket gone and the lock free."""
        self._start_leaving()
        while not self._done:
            readable, writable = self._wait()
            self._timeline.run_until(self._clock.now())
            for client in writable:
                client.flush()
            for source in readable:
                if isinstance(source, _Client):
                    self._read(source)
                else:
                    self._accept()
            self._dismiss()

    def _wait(self) -> tuple[list["_Client | socket.socket"], list[_Client]]:
        """Until the next event or a socket is ready. select's time-out is good to 1 us, epoll's to 1 ms."""
        due = self._timeline.next_at()
        wait_ns = _WAIT_MAX_NS if due is None else max(0, min(due - self._clock.now(), _WAIT_MAX_NS))
        sources: list[_Client | socket.socket] = [client for client in self._clients if client.readable]
        sources.append(self._listener)
        readable, writable, _ = select.select(
            sources, [client for client in self._clients if client.outbox], [], wait_ns / NS_PER_S
        )
        return readable, writable

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it went away again
            return
        connection.setblocking(False)
        self._accepted += 1
        client = _Client(connection, self._accepted)
        self._clients.append(client)
        if self._leaving is not None:
            self._leaving.cancel()
            self._leaving = None
        due = Instant(self._timeline.now + _HELLO_PATIENCE_NS)
        client.hello_deadline = self._timeline.call_at(due, lambda _now: self._drop(client, "said no hello"))

    def _read(self, client: _Client) -> None:
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
            except (
                ConnectionResetError
            ):  # reported once if it left without reading all; what it sent is still there
                client.deaf = True
                continue
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

    def _take(self, client: _Client, packet: bytes) -> None:
        if client.port is not None:
            self._serve(client, client.port, packet)
            return
        try:
            hello = decode_hello(packet)
        except MalformedRecord as error:
            self._refuse(client, str(error))
            return
        if len(self._clients) > CLIENTS_MAX:
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

    def _serve(self, client: _Client, port: Port, packet: bytes) -> None:
        """A frame to send, which a controller that is bus-off forgets, or a request to the controller."""
        request = decode_request(packet)
        if request is not None:
            obey(port, request)
            client.push(self._status(port, asked=True))
            return
        frame = decode_frame(packet).frame
        if port.error_state is not ErrorState.BUS_OFF:
            port.send(frame)

    def _status(self, port: Port, *, asked: bool) -> bytes:
        segment, now = self._segment, self._timeline.now
        load = segment.load_percent(Instant(now - NS_PER_S), now)
        return encode_status(port, load, segment.frames, asked=asked)

    def _welcome(self, client: _Client, hello: Hello) -> None:
        if client.hello_deadline is not None:
            client.hello_deadline.cancel()
        client.port = port = self._segment.attach(str(client), lambda _frame, _at: self._deliver(client))
        port.on_error_state = lambda _state, _at: client.push(self._status(port, asked=False))
        if hello.receive_own:
            port.on_sent = lambda frame, at: client.push(encode_frame(frame, at, own=True))
        client.push(encode_welcome(self._segment.bitrate_bit_s))

    def _encode(self, frame: Frame, at: Instant) -> None:
        self._packet = encode_frame(
            frame, at
        )  # once for all ports, which the segment serves after its monitors

    def _deliver(self, client: _Client) -> None:
        client.push(self._packet)

    def _refuse(self, client: _Client, reason: str) -> None:
        client.push(encode_refusal(reason))
        self._part(client)

    def _drop(self, client: _Client, why: str) -> None:
        self.dropped += 1
        print(f"{client} {why}; dropped ({self.dropped} so far)", file=sys.stderr, flush=True)
        self._part(client)

    def _dismiss(self) -> None:
        """Part from the clients that let their outbox overflow."""
        for client in [client for client in self._clients if len(client.outbox) > OUTBOX_MAX]:
            self._drop(client, f"did not take its frames: {OUTBOX_MAX} are waiting")

    def _part(self, client: _Client) -> None:
        """Close the connection; what is in its transmit queue still goes out."""
        if client not in self._clients:
            return
        self._clients.remove(client)
        if client.port is not None:
            client.port.detach()
        if client.hello_deadline is not None:
            client.hello_deadline.cancel()
        client.socket.close()
        gc.collect()
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


def main() -> None:
    """``python -m virtual_bus.can_bus.hub_broker NAME BITRATE``: returns once the hub can be joined."""
    name, bitrate = sys.argv[1:]
    place = HubPlace(name)
    alive = try_lock(place.alive)
    if alive is None:
        return  # there is one already: its caller was only too slow to be welcomed
    listener = listen(place)
    if os.fork():
        os._exit(0)  # the caller waits for this process: the hub is up, and is nobody's child
    os.setsid()
    os.chdir("/")
    os.ftruncate(alive, 0)
    os.write(alive, f"{os.getpid()}\n".encode())
    ask_for_punctuality()
    Broker(place, listener, alive, MonotonicClock(), int(bitrate)).run()


if __name__ == "__main__":
    main()
