"""The stamps of a hub whose process is kept waiting for a core at any place of its turn."""

import socket
from pathlib import Path

import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.virtual_bus.bus.hub_broker import LINGER_NS, Broker, listen
from servobench.virtual_bus.bus.hub_place import HubPlace, try_lock
from servobench.virtual_bus.bus.hub_protocol import (
    FRAME_BYTES,
    PACKET_BYTES_MAX,
    Hello,
    decode_frame,
    encode_frame,
    encode_hello,
)
from servobench.virtual_bus.frame import Frame

BITRATE = 1_000_000
FRAMES = 40
SLOW = Duration(3 * NS_PER_MS)
"""Goes by between two looks at the clock."""


class SendingClock:
    """At every look at it time has passed, and a client of the hub has sent a frame that says when."""

    def __init__(self, place: HubPlace) -> None:
        self.ends: list[tuple[int, int]] = []
        """Of each frame when it was sent, and its end on the bus."""
        self._now = Instant(NS_PER_S)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(str(place.socket))
        self._socket.setblocking(False)
        self._socket.send(encode_hello(Hello(0, receive_own=True, batches=False)))

    def now(self) -> Instant:
        seen = self._now
        self._now = Instant(seen + SLOW)
        if len(self.ends) >= FRAMES:
            self._socket.close()
            self._now = Instant(seen + LINGER_NS)
        else:
            self._receive()
            self._socket.send(encode_frame(Frame(0x080, self._now.to_bytes(8, "little"))))
        return seen

    def sleep_until(self, when: Instant) -> None:
        self._now = when

    def _receive(self) -> None:
        while True:
            try:
                packet = self._socket.recv(PACKET_BYTES_MAX)
            except BlockingIOError:
                return
            if len(packet) == FRAME_BYTES:
                received = decode_frame(packet)
                self.ends.append((int.from_bytes(received.frame.data, "little"), received.at))


def test_no_frame_ends_before_it_was_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    place = HubPlace("late")
    alive = try_lock(place.alive)
    assert alive is not None
    listener = listen(place)
    clock = SendingClock(place)
    Broker(place, listener, alive, clock, BITRATE).run()

    assert len(clock.ends) >= FRAMES
    assert [(sent, end) for sent, end in clock.ends if end <= sent] == []
