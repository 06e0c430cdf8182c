"""python-can's view of a segment: how it lets simulated time pass. The rest is in the bus contract."""

from collections.abc import Iterator

import can
import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Listener, Port
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus, TimelineCyclicTask
from servobench.virtual_bus.core.native import RECEIVE_QUEUE_MAX
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.ports import fetched
from tests.unit.virtual_bus.can_reference import wire_bits

SYNC = Frame(0x080)
SYNC_NS = len(wire_bits(SYNC)) * 1_000


@pytest.fixture
def bus() -> Iterator[SimulatedBus]:
    with SimulatedBus() as made:
        yield made


@pytest.fixture
def peer(bus: SimulatedBus) -> Port:
    return bus.segment.attach("peer", Listener())


def send_at(bus: SimulatedBus, port: Port, when: int, frame: Frame = SYNC) -> None:
    bus.timeline.post(Instant(when), lambda _now: port.send(frame))


def test_is_found_by_its_name_and_makes_its_own_segment() -> None:
    with can.Bus(interface="simulated", channel="host", bitrate=500_000, ignore_config=True) as bus:
        assert isinstance(bus, SimulatedBus)
        assert bus.segment.bitrate_bit_s == 500_000
        assert bus.timeline is bus.segment.timeline


def test_shares_a_given_segment() -> None:
    segment = CanSegment(Timeline())
    with can.Bus(interface="simulated", segment=segment, ignore_config=True) as bus:
        assert isinstance(bus, SimulatedBus)
        assert bus.segment is segment


def test_recv_lets_time_pass_up_to_the_frame_and_no_further(bus: SimulatedBus, peer: Port) -> None:
    send_at(bus, peer, 5_000_000)
    message = bus.recv(1.0)
    assert message is not None
    assert bus.timeline.now == 5_000_000 + SYNC_NS
    assert round(message.timestamp * 1e9) == bus.timeline.now


def test_recv_without_a_frame_lets_its_whole_timeout_pass(bus: SimulatedBus, peer: Port) -> None:
    send_at(bus, peer, 5_000_000)
    assert bus.recv(0.003) is None
    assert bus.timeline.now == 3_000_000
    assert bus.recv(-1.0) is None
    assert bus.recv(0) is None
    assert bus.timeline.now == 3_000_000


def test_recv_without_timeout_waits_for_the_frame_however_late(bus: SimulatedBus, peer: Port) -> None:
    send_at(bus, peer, 3_600 * NS_PER_S)
    message = bus.recv()
    assert message is not None
    assert bus.timeline.now == 3_600 * NS_PER_S + SYNC_NS


def test_recv_without_timeout_fails_when_nothing_can_come(bus: SimulatedBus) -> None:
    with pytest.raises(can.CanOperationError, match="no event is left"):
        bus.recv()


def test_send_lets_no_time_pass(bus: SimulatedBus) -> None:
    bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    assert (bus.timeline.now, bus.segment.frames) == (0, 0)
    bus.timeline.run_until(Instant(SYNC_NS))
    assert bus.segment.frames == 1


def test_send_that_waits_gives_up_at_its_timeout(bus: SimulatedBus) -> None:
    message = can.Message(arbitration_id=0, is_extended_id=True, data=bytes(8))
    for _ in range(TRANSMIT_QUEUE_MAX):
        bus.send(message, timeout=50e-6)
    with pytest.raises(can.CanOperationError, match="queue is full"):
        bus.send(message, timeout=50e-6)
    assert bus.timeline.now <= 50_000


def test_frames_that_nobody_fetches_are_bounded_and_counted(bus: SimulatedBus, peer: Port) -> None:
    def refill(_frame: Frame, _at: Instant) -> None:
        peer.send(SYNC)

    peer.on_sent = refill
    peer.send(SYNC)
    bus.timeline.run_until(Instant((RECEIVE_QUEUE_MAX + 10) * (SYNC_NS + 3_000) - 1))
    assert bus.overruns == 10
    received = 0
    while fetched(bus, bus.timeline.now) is not None:
        received += 1
    assert received == RECEIVE_QUEUE_MAX


def test_lean_path_honours_filters(bus: SimulatedBus, peer: Port) -> None:
    bus.set_filters([{"can_id": 0x181, "can_mask": 0x7FF, "extended": False}])
    peer.send(SYNC)
    peer.send(Frame(0x181, b"\x01"))
    received = fetched(bus, Instant(NS_PER_MS))
    assert received is not None
    assert received[0] == Frame(0x181, b"\x01")
    assert fetched(bus, Instant(NS_PER_MS)) is None


class TestPeriodic:
    """send_periodic in simulated time."""

    def stamps(self, bus: SimulatedBus, until: int) -> list[int]:
        seen: list[int] = []
        bus.segment.add_monitor(lambda _frame, at: seen.append(at - SYNC_NS))
        bus.timeline.run_until(Instant(until))
        return seen.copy()

    def start(self, bus: SimulatedBus, period: float, duration: float | None = None) -> TimelineCyclicTask:
        message = can.Message(arbitration_id=0x80, is_extended_id=False)
        task = bus.send_periodic(message, period, duration)
        assert isinstance(task, TimelineCyclicTask)
        return task

    def test_does_not_drift(self, bus: SimulatedBus) -> None:
        self.start(bus, 0.001)
        assert self.stamps(bus, 10 * NS_PER_S) == [cycle * NS_PER_MS for cycle in range(10_000)]

    def test_ends_with_its_duration(self, bus: SimulatedBus) -> None:
        self.start(bus, 0.002, 0.010)
        assert self.stamps(bus, NS_PER_S) == [0, 2_000_000, 4_000_000, 6_000_000, 8_000_000]

    def test_stops_and_starts_again(self, bus: SimulatedBus) -> None:
        task = self.start(bus, 0.002)
        self.stamps(bus, 3_000_000)
        task.stop()
        task.stop()
        assert self.stamps(bus, 9_000_000) == []
        task.start()
        task.start()
        assert self.stamps(bus, 12_500_000) == [9_000_000, 11_000_000]

    def test_data_can_be_changed_and_computed(self, bus: SimulatedBus) -> None:
        seen: list[bytes] = []
        bus.segment.add_monitor(lambda frame, _at: seen.append(frame.data))

        def count_up(message: can.Message) -> None:
            message.data[0] += 1

        message = can.Message(arbitration_id=0x80, is_extended_id=False, data=b"\x00")
        task = bus.send_periodic(message, 0.001, modifier_callback=count_up)
        bus.timeline.run_until(Instant(2_500_000))
        assert isinstance(task, TimelineCyclicTask)
        task.modify_data(can.Message(arbitration_id=0x80, is_extended_id=False, data=b"\x70"))
        bus.timeline.run_until(Instant(3_500_000))
        assert seen == [b"\x01", b"\x02", b"\x03", b"\x71"]

    def test_refused_messages_are_counted(self, bus: SimulatedBus) -> None:
        bus.segment.attach("babbler", Listener())
        babbler = bus.segment.attach("babbler", Listener())

        def refill(_frame: Frame, _at: Instant) -> None:
            babbler.send(Frame(0x000))

        babbler.on_sent = refill
        babbler.send(Frame(0x000))
        babbler.send(Frame(0x000))
        task = self.start(bus, 0.001)
        bus.timeline.run_until(Instant(299_500_000))
        assert task.refused == 300 - 256

    def test_ends_with_its_bus(self, bus: SimulatedBus) -> None:
        self.start(bus, 0.001)
        bus.shutdown()
        bus.timeline.run_until(Instant(5_000_000))
        assert bus.segment.frames == 0
