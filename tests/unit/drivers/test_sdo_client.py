"""The SDO client beside canopen's streams, on servers that lose, mangle and refuse: equal frames and ends."""

import random
from typing import Any

import pytest
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoError

from servobench.drivers.canopen.sdo import PumpedSdoClient
from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.write_lists import RIG
from tests.draws import few_of
from tests.unit.drivers.fake_bus import FakeBus, make_network

REQUEST, ANSWER = 0x601, 0x581
SEEDS = 400
UPLOAD, DOWNLOAD, UPLOAD_SEGMENT, DOWNLOAD_SEGMENT, ABORT = 2, 1, 3, 0, 4
"""Client command specifiers (CiA 301 7.2.4.3)."""
INDEX, SUB = next((each.indices.start, each.subs[0]) for each in RIG if each.product is None)


class Server:
    """Holds one object, and answers as its numbers are drawn."""

    def __init__(self, bus: FakeBus, draw: random.Random) -> None:
        self._bus, self._draw = bus, draw
        self._held = draw.randbytes(draw.choice([1, 2, 3, 4, 4, draw.randrange(40)]))
        self._left, self._toggle = b"", 0
        bus.listeners.append(lambda frame: self._serve(frame.data) if frame.can_id == REQUEST else None)

    def _serve(self, request: bytes) -> None:
        luck = self._draw.random()
        if luck < 0.05 or request[0] >> 5 == ABORT:
            return
        answer = bytearray(self._answer(request))
        if luck < 0.1:
            answer = bytearray([0x80, *request[1:4], *self._draw.choice([b"\0\0\2\6", b"\x11\0\4\6"])])
        elif luck < 0.2:
            answer[0] ^= 1 << self._draw.randrange(8)
        elif luck < 0.22:
            answer = answer[:7]
        self._bus.deliver(ANSWER, bytes(answer), NS_PER_MS)

    def _answer(self, request: bytes) -> bytes:
        specifier, named = request[0] >> 5, request[1:4]
        if specifier == UPLOAD:
            self._left, self._toggle = self._held, 0
            if 1 <= len(self._held) <= 4:
                sized = self._draw.random() < 0.9
                head = 0x43 | (4 - len(self._held)) << 2 if sized else 0x42
                return bytes([head]) + named + self._held.ljust(4, b"\xee")
            return b"\x41" + named + len(self._held).to_bytes(4, "little")
        if specifier == UPLOAD_SEGMENT:
            piece, self._left = self._left[:7], self._left[7:]
            head = request[0] & 0x10 | (7 - len(piece)) << 1 | (not self._left)
            return bytes([head]) + piece.ljust(7, b"\xee")
        if specifier == DOWNLOAD:
            return b"\x60" + named + bytes(4)
        assert specifier == DOWNLOAD_SEGMENT
        return bytes([0x20 | request[0] & 0x10]) + bytes(7)


def transferred(seed: int, way: type[SdoClient]) -> tuple[Any, list[Any], int]:
    """What two transfers came to, every frame of the client, and when the last of them was over."""
    bus, network = make_network()
    draw = random.Random(seed)
    Server(bus, draw)
    client: Any = PumpedSdoClient(network, 1)
    client.RESPONSE_TIMEOUT, client.MAX_RETRIES = 0.01, 3
    network.listen(ANSWER, lambda data, _at: client.on_answer(data))
    data = draw.randbytes(draw.choice([0, 1, 2, 3, 4, 5, 7, 8, 14, draw.randrange(40)]))
    ends: list[object] = []
    for transfer in (
        lambda: way.upload(client, INDEX, SUB),
        lambda: way.download(client, INDEX, SUB, data, draw.random() < 0.1),
    ):
        try:
            ends.append(transfer())
        except SdoError as error:
            ends.append((type(error), str(error)))
    sent, over_at = list(bus.sent), bus.now()
    bus.shutdown()
    return ends, [(at, frame.can_id, frame.data) for at, frame in sent], over_at


@pytest.mark.parametrize("first", few_of(range(0, SEEDS, 100), 1))
def test_it_sends_and_returns_what_canopens_client_does(first: int) -> None:
    for seed in range(first, first + 100):
        assert transferred(seed, PumpedSdoClient) == transferred(seed, SdoClient), seed
