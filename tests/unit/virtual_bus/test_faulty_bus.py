"""A bus with faults in front of it: when what comes through, on simulated and other buses."""

import itertools
from collections.abc import Iterator
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.core.native import HELD_MAX
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.faulty_bus import (
    FaultyBus,
    SimulatedFaultyBus,
)
from servobench.virtual_bus.faults.frame_fault import FrameFault, Side
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.draws import examples_of
from tests.fates import keys
from tests.hearing import Hearing
from tests.ports import fetched

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


class InFront(FaultyBus):
    """As over a bus that is not simulated."""


class Rig:
    """A host behind faults and a bare peer on one simulated segment.

    ``outside``: the faults sit in front of the bus, as on any other, and not at its port.
    """

    def __init__(
        self, *faults: FrameFault, side: Side = "host", outside: bool = False, own: bool = False
    ) -> None:
        self.timeline = Timeline()
        segment = CanSegment(self.timeline)
        self.clock = SimulatedClock(self.timeline)
        inner = SimulatedBus(segment=segment, receive_own_messages=own)
        injector = FaultInjector(FaultPlan(faults), 3)
        make = InFront if outside else FaultyBus
        self.bus = make(inner, injector, self.clock, side)
        assert isinstance(self.bus, InFront if outside else SimulatedFaultyBus)
        self.port = self.bus.frame_port
        self.seen: list[tuple[Frame, Instant]] = []
        self.peer = segment.attach("peer", Hearing(lambda frame, at: self.seen.append((frame, at))))
        self.bus.start(Instant(0))

    def close(self) -> None:
        self.bus.shutdown()

    def peer_sends(self, at: int, frame: Frame) -> None:
        self.timeline.call_at(Instant(at), lambda _now: self.peer.send(frame))

    def wait_until(self, when: Instant) -> None:
        while fetched(self.bus, when) is not None:
            pass


class Rigs:
    """The rigs of one test, all of one kind."""

    def __init__(self, outside: bool) -> None:
        self.outside = outside
        self.made: list[Rig] = []


@pytest.fixture(params=[False, True], ids=["at_the_port", "in_front"])
def rigs(request: pytest.FixtureRequest) -> Iterator[Rigs]:
    rigs = Rigs(request.param)
    yield rigs
    for rig in rigs.made:
        rig.close()


only_at_the_port = pytest.mark.parametrize("rigs", [False], indirect=True)


def rig_with(rigs: Rigs, *faults: FrameFault, side: Side = "host", own: bool = False) -> Rig:
    rigs.made.append(Rig(*faults, side=side, outside=rigs.outside, own=own))
    return rigs.made[-1]


def test_a_received_frame_is_held_for_its_delay_and_stamped_with_its_release(rigs: Rigs) -> None:
    bare, held = rig_with(rigs), rig_with(rigs, delay(300_000))
    arrivals = []
    for rig in (bare, held):
        rig.peer_sends(MS, Frame(TPDO, b"\1"))
        got = fetched(rig.bus, Instant(5 * MS))
        assert got is not None
        assert got == (Frame(TPDO, b"\1"), rig.timeline.now)
        arrivals.append(got[1])
    assert arrivals[1] - arrivals[0] == 300_000


def test_python_can_sees_the_same_instants(rigs: Rigs) -> None:
    rig = rig_with(rigs, delay(300_000))
    rig.peer_sends(MS, Frame(TPDO, b"\1\2"))
    message = rig.bus.recv(0.005)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (TPDO, b"\1\2")
    assert round(message.timestamp * NS_PER_S) == rig.timeline.now
    assert MS + 300_000 < rig.timeline.now < MS + 300_000 + 2 * FRAME_NS


def test_recv_without_a_frame_ends_at_its_deadline(rigs: Rigs) -> None:
    rig = rig_with(rigs, delay(10 * MS))
    rig.peer_sends(0, Frame(TPDO))
    assert fetched(rig.bus, Instant(2 * MS)) is None
    assert rig.timeline.now == 2 * MS
    assert rig.bus.recv(0.001) is None
    assert rig.timeline.now == 3 * MS


def test_a_frame_due_at_the_deadline_itself_is_delivered(rigs: Rigs) -> None:
    probe = rig_with(rigs)
    probe.peer_sends(0, Frame(TPDO))
    got = fetched(probe.bus, Instant(MS))
    assert got is not None
    rig = rig_with(rigs, delay(400_000))
    rig.peer_sends(0, Frame(TPDO))
    due = Instant(got[1] + 400_000)
    assert fetched(rig.bus, Instant(due - 1)) is None
    assert fetched(rig.bus, due) == (Frame(TPDO), due)


def test_a_delay_counts_from_the_stamp_however_late_the_owner_looks(rigs: Rigs) -> None:
    rig = rig_with(rigs, delay(300_000))
    rig.peer_sends(0, Frame(TPDO))
    rig.clock.sleep_until(Instant(5 * MS))
    got = fetched(rig.bus, Instant(5 * MS))
    assert got is not None
    assert 300_000 < got[1] < 300_000 + 2 * FRAME_NS


def test_frames_come_in_the_order_of_release_even_if_nobody_looked(rigs: Rigs) -> None:
    """An undelayed frame that ended before a held one's release must not be handed over after it."""
    rig = rig_with(rigs, delay(2 * MS))
    rig.peer_sends(0, Frame(TPDO))
    assert fetched(rig.bus, Instant(MS)) is None
    rig.peer_sends(MS, Frame(0x701))
    rig.clock.sleep_until(Instant(10 * MS))
    order = [got[0].can_id for _ in range(2) if (got := fetched(rig.bus, rig.timeline.now)) is not None]
    assert order == [0x701, TPDO]


@examples_of(60)
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
        while (one := fetched(rig.bus, Instant(rig.timeline.now + wait))) is not None:
            got.append(one)
            assert one[1] <= rig.timeline.now
        if rig.timeline.now > 40 * MS:
            break
    rig.close()
    assert sorted(frame.data for frame, _ in got) == [bytes([k]) for k in range(len(sends))]
    stamps = [at for _, at in got]
    assert stamps == sorted(stamps)


def test_losses_are_lost_either_way_and_nothing_else(rigs: Rigs) -> None:
    rig = rig_with(rigs, LOSS)
    for can_id in (TPDO, 0x701, TPDO):
        rig.peer_sends(0, Frame(can_id))
    for can_id in (RPDO, 0x601, RPDO):
        rig.port.transmit(Frame(can_id))
    got = [one[0].can_id for _ in range(3) if (one := fetched(rig.bus, Instant(5 * MS))) is not None]
    assert got == [0x701]
    assert [frame.can_id for frame, _ in rig.seen] == [0x601]
    counts = rig.bus.counts()
    assert counts["host_to_drive"] == {"frames": 3, "loss": 2, "delayed": 0, "overflow": 0}
    assert counts["drive_to_host"] == {"frames": 3, "loss": 2, "delayed": 0, "overflow": 0}


@pytest.mark.parametrize(("side", "lost"), [("host", True), ("drive", False)])
def test_the_side_tells_the_direction(rigs: Rigs, side: Side, lost: bool) -> None:
    only_out = Loss(probability=1.0, direction="host_to_drive")
    rig = rig_with(rigs, only_out, side=side)
    rig.port.transmit(Frame(RPDO))
    rig.peer_sends(0, Frame(TPDO))
    got = fetched(rig.bus, Instant(MS))
    assert (rig.seen == []) is lost
    assert (got is None) is not lost


@only_at_the_port
def test_a_held_send_goes_out_at_its_time_wherever_the_owner_is(rigs: Rigs) -> None:
    times = []
    for wait in ("recv", "sleep"):
        rig = rig_with(rigs, delay(300_000))
        rig.bus.send(can.Message(arbitration_id=RPDO, is_extended_id=False, data=b"\5"))
        if wait == "recv":
            assert fetched(rig.bus, Instant(MS)) is None
        else:
            rig.clock.sleep_until(Instant(MS))
        assert rig.timeline.now == MS
        assert rig.seen[0][0] == Frame(RPDO, b"\5")
        times.append(rig.seen[0][1])
    assert times[0] == times[1]
    assert 300_000 < times[0] < 300_000 + 2 * FRAME_NS


@only_at_the_port
def test_recv_without_deadline_waits_for_the_held_frame_and_ends_when_nothing_can_come(
    rigs: Rigs,
) -> None:
    rig = rig_with(rigs, delay(7 * MS))
    rig.peer_sends(0, Frame(TPDO))
    message = rig.bus.recv()
    assert message is not None
    assert message.arbitration_id == TPDO
    with pytest.raises(can.CanOperationError, match="no event is left"):
        rig.bus.recv()


def test_remote_and_extended_frames_come_through_unchanged(rigs: Rigs) -> None:
    every = keys(frames=("all",))
    rig = rig_with(rigs, Delay(delay_min_us=10 / 1000, delay_max_us=10 / 1000, **every))
    frames = [Frame(TPDO, b"", False, True, 4), Frame(0x1ABCDEF, b"\1\2\3", True)]
    for frame in frames:
        rig.peer_sends(0, frame)
    messages = [rig.bus.recv(0.01), rig.bus.recv(0.01)]
    for message in messages:
        assert message is not None
        rig.bus.send(message)
    rig.wait_until(Instant(10 * MS))
    assert [frame for frame, _ in rig.seen] == frames


def test_more_held_frames_than_there_is_room_for_are_lost_and_counted(rigs: Rigs) -> None:
    rig = rig_with(rigs, delay(NS_PER_S))
    for _ in range(HELD_MAX + 3):
        rig.port.transmit(Frame(RPDO))
    assert rig.bus.counts()["host_to_drive"]["overflow"] == 3


def test_shutdown_sends_what_is_held_and_closes_the_inner_bus() -> None:
    rig = Rig(delay(NS_PER_S))
    rig.port.transmit(Frame(RPDO))
    rig.close()
    rig.close()
    rig.clock.sleep_until(Instant(2 * NS_PER_S))
    assert [frame for frame, _ in rig.seen] == [Frame(RPDO)]
    assert rig.seen[0][1] < MS
    with pytest.raises(can.CanOperationError):
        rig.bus.recv(0)
    with pytest.raises(can.CanOperationError):
        rig.bus.inner.recv(0)


@only_at_the_port
def test_periodic_frames_of_a_simulated_bus_meet_their_fate(rigs: Rigs) -> None:
    rig = rig_with(rigs, LOSS)
    sync = can.Message(arbitration_id=0x080, is_extended_id=False)
    rpdo = can.Message(arbitration_id=RPDO, is_extended_id=False)
    tasks = [rig.bus.send_periodic(message, 0.001) for message in (sync, rpdo)]
    rig.clock.sleep_until(Instant(4 * MS + MS // 2))
    for task in tasks:
        task.stop()
    assert [frame.can_id for frame, _ in rig.seen] == [0x080] * 5


def test_filters_come_before_the_faults(rigs: Rigs) -> None:
    rig = rig_with(rigs, LOSS)
    rig.bus.set_filters([{"can_id": 0x701, "can_mask": 0x7FF}])
    rig.peer_sends(0, Frame(TPDO))
    rig.peer_sends(0, Frame(0x701))
    got = fetched(rig.bus, Instant(MS))
    assert got is not None
    assert got[0].can_id == 0x701
    assert rig.bus.counts()["drive_to_host"]["frames"] == 1
