"""What a real kernel does to a SocketCAN adapter, told in words: its error frames, and what it drops.

A socket may send error frames on a virtual interface, as the driver of an adapter brings them.
"""

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from struct import pack

import can
import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from servobench.drivers.wire.frame_port import ERROR_FLAG, WireFrame
from servobench.drivers.wire.link import BusLink
from servobench.drivers.wire.socketcan import StampedSocketcanBus

CLOCK = MonotonicClock()
PATIENCE_MS = 10_000
FLOOD = 1000
ERRORS = [
    (0x004, bytes([0, 0x08]), "transmit warning"),
    (0x004, bytes([0, 0x20]), "transmit error passive"),
    (0x020, b"", "sends what nobody acknowledges"),
    (0x040, b"", "is bus-off"),
    (0x100, b"", "was restarted after bus-off"),
    (0x004, bytes([0, 0x40]), "error active"),
]
"""Class, data (linux/can/error.h), and a part of what is told."""


class Bench:
    """The bench's end: what was told of the adapter, and from when on all was heard again."""

    def __init__(self, bus: StampedSocketcanBus) -> None:
        self.bus, self.link = bus, BusLink(bus, CLOCK, name="vcan0")
        self.told: list[str] = []
        self.unheard: list[Instant] = []
        self.link.on_trouble = lambda text, _at: self.told.append(text)
        self.link.on_unheard = self.unheard.append

    def heard(self, wanted: int) -> int:
        """How many data frames came, until the one with the identifier ``wanted``."""
        ends, count = CLOCK.now() + PATIENCE_MS * NS_PER_MS, 0
        while CLOCK.now() < ends:
            found = self.link.recv(Instant(CLOCK.now() + NS_PER_MS))
            if found is not None and found[0] == wanted:
                return count
            count += found is not None
        raise AssertionError(f"{wanted:X}h never came")


@pytest.fixture(name="bench")
def bench_end(channel: str) -> Iterator[Bench]:
    with StampedSocketcanBus(channel, receive_own_messages=True) as bus:
        yield Bench(bus)


@pytest.fixture(name="peer")
def peer_bus(channel: str) -> Iterator[can.BusABC]:
    with ExitStack() as stack:
        yield stack.enter_context(can.Bus(interface="socketcan", channel=channel, ignore_config=True))


def test_each_state_of_the_controller_is_told_once(channel: str, bench: Bench, peer: can.BusABC) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as driver:
        driver.bind((channel,))
        for classes, data, _ in ERRORS:
            for _ in range(3):
                driver.send(pack("=IB3x8s", ERROR_FLAG | classes, 8, data))
    peer.send(can.Message(arbitration_id=0x77, is_extended_id=False))
    bench.heard(0x77)
    assert bench.link.error_frames == 3 * len(ERRORS)
    assert len(bench.told) == len(ERRORS)
    for text, (_, _, part) in zip(bench.told, ERRORS, strict=True):
        assert text.startswith("vcan0 ")
        assert part in text


def test_what_the_kernel_dropped_is_counted_and_told_with_the_next_frame(
    bench: Bench, peer: can.BusABC
) -> None:
    """A receive buffer of the least size, and a host that stands still."""
    bench.bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    for number in range(FLOOD):
        bench.bus.frame_port.transmit(WireFrame(0x100 + number % 8))
    fetched = 0
    while bench.link.fetch(CLOCK.now()):
        fetched += 1
    peer.send(can.Message(arbitration_id=0x77, is_extended_id=False))
    bench.heard(0x77)
    assert 0 < fetched < FLOOD
    assert bench.told == [f"vcan0 dropped {FLOOD - fetched} frames: they came faster than they were fetched"]
    assert len(bench.unheard) == 1
