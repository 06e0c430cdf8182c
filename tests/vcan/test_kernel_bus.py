"""What the bench relies on in the kernel's own CAN socket, through python-can."""

from collections.abc import Iterator
from contextlib import ExitStack

import can
import pytest

from servobench.drivers.timebase import NS_PER_S, MonotonicClock, wall_clock_offset

FRAMES = 200
PATIENCE_S = 10.0


@pytest.fixture
def pair(channel: str) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two participants on the same interface."""
    with ExitStack() as stack:
        first, second = (
            stack.enter_context(can.Bus(interface="socketcan", channel=channel)) for _ in range(2)
        )
        yield first, second


def test_frames_arrive_whole_and_in_order(pair: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = pair
    sent = [(0x180 + number % 128, number.to_bytes(2, "little")) for number in range(FRAMES)]
    for can_id, data in sent:
        sender.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    got = [receiver.recv(PATIENCE_S) for _ in sent]

    assert [(message.arbitration_id, bytes(message.data)) for message in got if message] == sent


def test_own_frames_do_not_come_back(pair: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = pair
    sender.send(can.Message(arbitration_id=0x80, is_extended_id=False))

    assert receiver.recv(PATIENCE_S) is not None
    assert sender.recv(0.0) is None


def test_remote_and_extended_frames_keep_their_kind(pair: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = pair
    sender.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
    sender.send(can.Message(arbitration_id=0x1ABCDEF0, data=b"\x01", is_extended_id=True))

    remote, extended = receiver.recv(PATIENCE_S), receiver.recv(PATIENCE_S)

    assert remote is not None
    assert (remote.is_remote_frame, remote.dlc, remote.is_extended_id) == (True, 1, False)
    assert extended is not None
    assert (extended.is_extended_id, extended.arbitration_id) == (True, 0x1ABCDEF0)


def test_receive_stamp_lies_between_sending_and_receiving(pair: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = pair
    clock = MonotonicClock()
    offset = wall_clock_offset()

    before = clock.now()
    sender.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    message = receiver.recv(PATIENCE_S)
    after = clock.now()

    assert message is not None
    stamped = round(message.timestamp * NS_PER_S) - offset
    tolerance_ns = 100_000  # the offset's own reading, and a float's resolution of the wall clock
    assert before - tolerance_ns <= stamped <= after + tolerance_ns
