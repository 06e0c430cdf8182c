"""Faults in front of a bus that has no timeline: any of python-can's."""

import struct
from collections.abc import Iterator
from typing import Any
from uuid import uuid4

import can
import pytest

from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock
from servobench.drivers.wire.message_port import StampSource
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.faulty_bus import (
    FaultyBus,
)
from servobench.virtual_bus.faults.frame_fault import FrameFault
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.signal import SignalFault
from servobench.virtual_bus.hosting.injection import Injection
from tests.fates import keys

OUT, IN = Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST
TPDO, RPDO = 0x181, 0x201
MS = 1_000_000
LOSS = Loss(probability=1.0)
FRAME_NS = 47_000 + 3_000
"""More than an empty frame takes at 1 Mbit/s, at most 5 stuff bits included."""


def delay(least: int, most: int | None = None, reorder: bool = False, *ways: Direction) -> Delay:
    way: dict[str, Any] = {"direction": ways[0].label} if ways else {}
    most = least if most is None else most
    return Delay(delay_min_us=least / 1000, delay_max_us=most / 1000, reorder=reorder, **way)


@pytest.fixture
def virtual() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two ends of python-can's own bus of queues: wall-clock stamps, real waiting."""
    channel = f"faults-{uuid4().hex}"
    with (
        can.Bus(interface="virtual", channel=channel) as host,
        can.Bus(interface="virtual", channel=channel) as peer,
    ):
        yield host, peer


def over_virtual(inner: can.BusABC, *faults: FrameFault) -> FaultyBus:
    clock = MonotonicClock()
    bus = FaultyBus(inner, FaultInjector(FaultPlan(faults), 3), clock)
    bus.start(clock.now())
    return bus


def message_of(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=data)


def test_any_python_can_bus_holds_what_it_receives(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    inner, peer = virtual
    bus = over_virtual(inner, delay(3 * MS))
    peer.send(message_of(TPDO, b"\7"))
    sent = MonotonicClock().now()
    assert bus.recv(0) is None
    message = bus.recv(1.0)
    assert message is not None
    assert bytes(message.data) == b"\7"
    assert MonotonicClock().now() - sent >= 3 * MS
    bus.shutdown()


class ScriptedBus(can.BusABC):
    """A bus that stamps, with the clock that its waiting moves."""

    def __init__(self, arrivals: list[int]) -> None:
        self._now = Instant(0)
        self._arrivals = arrivals
        super().__init__(channel="scripted")

    def now(self) -> Instant:
        return self._now

    def sleep_until(self, when: Instant) -> None:
        self._now = max(self._now, when)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        until = self._now + round((timeout or 0.0) * NS_PER_S)
        if not self._arrivals or self._arrivals[0] > until:
            self._now = Instant(until)
            return None
        came = self._arrivals.pop(0)
        self._now = max(self._now, Instant(came))
        message = message_of(TPDO)
        message.timestamp = came / NS_PER_S
        return message

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.mark.parametrize(
    ("stamps", "stamps_ms", "handed_over_ms"),
    [(StampSource.MONOTONIC, [3, 5], [4, 5]), (StampSource.RECEIPT, [6, 6], [6, 6])],
    ids=["stamps on a known axis", "stamps on an unknown axis"],
)
def test_a_delay_counts_from_the_stamp_if_its_axis_is_known_and_else_from_receipt(
    stamps: StampSource, stamps_ms: list[int], handed_over_ms: list[int]
) -> None:
    """Frames at 1 ms and 5 ms, a delay of 2 ms until 4.5 ms, the owner away until 4 ms."""
    inner = ScriptedBus([1 * MS, 5 * MS])
    window = keys(until_s=1e-9 * 4_500_000)
    held = Delay(delay_min_us=(2 * MS) / 1000, delay_max_us=(2 * MS) / 1000, **window)
    bus = FaultyBus(inner, FaultInjector(FaultPlan((held,)), 3), inner, "host", stamps)
    bus.start(Instant(0))
    inner.sleep_until(Instant(4 * MS))
    for stamp_ms, now_ms in zip(stamps_ms, handed_over_ms, strict=True):
        message = bus.recv(0.01)
        assert message is not None
        assert message.timestamp == pytest.approx(stamp_ms / 1000, abs=1e-7)
        assert inner.now() == pytest.approx(now_ms * MS, abs=10)
    bus.shutdown()


def test_any_python_can_bus_loses_and_holds_what_is_sent(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    inner, peer = virtual
    sync_loss = Loss(probability=1.0, frames=("sync",))
    bus = over_virtual(inner, sync_loss, delay(3 * MS))
    message = message_of(RPDO, b"\1")
    bus.send(message_of(0x080))
    bus.send(message)
    message.data[0] = 99
    assert peer.recv(0) is None
    assert bus.recv(0.006) is None
    got = peer.recv(0)
    assert got is not None
    assert (got.arbitration_id, bytes(got.data)) == (RPDO, b"\1")
    assert peer.recv(0) is None
    bus.shutdown()


def test_periodic_sending_from_a_thread_is_refused(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    bus = over_virtual(virtual[0])
    with pytest.raises(NotImplementedError, match="one thread"):
        bus.send_periodic(message_of(0x080), 0.01)
    bus.shutdown()


def test_a_bus_that_fails_says_so_through_the_faults(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    bus = over_virtual(virtual[0], delay(MS))
    bus.send(message_of(RPDO))
    virtual[0].shutdown()
    with pytest.raises(can.CanOperationError):
        bus.recv(0.01)
    bus.shutdown()


def test_signals_are_altered_on_any_python_can_bus(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    """The peer is a drive whose mapping its master reads; each end hears what the other did not send."""
    inner, peer = virtual
    halved = SignalFault(object="target_torque", how="scale", factor=0.5)
    turned = SignalFault(object="velocity_actual_value", how="sign")
    fates = Injection(FaultPlan(signals=(halved, turned)), 3).fates
    assert fates is not None
    clock = MonotonicClock()
    bus = FaultyBus(inner, fates, clock)
    mapped = [
        (0x1600, 0, "4F00160001000000"),
        (0x1600, 1, "4300160110007160"),
        (0x1A00, 0, "4F001A0001000000"),
        (0x1A00, 1, "43001A0120006C60"),
    ]
    for index, sub, answer in mapped:
        bus.send(message_of(0x601, struct.pack("<BHB4x", 0x40, index, sub)))
        assert peer.recv(1.0) is not None
        peer.send(message_of(0x581, bytes.fromhex(answer)))
        assert bus.recv(1.0) is not None
    bus.start(clock.now())
    bus.send(message_of(RPDO, struct.pack("<h", -300)))
    heard = peer.recv(1.0)
    assert heard is not None
    assert struct.unpack("<h", heard.data) == (-150,)
    peer.send(message_of(TPDO, struct.pack("<i", 70_000)))
    told = bus.recv(1.0)
    assert told is not None
    assert struct.unpack("<i", told.data) == (-70_000,)
    assert bus.counts()["drive_to_host"]["signal_sign"] == 1
    bus.shutdown()
