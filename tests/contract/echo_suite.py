"""What every bus with echoes has to do: an own frame comes back when, and only when, it was on the bus.

The truth is a third participant that only listens.
"""

from collections.abc import Callable
from typing import NamedTuple

import can
import pytest

from servobench.drivers.timebase import NS_PER_MS, Clock, Duration, Instant
from servobench.drivers.wire.frame_port import UNTOLD, EchoBasis, FramePort
from servobench.drivers.wire.link import BusLink
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.faulty_bus import FaultyBus
from servobench.virtual_bus.faults.frame_fault import FrameFault
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.frame import Frame
from tests.fates import keys

OpenBus = Callable[..., can.BusABC]

PATIENCE_NS = 2_000 * NS_PER_MS
"""For a frame that must come."""
SILENCE_NS = 20 * NS_PER_MS
"""For one that must not."""
SYNC, TPDO, RPDO = 0x080, 0x181, 0x201
OUT = keys(direction="host_to_drive")
IN = keys(direction="drive_to_host", frames=("all",))
HELD = Duration(3 * NS_PER_MS)


class Seen(NamedTuple):
    """A frame, as one participant saw it."""

    can_id: int
    at: Instant
    own: bool


class EchoSuite:
    """The contract of ``FramePort.echoes``; a subclass names its bus by the fixtures ``open_bus`` and
    ``clock``."""

    basis: EchoBasis
    stamps_differ_max_ns = 0
    """Between two participants, for one frame."""
    tells_which = False
    """Whether an echo tells when its frame was handed over."""

    @pytest.fixture
    def make_faulty(self) -> type[FaultyBus]:
        return FaultyBus

    @pytest.fixture
    def watch(self, open_bus: OpenBus) -> FramePort:
        witness: FramePort = open_bus().frame_port  # type: ignore[attr-defined]
        return witness

    def take(self, port: FramePort, count: int, clock: Clock) -> list[Seen]:
        seen: list[Seen] = []
        for _ in range(count):
            frame = port.receive(Instant(clock.now() + PATIENCE_NS))
            assert frame is not None, f"only {seen} of {count} frames came"
            seen.append(Seen(frame.can_id, port.came_at, port.came_own))
        return seen

    def assert_same(self, seen: list[Seen], truth: list[Seen]) -> None:
        assert [each.can_id for each in seen] == [each.can_id for each in truth]
        for ours, theirs in zip(seen, truth, strict=True):
            assert abs(ours.at - theirs.at) <= self.stamps_differ_max_ns

    def faulty(
        self, open_bus: OpenBus, clock: Clock, make: type[FaultyBus], *faults: FrameFault
    ) -> tuple[FaultyBus, FramePort]:
        bus = make(open_bus(receive_own_messages=True), FaultInjector(FaultPlan(faults), 3), clock)
        bus.start(clock.now())
        return bus, bus.frame_port

    def test_the_basis_is_told_and_there_is_none_unless_asked_for(
        self, open_bus: OpenBus, clock: Clock
    ) -> None:
        asking, other = open_bus(receive_own_messages=True), open_bus()
        assert BusLink(asking, clock).echoes is self.basis
        assert BusLink(other, clock).echoes is EchoBasis.NONE

    def test_an_echo_comes_before_what_answers_it_and_with_the_instant_that_others_saw(
        self, open_bus: OpenBus, clock: Clock, watch: FramePort
    ) -> None:
        host: FramePort = open_bus(receive_own_messages=True).frame_port  # type: ignore[attr-defined]
        drive: FramePort = open_bus().frame_port  # type: ignore[attr-defined]
        for _ in range(20):
            host.transmit(Frame(SYNC))
            self.take(drive, 1, clock)
            drive.transmit(Frame(TPDO))
            seen = self.take(host, 2, clock)
            assert [(each.can_id, each.own) for each in seen] == [(SYNC, True), (TPDO, False)]
            self.assert_same(seen, self.take(watch, 2, clock))

    def test_a_lost_frame_has_no_echo(
        self, open_bus: OpenBus, clock: Clock, watch: FramePort, make_faulty: type[FaultyBus]
    ) -> None:
        loss = Loss(probability=1.0, **OUT)
        bus, host = self.faulty(open_bus, clock, make_faulty, loss)
        host.transmit(Frame(RPDO))
        host.transmit(Frame(SYNC))
        seen = self.take(host, 1, clock)
        assert (seen[0].can_id, seen[0].own) == (SYNC, True)
        self.assert_same(seen, self.take(watch, 1, clock))
        assert host.receive(Instant(clock.now() + SILENCE_NS)) is None
        bus.shutdown()

    def test_a_held_frame_has_its_echo_when_it_was_sent(
        self, open_bus: OpenBus, clock: Clock, watch: FramePort, make_faulty: type[FaultyBus]
    ) -> None:
        held = Delay(delay_min_us=1e-3 * HELD, delay_max_us=1e-3 * HELD, **OUT)
        bus, host = self.faulty(open_bus, clock, make_faulty, held)
        handed_at = clock.now()
        host.transmit(Frame(RPDO))
        seen = self.take(host, 1, clock)
        assert seen[0].own
        assert seen[0].at >= handed_at + HELD
        self.assert_same(seen, self.take(watch, 1, clock))
        bus.shutdown()

    def test_each_copy_has_an_echo(
        self, open_bus: OpenBus, clock: Clock, watch: FramePort, make_faulty: type[FaultyBus]
    ) -> None:
        twice = Duplicate(probability=1.0, **OUT)
        bus, host = self.faulty(open_bus, clock, make_faulty, twice)
        host.transmit(Frame(RPDO))
        seen = self.take(host, 2, clock)
        assert [each.own for each in seen] == [True, True]
        self.assert_same(seen, self.take(watch, 2, clock))
        assert host.receive(Instant(clock.now() + SILENCE_NS)) is None
        bus.shutdown()

    def test_an_echo_tells_of_which_frame_it_is_or_nothing(
        self, open_bus: OpenBus, clock: Clock, make_faulty: type[FaultyBus]
    ) -> None:
        """By when that was handed over; the truth is a number in the data."""
        loss = Loss(probability=0.3, **OUT)
        held = Delay(delay_min_us=0 / 1000, delay_max_us=1e-3 * HELD, reorder=True, **OUT)
        bus, _ = self.faulty(open_bus, clock, make_faulty, loss, held)
        link = BusLink(bus, clock)
        handed_at = []
        for number in range(20):
            handed_at.append(link.send(RPDO, bytes([number])))
            clock.sleep_until(Instant(clock.now() + 1))
        order = []
        while link.fetch(Instant(clock.now() + SILENCE_NS)):
            order.append(link.last_data[0])
            assert link.last_handed_at == (handed_at[order[-1]] if self.tells_which else UNTOLD)
        assert 5 < len(order) < 20
        assert order != sorted(order)
        bus.shutdown()

    def test_an_echo_meets_no_fault(
        self, open_bus: OpenBus, clock: Clock, watch: FramePort, make_faulty: type[FaultyBus]
    ) -> None:
        """Of all that comes in, nothing else is let through."""
        loss = Loss(probability=1.0, **IN)
        bus, host = self.faulty(open_bus, clock, make_faulty, loss)
        drive: FramePort = open_bus().frame_port  # type: ignore[attr-defined]
        drive.transmit(Frame(TPDO))
        for can_id in (SYNC, RPDO):
            host.transmit(Frame(can_id))
        seen = self.take(host, 2, clock)
        assert [(each.can_id, each.own) for each in seen] == [(SYNC, True), (RPDO, True)]
        truth = self.take(watch, 3, clock)
        self.assert_same(seen, [each for each in truth if each.can_id != TPDO])
        assert host.receive(Instant(clock.now() + SILENCE_NS)) is None
        assert bus.counts()["drive_to_host"]["frames"] == 1
        bus.shutdown()
