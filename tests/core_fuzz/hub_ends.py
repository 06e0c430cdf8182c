"""A client's end of a hub: packets of any octets, filters and owners that raise, and closed sockets."""

import random
import socket
from typing import NoReturn

from servobench.drivers.timebase import Instant, MonotonicClock
from servobench.virtual_bus.bus.hub_protocol import BATCH_FRAMES_MAX, FRAME_BYTES, PACKET_BYTES_MAX
from servobench.virtual_bus.core.native import HubEnd, pack_frame, unpack_frame
from servobench.virtual_bus.frame import Frame
from tests.core_fuzz.fates import Refused
from tests.core_fuzz.links import drawn_frame


class _Owner:
    """Refuses now and then, or closes the end that calls it."""

    def __init__(self, draw: random.Random, client: socket.socket) -> None:
        self._draw = draw
        self.end = HubEnd(client.fileno(), self)

    def note(self, packet: bytes) -> None:
        assert 0 < len(packet) <= PACKET_BYTES_MAX
        self._perhaps_refuse()

    def failed(self, error: int) -> NoReturn:
        raise Refused(error)

    def check_state(self) -> None:
        self._perhaps_refuse()

    def _perhaps_refuse(self) -> None:
        chance = self._draw.random()
        if chance < 0.02:
            self.end.close()
        if chance < 0.1:
            raise Refused(chance)


def _drawn_packet(draw: random.Random) -> bytes:
    if draw.random() < 0.2:
        return draw.randbytes(draw.randrange(1, PACKET_BYTES_MAX + 20))
    packets = [
        pack_frame(
            Frame(draw.getrandbits(11), draw.randbytes(draw.randrange(9))),
            Instant(draw.getrandbits(62)),
            True,
        )
        for _ in range(draw.randrange(1, BATCH_FRAMES_MAX + 1))
    ]
    return b"".join(packets)


def hub_ends(draw: random.Random) -> None:
    """One end, until it is closed or enough was done with it."""
    broker, client = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    broker.setblocking(False)
    owner, clock = _Owner(draw, client), MonotonicClock()

    def accepts(frame: Frame) -> bool:
        if draw.random() < 0.05:
            owner.end.accepts = None
            raise Refused(frame)
        return frame.can_id % 3 > 0

    for _ in range(200):
        act = draw.randrange(8)
        try:
            if act < 2:
                broker.send(_drawn_packet(draw))
            elif act < 4:
                owner.end.receive(clock.now())
            elif act == 4:
                owner.end.take_in(Instant(clock.now() + draw.randrange(1000)))
            elif act == 5:
                owner.end.bus_off = draw.random() < 0.5
                owner.end.transmit(drawn_frame(draw))
            elif act == 6:
                owner.end.accepts = draw.choice([None, accepts])
            else:
                unpack_frame(draw.randbytes(draw.choice([FRAME_BYTES, draw.randrange(60)])))
        except (Refused, ValueError, BlockingIOError):
            continue
    broker.close()
    client.close()
