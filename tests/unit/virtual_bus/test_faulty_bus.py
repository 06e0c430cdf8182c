"""A bus with faults in front of it: when what comes through, on simulated and other buses."""

import itertools
from collections.abc import Iterator
from uuid import uuid4

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock
from virtual_bus.fault_injection.fault_plan import (
    Direction,
    Fault,
    FaultPlan,
    FrameClass,
    IndependentLoss,
    Selection,
)
from virtual_bus.fault_injection.fault_plan import UniformDelay as Delay
from virtual_bus.fault_injection.faulty_bus import HELD_MAX, FaultyBus, LeanFaultyBus, Side
from virtual_bus.faults import FaultInjector
from virtual_bus.frame import Frame
from virtual_bus.segment import Segment, SimulatedBus
from virtual_bus.timeline import SimulatedClock, Timeline

OUT, IN = Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST
TPDO, RPDO = 0x181, 0x201
MS = 1_000_000
LOSS = IndependentLoss(probability=1.0)
FRAME_NS = 47_000 + 3_000
"""More than an empty frame takes at 1 Mbit/s, at most 5 stuff bits included."""


def delay(least: int, most: int | None = None, reorder: bool = False, *ways: Direction) -> Delay:
    selection = Selection(directions=ways or (OUT, IN))
    most_ns = Duration(least if most is None else most)
    return Delay(min_ns=Duration(least), max_ns=most_ns, reorder=reorder, selection=selection)


class Rig:
    """A host behind faults and a bare peer on one simulated segment."""

    def __init__(self, *faults: Fault, side: Side = "host") -> None:
        self.timeline = Timeline()
        segment = Segment(self.timeline)
        self.clock = SimulatedClock(self.timeline)
        inner = SimulatedBus(segment=segment)
        self.bus = FaultyBus(inner, FaultInjector(FaultPlan(faults), 3), self.clock, side, Duration(0))
        assert isinstance(self.bus, LeanFaultyBus)
        self.lean: LeanFaultyBus = self.bus
        self.seen: list[tuple[Frame, Instant]] = []
        self.peer = segment.attach("peer", lambda frame, at: self.seen.append((frame, at)))
        self.bus.start(Instant(0))

    def close(self) -> None:
        self.bus.shutdown()

    def peer_sends(self, at: int, frame: Frame) -> None:
        self.timeline.call_at(Instant(at), lambda _now: self.peer.send(frame))


@pytest.fixture
def rigs() -> Iterator[list[Rig]]:
    made: list[Rig] = []
    yield made
    for rig in made:
        rig.close()


def rig_with(rigs: list[Rig], *faults: Fault, side: Side = "host") -> Rig:
    rigs.append(Rig(*faults, side=side))
    return rigs[-1]


def test_a_received_frame_is_held_for_its_delay_and_stamped_with_its_release(rigs: list[Rig]) -> None:
    bare, held = rig_with(rigs), rig_with(rigs, delay(300_000))
    arrivals = []
    for rig in (bare, held):
        rig.peer_sends(MS, Frame(TPDO, b"\1"))
        got = rig.lean.recv_frame(Instant(5 * MS))
        assert got is not None
        assert got == (Frame(TPDO, b"\1"), rig.timeline.now)
        arrivals.append(got[1])
    assert arrivals[1] - arrivals[0] == 300_000


def test_python_can_sees_the_same_instants(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, delay(300_000))
    rig.peer_sends(MS, Frame(TPDO, b"\1\2"))
    message = rig.bus.recv(0.005)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (TPDO, b"\1\2")
    assert round(message.timestamp * NS_PER_S) == rig.timeline.now
    assert MS + 300_000 < rig.timeline.now < MS + 300_000 + 2 * FRAME_NS


def test_recv_without_a_frame_ends_at_its_deadline(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, delay(10 * MS))
    rig.peer_sends(0, Frame(TPDO))
    assert rig.lean.recv_frame(Instant(2 * MS)) is None
    assert rig.timeline.now == 2 * MS
    assert rig.bus.recv(0.001) is None
    assert rig.timeline.now == 3 * MS


def test_a_frame_due_at_the_deadline_itself_is_delivered(rigs: list[Rig]) -> None:
    probe = rig_with(rigs)
    probe.peer_sends(0, Frame(TPDO))
    got = probe.lean.recv_frame(Instant(MS))
    assert got is not None
    rig = rig_with(rigs, delay(400_000))
    rig.peer_sends(0, Frame(TPDO))
    due = Instant(got[1] + 400_000)
    assert rig.lean.recv_frame(Instant(due - 1)) is None
    assert rig.lean.recv_frame(due) == (Frame(TPDO), due)


def test_a_delay_counts_from_the_stamp_however_late_the_owner_looks(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, delay(300_000))
    rig.peer_sends(0, Frame(TPDO))
    rig.clock.sleep_until(Instant(5 * MS))
    got = rig.lean.recv_frame(Instant(5 * MS))
    assert got is not None
    assert 300_000 < got[1] < 300_000 + 2 * FRAME_NS


def test_frames_come_in_the_order_of_release_even_if_nobody_looked(rigs: list[Rig]) -> None:
    """An undelayed frame that ended before a held one's release must not be handed over after it."""
    rig = rig_with(rigs, delay(2 * MS))
    rig.peer_sends(0, Frame(TPDO))
    assert rig.lean.recv_frame(Instant(MS)) is None
    rig.peer_sends(MS, Frame(0x701))
    rig.clock.sleep_until(Instant(10 * MS))
    order = [got[0].can_id for _ in range(2) if (got := rig.lean.recv_frame(rig.timeline.now)) is not None]
    assert order == [0x701, TPDO]


@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    sends=st.lists(st.tuples(st.integers(0, 20 * MS), st.sampled_from([TPDO, 0x282, 0x701])), max_size=25),
    waits=st.lists(st.integers(MS // 10, 3 * MS), min_size=40, max_size=40),
    asleep=st.integers(1, 4),
    reorder=st.booleans(),
)
def test_nothing_is_lost_invented_or_out_of_order(
    sends: list[tuple[int, int]], waits: list[int], asleep: int, reorder: bool
) -> None:
    rig = Rig(delay(0, 4 * MS, reorder))
    for index, (at, can_id) in enumerate(sends):
        rig.peer_sends(at, Frame(can_id, bytes([index])))
    got: list[tuple[Frame, Instant]] = []
    for turn, wait in enumerate(itertools.cycle(waits)):
        if turn % asleep == 0:
            rig.clock.sleep_until(Instant(rig.timeline.now + wait))
        while (one := rig.lean.recv_frame(Instant(rig.timeline.now + wait))) is not None:
            got.append(one)
            assert one[1] <= rig.timeline.now
        if rig.timeline.now > 40 * MS:
            break
    rig.close()
    assert sorted(frame.data for frame, _ in got) == [bytes([k]) for k in range(len(sends))]
    stamps = [at for _, at in got]
    assert stamps == sorted(stamps)


def test_losses_are_lost_either_way_and_nothing_else(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, LOSS)
    for can_id in (TPDO, 0x701, TPDO):
        rig.peer_sends(0, Frame(can_id))
    for can_id in (RPDO, 0x601, RPDO):
        rig.lean.send_frame(Frame(can_id))
    got = [one[0].can_id for _ in range(3) if (one := rig.lean.recv_frame(Instant(5 * MS))) is not None]
    assert got == [0x701]
    assert [frame.can_id for frame, _ in rig.seen] == [0x601]
    counts = rig.bus.counts()
    assert counts["host_to_drive"] == {"frames": 3, "loss": 2, "delayed": 0, "overflow": 0}
    assert counts["drive_to_host"] == {"frames": 3, "loss": 2, "delayed": 0, "overflow": 0}


@pytest.mark.parametrize(("side", "lost"), [("host", True), ("drive", False)])
def test_the_side_tells_the_direction(rigs: list[Rig], side: Side, lost: bool) -> None:
    only_out = IndependentLoss(probability=1.0, selection=Selection(directions=(OUT,)))
    rig = rig_with(rigs, only_out, side=side)
    rig.lean.send_frame(Frame(RPDO))
    rig.peer_sends(0, Frame(TPDO))
    got = rig.lean.recv_frame(Instant(MS))
    assert (rig.seen == []) is lost
    assert (got is None) is not lost


def test_a_held_send_goes_out_at_its_time_wherever_the_owner_is(rigs: list[Rig]) -> None:
    times = []
    for wait in ("recv", "sleep"):
        rig = rig_with(rigs, delay(300_000))
        rig.bus.send(can.Message(arbitration_id=RPDO, is_extended_id=False, data=b"\5"))
        if wait == "recv":
            assert rig.lean.recv_frame(Instant(MS)) is None
        else:
            rig.clock.sleep_until(Instant(MS))
        assert rig.timeline.now == MS
        assert rig.seen[0][0] == Frame(RPDO, b"\5")
        times.append(rig.seen[0][1])
    assert times[0] == times[1]
    assert 300_000 < times[0] < 300_000 + 2 * FRAME_NS


def test_recv_without_deadline_waits_for_the_held_frame_and_ends_when_nothing_can_come(
    rigs: list[Rig],
) -> None:
    rig = rig_with(rigs, delay(7 * MS))
    rig.peer_sends(0, Frame(TPDO))
    message = rig.bus.recv()
    assert message is not None
    assert message.arbitration_id == TPDO
    with pytest.raises(can.CanOperationError, match="no event is left"):
        rig.bus.recv()


def test_remote_and_extended_frames_come_through_unchanged(rigs: list[Rig]) -> None:
    every = Selection(frames=(FrameClass.ALL,))
    rig = rig_with(rigs, Delay(min_ns=Duration(10), max_ns=Duration(10), selection=every))
    frames = [Frame(TPDO, b"", False, True, 4), Frame(0x1ABCDEF, b"\1\2\3", True)]
    for frame in frames:
        rig.peer_sends(0, frame)
    messages = [rig.bus.recv(0.01), rig.bus.recv(0.01)]
    for message in messages:
        assert message is not None
        rig.bus.send(message)
    rig.clock.sleep_until(Instant(10 * MS))
    assert [frame for frame, _ in rig.seen] == frames


def test_more_held_frames_than_there_is_room_for_are_lost_and_counted(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, delay(NS_PER_S))
    for _ in range(HELD_MAX + 3):
        rig.lean.send_frame(Frame(RPDO))
    assert rig.bus.counts()["host_to_drive"]["overflow"] == 3


def test_shutdown_sends_what_is_held_and_closes_the_inner_bus() -> None:
    rig = Rig(delay(NS_PER_S))
    rig.lean.send_frame(Frame(RPDO))
    rig.close()
    rig.close()
    rig.clock.sleep_until(Instant(2 * NS_PER_S))
    assert [frame for frame, _ in rig.seen] == [Frame(RPDO)]
    assert rig.seen[0][1] < MS
    with pytest.raises(can.CanOperationError):
        rig.bus.recv(0)
    with pytest.raises(can.CanOperationError):
        rig.bus.inner.recv(0)


def test_periodic_frames_of_a_simulated_bus_meet_their_fate(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, LOSS)
    sync = can.Message(arbitration_id=0x080, is_extended_id=False)
    rpdo = can.Message(arbitration_id=RPDO, is_extended_id=False)
    tasks = [rig.bus.send_periodic(message, 0.001) for message in (sync, rpdo)]
    rig.clock.sleep_until(Instant(4 * MS + MS // 2))
    for task in tasks:
        task.stop()
    assert [frame.can_id for frame, _ in rig.seen] == [0x080] * 5


def test_filters_come_before_the_faults(rigs: list[Rig]) -> None:
    rig = rig_with(rigs, LOSS)
    rig.bus.set_filters([{"can_id": 0x701, "can_mask": 0x7FF}])
    rig.peer_sends(0, Frame(TPDO))
    rig.peer_sends(0, Frame(0x701))
    got = rig.lean.recv_frame(Instant(MS))
    assert got is not None
    assert got[0].can_id == 0x701
    assert rig.bus.counts()["drive_to_host"]["frames"] == 1


@pytest.fixture
def virtual() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two ends of python-can's own bus of queues: wall-clock stamps, real waiting."""
    channel = f"faults-{uuid4().hex}"
    with (
        can.Bus(interface="virtual", channel=channel) as host,
        can.Bus(interface="virtual", channel=channel) as peer,
    ):
        yield host, peer


def over_virtual(inner: can.BusABC, *faults: Fault) -> FaultyBus:
    clock = MonotonicClock()
    bus = FaultyBus(inner, FaultInjector(FaultPlan(faults), 3), clock)
    bus.start(clock.now())
    return bus


def message_of(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=data)


def test_any_python_can_bus_holds_what_it_receives(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    inner, peer = virtual
    bus = over_virtual(inner, delay(3 * MS))
    assert not hasattr(bus, "recv_frame")
    peer.send(message_of(TPDO, b"\7"))
    sent = MonotonicClock().now()
    assert bus.recv(0) is None
    message = bus.recv(1.0)
    assert message is not None
    assert bytes(message.data) == b"\7"
    assert MonotonicClock().now() - sent >= 3 * MS
    bus.shutdown()


class ScriptedBus(can.BusABC):
    """A bus that stamps on an axis of its own, with the clock that its waiting moves."""

    def __init__(self, arrivals: list[int], stamp_offset: int) -> None:
        self._now = Instant(0)
        self._arrivals = arrivals
        self._stamp_offset = stamp_offset
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
        message.timestamp = (came + self._stamp_offset) / NS_PER_S
        return message

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.mark.parametrize(
    ("offset", "stamps_ms", "handed_over_ms"),
    [(Duration(100 * NS_PER_S), [3, 5], [4, 5]), (None, [3, 6], [6, 6])],
    ids=["stamps on a known axis", "stamps on an unknown axis"],
)
def test_a_delay_counts_from_the_stamp_if_its_axis_is_known_and_else_from_receipt(
    offset: Duration | None, stamps_ms: list[int], handed_over_ms: list[int]
) -> None:
    """Frames at 1 ms and 5 ms, a delay of 2 ms until 4.5 ms, the owner away until 4 ms."""
    inner = ScriptedBus([1 * MS, 5 * MS], 100 * NS_PER_S)
    window = Selection(until_ns=Duration(4_500_000))
    held = Delay(min_ns=Duration(2 * MS), max_ns=Duration(2 * MS), selection=window)
    bus = FaultyBus(inner, FaultInjector(FaultPlan((held,)), 3), inner, "host", offset)
    bus.start(Instant(0))
    inner.sleep_until(Instant(4 * MS))
    for stamp_ms, now_ms in zip(stamps_ms, handed_over_ms, strict=True):
        message = bus.recv(0.01)
        assert message is not None
        assert message.timestamp == pytest.approx(100 + stamp_ms / 1000, abs=1e-7)
        assert inner.now() == pytest.approx(now_ms * MS, abs=10)
    bus.shutdown()


def test_any_python_can_bus_loses_and_holds_what_is_sent(virtual: tuple[can.BusABC, can.BusABC]) -> None:
    inner, peer = virtual
    sync_loss = IndependentLoss(probability=1.0, selection=Selection(frames=(FrameClass.SYNC,)))
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
