"""A hub's process: one segment in real time, with a port for each client.

It runs the same segment as a simulation, on a timeline that follows CLOCK_MONOTONIC: an
event due is run as soon as the clock has passed it, and stamps are the computed instants,
so a late wake-up delays a delivery but never bends the bus's own timing.

What goes to a client is sent at the end of each turn, several frames in one packet if it takes batches.

No client can hurt another. Nothing blocks: a client that stops fetching its frames fills
its socket, then a bounded outbox, and is then dropped. One that has not begun to fetch is
still starting, and keeps the newest frames only. One that sends faster than the bus
is no longer read until its transmit queue has room, so that its own ``send`` fails. What a
client had sent before it died still goes out, as from a controller with a full queue.
Connections are taken one at a time, and cost a turn of the others nothing until they have said hello; a
further one takes the place of the oldest that has not.

The broker leaves when no client was there for ``LINGER_NS``, under the same lock under
which it is started.
"""

import errno
import os
import select
import socket
import sys
from typing import Final

from servobench.drivers.timebase import NEVER, NS_PER_MS, NS_PER_S, Clock, Instant
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.hub_client import OUTBOX_MAX, Client, WireImage
from servobench.virtual_bus.bus.hub_place import HubPlace, try_lock
from servobench.virtual_bus.bus.hub_protocol import (
    ACTIONS,
    PACKET_BYTES_MAX,
    Hello,
    MalformedRecord,
    decode_frame,
    decode_hello,
    decode_request,
    encode_refusal,
    encode_status,
    encode_welcome,
)
from servobench.virtual_bus.bus.port import Port
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.timeline import Event, Timeline

CLIENTS_MAX: Final = 64
"""More than a lab has on one bus; each costs the broker a copy of every frame."""
ACCEPT_EVERY_NS: Final = NS_PER_MS
"""To take a connection costs 0.1 ms: a tenth of a processor, whoever connects how often."""
KNOCKING_MAX: Final = 512
"""Connections that have not said hello: in a crowd each has half a second for it. With :data:`CLIENTS_MAX`
below the 1024 files that a process may commonly open."""
LOGGED_MAX: Final = 100
"""Lines of the log: a crowd must not fill a disk, nor wait for one."""
LINGER_NS: Final = 2 * NS_PER_S
"""Between the end of a run and the next one the bus stays, with its place and its clock."""
_HELLO_PATIENCE_NS: Final = 5 * NS_PER_S
"""A client says who it is at once; a process of a busy machine may be kept waiting for seconds."""
_RETRY_LEAVING_NS: Final = 100 * NS_PER_MS
"""Somebody holds the lock of the place, who is about to join: a moment."""
_WAIT_MAX_NS: Final = 60 * NS_PER_S
"""Limit of one wait; nothing is due, and a longer one has no use."""
_PACKETS_PER_TURN: Final = 64
"""Consecutive packets of one client, so that a flood does not keep the others from the bus."""


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
        """Those that have said hello."""
        self._knocking: dict[int, Client] = {}
        """The others by descriptor, the oldest first."""
        self._poll = select.epoll()
        self._poll.register(listener.fileno(), select.EPOLLIN)
        self._accepts = True
        self._accepted = 0
        self._wire = WireImage()
        self._leaving: Event | None = None
        self._done = False
        self._logged = 0
        self.dropped = 0
        """Clients dropped because they did not take their frames or sent what is no frame."""
        self._segment.add_monitor(self._wire.on_frame)

    def run(self) -> None:
        """Serve; returns with the socket gone and the lock free."""
        self._start_leaving()
        while not self._done:
            ready = self._wait()
            self._timeline.run_until(self._clock.now())
            clients = [client for client in self._clients if client.descriptor in ready]
            for client in clients:
                if ready[client.descriptor] & select.EPOLLOUT:
                    client.flush()
            self._send_due()
            for client in clients:
                if ready[client.descriptor] & ~select.EPOLLOUT:
                    self._read(client)
            if len(ready) > len(clients):
                self._look_at_the_door(ready)
            self._send_due()
            self._dismiss()

    def _wait(self) -> dict[int, int]:
        """Events by descriptor, at the next event of the timeline at the latest.

        epoll costs the same for any number of sockets, and waits by the millisecond: it is waited for by
        ``select``, which is good to 1 us.
        """
        due = self._timeline.next_at()
        wake_at: int = NEVER if due is None else due
        for client in self._clients:
            wake_at = min(wake_at, client.due)
            self._watch(client)
        wait_ns = max(0, min(wake_at - self._clock.now(), _WAIT_MAX_NS))
        if not wait_ns or select.select([self._poll], [], [], wait_ns / NS_PER_S)[0]:
            return dict(self._poll.poll(0))
        return {}

    def _watch(self, client: Client) -> None:
        """Wait for what its socket is good for now: one that nothing is wanted of may have been closed, which
        epoll would tell again and again."""
        wanted = (select.EPOLLIN if client.readable else 0) | (select.EPOLLOUT if client.full else 0)
        if wanted == client.watched:
            return
        if not wanted:
            self._poll.unregister(client.descriptor)
        elif not client.watched:
            self._poll.register(client.descriptor, wanted)
        else:
            self._poll.modify(client.descriptor, wanted)
        client.watched = wanted

    def _send_due(self) -> None:
        now = self._timeline.now
        for client in self._clients:
            if client.due <= now:
                client.flush()

    def _look_at_the_door(self, ready: dict[int, int]) -> None:
        for descriptor in ready:
            if (knocking := self._knocking.get(descriptor)) is not None:
                self._read(knocking)
        if self._listener.fileno() in ready:
            self._accept()

    def _accept(self) -> None:
        """One connection, and no further one for a moment."""
        if self._accepts:
            self._accepts = False
            self._poll.unregister(self._listener.fileno())
            self._timeline.post(Instant(self._timeline.now + ACCEPT_EVERY_NS), self._accept_again)
        try:
            connection, _ = self._listener.accept()
        except OSError as error:  # it went away again, or there is no room for it
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._drop_oldest()
            return
        connection.setblocking(False)
        if len(self._knocking) >= KNOCKING_MAX:
            self._drop_oldest()
        self._accepted += 1
        client = Client(connection, self._accepted)
        self._knocking[client.descriptor] = client
        self._watch(client)
        if self._leaving is not None:
            self._leaving.cancel()
            self._leaving = None
        due = Instant(self._timeline.now + _HELLO_PATIENCE_NS)
        client.hello_deadline = self._timeline.call_at(due, lambda _now: self._drop(client, "said no hello"))
        self._read(client)  # its hello has mostly come with it

    def _accept_again(self, now: Instant) -> None:  # noqa: ARG002
        self._accepts = True
        self._poll.register(self._listener.fileno(), select.EPOLLIN)

    def _drop_oldest(self) -> None:
        for client in self._knocking.values():
            self._drop(client, "said no hello")
            return

    def _read(self, client: Client) -> None:
        """Take what the client sent, as far as its transmit queue and fairness allow."""
        for _ in range(_PACKETS_PER_TURN):
            if client.parted or not client.readable:
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
            if client.parted:
                return
            if not packet:
                self._part(client)
                return
            try:
                self._take(client, packet)
            except MalformedRecord as error:
                self._drop(client, f"sent a malformed packet: {error}")

    def _take(self, client: Client, packet: bytes) -> None:
        if client.port is not None:
            self._serve(client, client.port, packet)
            return
        try:
            hello = decode_hello(packet)
        except MalformedRecord as error:
            self._refuse(client, str(error))
            return
        if len(self._clients) >= CLIENTS_MAX:
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
        del self._knocking[client.descriptor]
        self._clients.append(client)
        client.batches = hello.batches
        client.wire = self._wire
        client.port = port = self._segment.attach(str(client), client)
        port.on_error_state = lambda _state, at: client.push(self._status(port, asked=False), at)
        if hello.receive_own:
            port.on_sent = client.echo
        client.push(encode_welcome(self._segment.bitrate_bit_s, self._timeline.now), self._timeline.now)

    def _refuse(self, client: Client, reason: str) -> None:
        client.push(encode_refusal(reason), self._timeline.now)
        client.flush()
        self._part(client)

    def _drop(self, client: Client, why: str) -> None:
        self.dropped += 1
        self._log(f"{client} {why}; dropped ({self.dropped} so far)")
        self._part(client)

    def _log(self, text: str) -> None:
        if self._logged < LOGGED_MAX:
            self._logged += 1
            print(text, file=sys.stderr, flush=True)

    def _dismiss(self) -> None:
        """Part from the clients that let their outbox overflow, but not from those that still start."""
        for client in [client for client in self._clients if len(client.outbox) > OUTBOX_MAX]:
            if client.reading:
                self._drop(client, f"did not take its frames: {OUTBOX_MAX} are waiting")
                continue
            if not client.thinned_out:
                self._log(f"{client} has not begun to read: older frames are not kept")
            client.thin_out()

    def _part(self, client: Client) -> None:
        """Close the connection; what is in its transmit queue still goes out."""
        if client.parted:
            return
        client.parted = True
        if client.port is None:
            del self._knocking[client.descriptor]
        else:
            self._clients.remove(client)
        if client.hello_deadline is not None:
            client.hello_deadline.cancel()
        if client.watched:
            self._poll.unregister(client.descriptor)
        client.socket.close()
        port, client.port = client.port, None
        if port is not None:
            port.on_error_state = None  # it leads back to the port: nothing collects garbage here
            port.detach()
        if not self._clients and not self._knocking:
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
            if not self._clients and not self._knocking:
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
