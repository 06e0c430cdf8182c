"""Measured delays, duplicates, frames out of order, damage: statistics, streams, and both ways in."""

from itertools import pairwise
from typing import Literal

import can
import pytest
from scipy import stats

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.message import message_of
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.faults.fates import damaged
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.faulty_bus import FaultyBus
from servobench.virtual_bus.faults.frame_fault import FrameFault
from servobench.virtual_bus.faults.kinds.burst import Burst
from servobench.virtual_bus.faults.kinds.corruption import BIT_DRAWS, Corruption
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.measured_delay import MeasuredDelay
from servobench.virtual_bus.faults.kinds.reorder import Reorder
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.fates import DROPPED, PASSED, fate_of, keys
from tests.unit.virtual_bus.test_faults import IN, MS, OUT, TPDO1, fates, started, uniform

FRAME = Frame(TPDO1, bytes(8))
EDGES = tuple(Duration(edge) for edge in (60_000, 80_000, 120_000, 400_000))
COUNTS = (310, 6000, 1240)
TWICE = Duplicate(probability=1.0, later_us=40_000 / 1000)
FLIPPED = Corruption(probability=1.0, effect="data")


def measured(reorder: bool = True) -> MeasuredDelay:
    return MeasuredDelay(edges_us=tuple(edge / 1000 for edge in EDGES), counts=COUNTS, reorder=reorder)


def test_a_measured_delay_has_the_shares_of_its_histogram() -> None:
    drawn = [fate.delay_ns for fate in fates(started(measured()), 20_000)]
    seen = [sum(low <= delay < high for delay in drawn) for low, high in pairwise(EDGES)]
    assert sum(seen) == len(drawn)
    share = [count / sum(COUNTS) for count in COUNTS]
    assert stats.chisquare(seen, [len(drawn) * part for part in share]).pvalue > 0.01


def test_a_measured_delay_is_even_within_a_bar() -> None:
    bar = [
        delay
        for fate in fates(started(measured()), 20_000)
        if EDGES[1] <= (delay := fate.delay_ns) < EDGES[2]
    ]
    assert stats.kstest(bar, "uniform", args=(EDGES[1], EDGES[2] - EDGES[1])).pvalue > 0.01


def test_an_empty_bar_is_never_drawn() -> None:
    edges = tuple(Duration(edge) for edge in (0, 10, 20, 30))
    drawn = {
        fate.delay_ns
        for fate in fates(
            started(MeasuredDelay(edges_us=tuple(edge / 1000 for edge in edges), counts=(1, 0, 1))), 2000
        )
    }
    assert drawn == {*range(10), *range(20, 30)}


def test_measured_delays_keep_the_order_unless_told_otherwise() -> None:
    for reorder in (False, True):
        drawn = fates(started(measured(reorder)), 500, period=20_000)
        releases = [k * 20_000 + fate.delay_ns for k, fate in enumerate(drawn)]
        assert (releases == sorted(releases)) is not reorder


@pytest.mark.parametrize(
    "fault",
    [
        Duplicate(probability=0.03),
        Corruption(probability=0.03, effect="data"),
        Corruption(probability=0.03, effect="lost"),
        Corruption(probability=0.03),
        Reorder(probability=0.03, held_min_us=5 / 1000, held_max_us=9 / 1000),
    ],
)
def test_each_strikes_with_its_probability(fault: FrameFault) -> None:
    injector = started(fault)
    count = 30_000
    fates(injector, count)
    struck = injector.counts()["drive_to_host"][fault.kind]
    low, high = stats.binomtest(struck, count, 0.03).proportion_ci(0.99)
    assert low < 0.03 < high


def test_a_duplicate_comes_after_the_first_with_the_same_data() -> None:
    injector = started(TWICE, uniform(100, 100))
    assert fate_of(injector, IN, TPDO1, Instant(0)) == DROPPED
    assert injector.replacements(FRAME) == [(FRAME, 100), (FRAME, 40_100)]


def test_damage_inverts_one_bit_and_every_bit_as_often() -> None:
    injector = started(FLIPPED)
    seen = [0] * 24
    for k in range(12_000):
        assert fate_of(injector, IN, TPDO1, Instant(k * MS)).dropped
        ((frame, delay),) = injector.replacements(Frame(TPDO1, bytes(3)))
        value = int.from_bytes(frame.data, "little")
        assert delay == 0
        assert value.bit_count() == 1
        seen[value.bit_length() - 1] += 1
    assert stats.chisquare(seen).pvalue > 0.01


def test_each_length_divides_the_draws_of_a_bit_evenly() -> None:
    assert all(BIT_DRAWS % (8 * length) == 0 for length in range(1, 9))
    assert damaged(Frame(0x80), 5) == Frame(0x80)


@pytest.mark.parametrize("effect", ["lost", "error_frame"])
def test_a_corrupted_frame_is_lost_where_the_bus_has_no_error_frames(
    effect: Literal["lost", "data", "error_frame"],
) -> None:
    injector = started(Corruption(probability=1.0, effect=effect))
    assert fate_of(injector, IN, TPDO1, Instant(0)) == DROPPED
    assert not injector.replacements(FRAME)


def test_error_frames_are_left_to_a_bus_that_has_them() -> None:
    injector = FaultInjector(FaultPlan((Corruption(probability=1.0),)), 1, error_frames=True)
    injector.start(Instant(0))
    assert fate_of(injector, IN, TPDO1, Instant(0)) == PASSED


def test_a_frame_held_out_of_order_is_overtaken_by_those_behind_it() -> None:
    injector = started(
        Reorder(probability=0.5, held_min_us=(3 * MS) / 1000, held_max_us=(3 * MS) / 1000), uniform(0, 9)
    )
    releases = [k * MS + fate.delay_ns for k, fate in enumerate(fates(injector, 200))]
    held = [k for k, release in enumerate(releases) if release >= (k + 3) * MS]
    others = [release for k, release in enumerate(releases) if k not in held]
    assert 70 < len(held) < 130
    assert others == sorted(others)
    assert releases != sorted(releases)


def test_a_loss_takes_the_frame_whatever_else_struck_it() -> None:
    injector = started(TWICE, FLIPPED, Loss(probability=1.0))
    assert fate_of(injector, IN, TPDO1, Instant(0)) == DROPPED
    assert not injector.replacements(FRAME)
    counted = injector.counts()["drive_to_host"]
    assert (counted["loss"], counted["duplicate"], counted["corruption"]) == (1, 0, 0)


def test_what_a_frame_became_says_nothing_of_the_next() -> None:
    injector = started(Duplicate(probability=0.5), Loss(probability=0.5))
    lost = 0
    for k in range(200):
        fate = fate_of(injector, IN, TPDO1, Instant(k * MS))
        copies = injector.replacements(FRAME) if fate.dropped else None
        assert copies is None or len(copies) in (0, 2)
        if (lost_now := injector.counts()["drive_to_host"]["loss"]) > lost:
            assert not copies
        lost = lost_now


ONE_OF_EACH: tuple[FrameFault, ...] = (
    Loss(probability=0.1),
    Burst(p_good_to_bad=0.05, p_bad_to_good=0.4),
    Corruption(probability=0.1, effect="data"),
    Duplicate(probability=0.1),
    Reorder(probability=0.1, held_min_us=10 / 1000, held_max_us=1000 / 1000),
    uniform(0, 5000, reorder=True),
    measured(),
)


@pytest.mark.parametrize("other", ONE_OF_EACH, ids=lambda fault: fault.kind)
def test_adding_one_kind_shifts_the_draws_of_no_other(other: FrameFault) -> None:
    """The others draw for the same frames, in a window that never opens."""
    never = keys(from_s=1e-9 * (10**15))
    others = [fault.model_copy(update=never) for fault in ONE_OF_EACH if fault is not other]
    alone = fates(started(other), 300)
    assert set(alone) != {PASSED}
    assert fates(started(*others[:3], other, *others[3:]), 300) == alone


class TwoEnds:
    """A host behind faults and a plain peer on one segment."""

    def __init__(self, *faults: FrameFault) -> None:
        timeline = Timeline()
        segment = CanSegment(timeline)
        clock = SimulatedClock(timeline)
        self.peer = SimulatedBus("peer", segment=segment)
        self.host = FaultyBus(SimulatedBus("host", segment=segment), started(*faults), clock, "host")
        self.host.start(clock.now())


def received(bus: can.BusABC, timeout: float) -> list[bytes]:
    found = []
    while (message := bus.recv(timeout)) is not None:
        found.append(bytes(message.data))
    return found


@pytest.mark.parametrize("fault", [TWICE, FLIPPED], ids=lambda fault: fault.kind)
def test_new_fates_act_at_the_port_of_a_simulated_bus_both_ways(fault: FrameFault) -> None:
    ends = TwoEnds(fault)
    ends.host.send(message_of(Frame(0x201, b"\x00\x00"), Instant(0)))
    ends.peer.send(message_of(Frame(0x181, b"\x00\x00"), Instant(0)))
    for data in (received(ends.peer, 0.01), received(ends.host, 0.01)):
        _check(fault, data)


@pytest.mark.parametrize("fault", [TWICE, FLIPPED], ids=lambda fault: fault.kind)
def test_new_fates_act_on_a_real_time_bus_both_ways(fault: FrameFault) -> None:
    timeline = Timeline()
    clock = SimulatedClock(timeline)
    channel = f"special-{fault.kind}"
    with (
        can.Bus(interface="virtual", channel=channel) as inner,
        can.Bus(interface="virtual", channel=channel) as peer,
    ):
        host = FaultyBus(inner, started(fault), clock, "host")
        host.start(clock.now())
        peer.send(message_of(Frame(0x181, b"\x00\x00"), Instant(0)))
        host.send(message_of(Frame(0x201, b"\x00\x00"), Instant(0)))
        found = []
        for later in (1, 2):
            clock.sleep_until(Instant(later * MS))
            found += received(host, 0.0)
        _check(fault, found)
        _check(fault, received(peer, 0.0))
        host.shutdown()


def _check(fault: FrameFault, data: list[bytes]) -> None:
    if fault is TWICE:
        assert data == [b"\x00\x00"] * 2
    else:
        (only,) = data
        assert int.from_bytes(only).bit_count() == 1


def test_the_unchanged_direction_is_untouched() -> None:
    injector = started(Duplicate(probability=1.0, direction="host_to_drive"))
    assert fate_of(injector, IN, TPDO1, Instant(0)) == PASSED
    assert fate_of(injector, OUT, 0x201, Instant(0)) == DROPPED
