"""What every bus of the bench has to do, whatever is behind it.

A subclass names its bus by the fixture ``open_bus``: each call opens one more participant
of the same bus, closed at the end of the test.
"""

import random
from collections.abc import Callable
from itertools import pairwise

import can
import pytest

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.message import message_of
from servobench.virtual_bus.frame import Frame
from tests.ports import fetched
from tests.unit.virtual_bus.can_reference import random_frame, wire_bits

OpenBus = Callable[..., can.BusABC]

PATIENCE_S = 2.0
"""For a frame that must come."""
SILENCE_S = 0.02
"""For a frame that must not."""


def data_message(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=data)


def content(message: can.Message | None) -> Frame:
    """What of a message is on the wire."""
    assert message is not None, "no frame came"
    if message.is_remote_frame:
        return Frame(message.arbitration_id, b"", message.is_extended_id, True, message.dlc)
    return Frame(message.arbitration_id, bytes(message.data), message.is_extended_id)


def fetch(bus: can.BusABC, count: int) -> list[can.Message]:
    messages: list[can.Message] = []
    for _ in range(count):
        message = bus.recv(PATIENCE_S)
        assert message is not None, f"only {len(messages)} of {count} frames came"
        messages.append(message)
    return messages


class BusSuite:
    """The contract of any bus that python-can can open."""

    marks_own_frames = True
    """``is_rx`` is False on an own frame that comes back (socketcan on vcan marks all frames so)."""

    def test_frame_reaches_every_other_participant_and_not_its_sender(self, open_bus: OpenBus) -> None:
        sender, first, second = open_bus(), open_bus(), open_bus()
        sender.send(data_message(0x123, b"\x01\x02"))
        for receiver in (first, second):
            assert content(receiver.recv(PATIENCE_S)) == Frame(0x123, b"\x01\x02")
        assert sender.recv(SILENCE_S) is None

    def test_any_classical_frame_arrives_as_it_was_sent(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        source = random.Random(3)
        for _ in range(100):
            frame = random_frame(source)
            sender.send(message_of(frame, at=0))  # type: ignore[arg-type]
            received = receiver.recv(PATIENCE_S)
            assert content(received) == frame
            assert received is not None
            assert not received.is_error_frame
            assert not received.is_fd

    def test_frames_of_one_sender_keep_their_order_and_stamps_never_decrease(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        for number in range(60):
            sender.send(data_message(0x700 - number, bytes([number])))
        messages = fetch(receiver, 60)
        assert [message.data[0] for message in messages] == list(range(60))
        stamps = [message.timestamp for message in messages]
        assert stamps == sorted(stamps)

    def test_two_senders_are_both_heard_completely(self, open_bus: OpenBus) -> None:
        one, other, listener = open_bus(), open_bus(), open_bus()
        for number in range(40):
            one.send(data_message(0x100, bytes([number])))
            other.send(data_message(0x200, bytes([number])))
        messages = fetch(listener, 80)
        for can_id in (0x100, 0x200):
            numbers = [message.data[0] for message in messages if message.arbitration_id == can_id]
            assert numbers == list(range(40))

    def test_own_frames_come_back_on_request(self, open_bus: OpenBus) -> None:
        sender, other = open_bus(receive_own_messages=True), open_bus()
        sender.send(data_message(0x321, b"\x55"))
        own = sender.recv(PATIENCE_S)
        assert content(own) == Frame(0x321, b"\x55")
        assert own is not None
        assert not own.is_rx
        assert content(other.recv(PATIENCE_S)) == Frame(0x321, b"\x55")
        other.send(data_message(0x322))
        foreign = sender.recv(PATIENCE_S)
        assert content(foreign) == Frame(0x322)
        assert foreign is not None
        assert foreign.is_rx is self.marks_own_frames

    def test_filters_let_through_only_what_matches(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        receiver.set_filters([{"can_id": 0x180, "can_mask": 0x780, "extended": False}])
        for can_id in (0x080, 0x181, 0x201, 0x1FF):
            sender.send(data_message(can_id))
        sender.send(can.Message(arbitration_id=0x181, is_extended_id=True))
        assert [message.arbitration_id for message in fetch(receiver, 2)] == [0x181, 0x1FF]
        assert receiver.recv(SILENCE_S) is None
        receiver.set_filters(None)
        sender.send(data_message(0x080))
        assert content(receiver.recv(PATIENCE_S)) == Frame(0x080)

    def test_waiting_ends_with_nothing_when_nothing_comes(self, open_bus: OpenBus) -> None:
        bus, _ = open_bus(), open_bus()
        assert bus.recv(0) is None
        assert bus.recv(SILENCE_S) is None

    def test_frame_sent_just_before_leaving_still_goes_out(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        sender.send(data_message(0x000, b"\x80\x01"))
        sender.shutdown()
        assert content(receiver.recv(PATIENCE_S)) == Frame(0x000, b"\x80\x01")

    def test_periodic_message_goes_out_again_and_again_until_stopped(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        task = sender.send_periodic(data_message(0x080), 0.002)
        stamps = [message.timestamp for message in fetch(receiver, 10)]
        task.stop()
        assert stamps[-1] - stamps[0] > 0.9 * 9 * 0.002
        while receiver.recv(SILENCE_S) is not None:
            pass
        assert receiver.recv(2 * SILENCE_S) is None


class ExactBusSuite(BusSuite):
    """Beyond that, for a bus of this house: bit time, stated queues, refusals in words."""

    bitrate_bit_s = 1_000_000

    def test_frames_take_their_time_on_the_bus(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        for _ in range(20):
            sender.send(data_message(0x181, b"\x00" * 8))
        messages = fetch(receiver, 20)
        steps = [later.timestamp - sooner.timestamp for sooner, later in pairwise(messages)]
        # stuffed length and intermission; the sender is faster than the bus
        assert min(steps) == pytest.approx(self.frame_s(Frame(0x181, bytes(8))), abs=2e-9)

    def frame_s(self, frame: Frame) -> float:
        return (len(wire_bits(frame)) + 3) / self.bitrate_bit_s

    def test_full_queue_is_reported_and_nothing_accepted_is_lost(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        long_message = can.Message(arbitration_id=0, is_extended_id=True, data=bytes(8))
        accepted = 0

        def flood() -> None:
            nonlocal accepted
            for _ in range(100_000):
                sender.send(long_message)
                accepted += 1

        with pytest.raises(can.CanOperationError, match="transmit queue is full"):
            flood()
        assert len(fetch(receiver, accepted)) == accepted
        assert receiver.recv(SILENCE_S) is None

    def test_sender_may_wait_for_a_place_in_the_queue(self, open_bus: OpenBus) -> None:
        sender, receiver = open_bus(), open_bus()
        for _ in range(800):
            sender.send(data_message(0x100), timeout=PATIENCE_S)
        assert len(fetch(receiver, 800)) == 800

    @pytest.mark.parametrize(
        "message",
        [
            can.Message(is_fd=True, data=bytes(8)),
            can.Message(is_error_frame=True),
            can.Message(arbitration_id=0x800, is_extended_id=False),
            can.Message(arbitration_id=1 << 29),
            can.Message(dlc=9, is_remote_frame=True),
            can.Message(dlc=3, data=b"\x01"),
        ],
    )
    def test_what_classical_can_cannot_carry_is_refused(
        self, open_bus: OpenBus, message: can.Message
    ) -> None:
        sender, receiver = open_bus(), open_bus()
        with pytest.raises(can.CanOperationError):
            sender.send(message)
        assert receiver.recv(SILENCE_S) is None

    def test_bus_that_was_shut_down_says_so(self, open_bus: OpenBus) -> None:
        bus, _ = open_bus(), open_bus()
        bus.shutdown()
        with pytest.raises(can.CanOperationError):
            bus.send(data_message(0x100))
        with pytest.raises(can.CanOperationError, match="shut down"):
            bus.recv(0)

    def test_the_frame_port_carries_the_same_frames_on_the_same_axis(self, open_bus: OpenBus) -> None:
        sender, direct, plain = open_bus(), open_bus(), open_bus()
        frame = Frame(0x12345, b"\x07\x08", True)
        sender.frame_port.transmit(frame)  # type: ignore[attr-defined]
        message = plain.recv(PATIENCE_S)
        assert content(message) == frame
        assert message is not None
        got = fetched(direct, Instant(round(message.timestamp * 1e9)))
        assert got is not None
        received, at = got
        assert received == frame
        assert message.timestamp == pytest.approx(at * 1e-9, abs=1e-9)
        assert fetched(direct, at) is None
