"""The link over an ordinary python-can bus: stamps, taps, failures. (Over a frame port: test_frame_pump.)"""

from collections import deque
from typing import Any

import can
import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_S, Instant, wall_clock_offset
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.drivers.wire.link import BusLink, StampSource


class StillClock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.time = Instant(10 * NS_PER_S)

    def now(self) -> Instant:
        return self.time

    def sleep_until(self, when: Instant) -> None:
        self.time = when


class MessageBus(can.BusABC):
    """python-can's own path only: messages from a queue, sent ones into a list."""

    def __init__(self) -> None:
        super().__init__(channel="messages")
        self.channel_info = "messages"
        self.inbox: deque[can.Message] = deque()
        self.outbox: list[can.Message] = []
        self.waits: list[float | None] = []
        self.failure: Exception | None = None

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.failure is not None:
            raise self.failure
        self.waits.append(timeout)
        return self.inbox.popleft() if self.inbox else None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        if self.failure is not None:
            raise self.failure
        self.outbox.append(msg)

    def shutdown(self) -> None:
        super().shutdown()


def message(can_id: int = 0x181, **fields: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, **{"data": b"\x01", **fields})


def make(stamps: StampSource) -> tuple[MessageBus, StillClock, BusLink]:
    bus, clock = MessageBus(), StillClock()
    return bus, clock, BusLink(bus, clock, stamps)


def test_the_wait_is_what_is_left_until_the_deadline() -> None:
    bus, clock, link = make(StampSource.RECEIPT)
    assert link.recv(Instant(clock.time + NS_PER_S // 4)) is None
    assert link.recv(Instant(0)) is None
    assert bus.waits == [0.25, 0.0]
    bus.shutdown()


def test_monotonic_stamps_are_taken_as_they_are() -> None:
    bus, _, link = make(StampSource.MONOTONIC)
    bus.inbox.append(message(timestamp=9.5))
    assert link.recv(Instant(0)) == (0x181, b"\x01", 9_500_000_000)
    bus.shutdown()


def test_receipt_stands_in_for_stamps_of_no_use() -> None:
    bus, clock, link = make(StampSource.RECEIPT)
    bus.inbox.append(message(timestamp=9.5))
    assert link.recv(Instant(0)) == (0x181, b"\x01", clock.time)
    bus.shutdown()


def test_wall_clock_stamps_are_mapped() -> None:
    bus, clock, link = make(StampSource.WALL_CLOCK)
    wanted = clock.time - 1_000_000
    bus.inbox.append(message(timestamp=(wanted + wall_clock_offset()) / NS_PER_S))
    received = link.recv(Instant(0))
    assert received is not None
    assert abs(received[2] - wanted) < 1_000_000
    bus.shutdown()


def test_no_stamp_lies_in_the_future() -> None:
    bus, clock, link = make(StampSource.MONOTONIC)
    bus.inbox.append(message(timestamp=3600.0))
    received = link.recv(Instant(0))
    assert received is not None
    assert received[2] == clock.time
    bus.shutdown()


def test_the_tap_sees_what_the_link_hands_on_and_what_it_does_not() -> None:
    bus, clock, link = make(StampSource.RECEIPT)
    seen: list[tuple[Any, ...]] = []
    link.tap(lambda *frame: seen.append(frame))
    bus.inbox.extend(
        [message(is_error_frame=True), message(0x701, is_remote_frame=True, data=None), message(0x182)]
    )
    assert link.recv(Instant(0)) == (0x182, b"\x01", clock.time)
    at = link.send(0x80, b"")
    assert at == clock.time
    assert seen == [
        ("rx", 0x701, b"", False, True, at),
        ("rx", 0x182, b"\x01", False, False, at),
        ("tx", 0x80, b"", False, False, at),
    ]
    assert (link.error_frames, link.ignored_frames, link.received_frames, link.sent_frames) == (1, 1, 2, 1)
    assert [sent.is_extended_id for sent in bus.outbox] == [False]
    bus.shutdown()


@pytest.mark.parametrize("failure", [can.CanOperationError("gone"), OSError("gone")])
def test_failures_of_the_bus_are_one_error(failure: Exception) -> None:
    bus, _, link = make(StampSource.RECEIPT)
    bus.failure = failure
    with pytest.raises(BusDown, match="receive from messages; gone"):
        link.recv(Instant(0))
    with pytest.raises(BusDown, match="send on messages; gone"):
        link.send(0x80, b"")
    bus.shutdown()


def test_a_plain_bus_claims_no_echoes_whatever_its_messages_say() -> None:
    """python-can's SocketCAN bus calls every frame on a virtual interface its own."""
    bus, _, link = make(StampSource.MONOTONIC)
    bus.inbox.append(message(is_rx=False))
    assert link.echoes is EchoBasis.NONE
    assert link.recv(Instant(0)) == (0x181, b"\x01", 0)
    assert (link.received_frames, link.echoed_frames, link.last_own) == (1, 0, False)
    bus.shutdown()


@pytest.mark.parametrize("stamps", list(StampSource))
def test_a_plain_bus_needs_watching_where_it_stamps_at_receipt(stamps: StampSource) -> None:
    bus, _, link = make(stamps)
    assert link.needs_watching is (stamps is StampSource.RECEIPT)
    bus.shutdown()
