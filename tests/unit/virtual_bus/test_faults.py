"""The fates that a plan deals out: their statistics, their independence, their order."""

import itertools
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from servobench.drivers.timebase import Duration, Instant
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fates import Route
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.frame_fault import COB_IDS, FrameFault
from servobench.virtual_bus.faults.kinds.blackout import Blackout
from servobench.virtual_bus.faults.kinds.burst import Burst
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.periodic_loss import PeriodicLoss
from tests.draws import examples_of
from tests.fates import DROPPED, PASSED, FrameFate, fate_of, keys

OUT, IN = Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST
TPDO1, TPDO2, RPDO1, SYNC = 0x181, 0x281, 0x201, 0x080
MS = 1_000_000
ANY_FRAME = ("all",)


def started(*faults: FrameFault, seed: int = 7) -> FaultInjector:
    injector = FaultInjector(FaultPlan(faults), seed)
    injector.start(Instant(0))
    return injector


def fates(
    injector: FaultInjector, count: int, can_id: int = TPDO1, direction: Direction = IN, period: int = MS
) -> list[FrameFate]:
    return [fate_of(injector, direction, can_id, Instant(k * period)) for k in range(count)]


def losses(*args: FrameFault, count: int, seed: int = 7) -> list[bool]:
    return [fate.dropped for fate in fates(started(*args, seed=seed), count)]


def runs(flags: Sequence[bool]) -> Iterator[int]:
    return (len(list(group)) for lost, group in itertools.groupby(flags) if lost)


def uniform(least: int, most: int, reorder: bool = False) -> Delay:
    return Delay(delay_min_us=least / 1000, delay_max_us=most / 1000, reorder=reorder)


def test_every_frame_passes_before_start_and_after_stop() -> None:
    injector = FaultInjector(FaultPlan((Loss(probability=1.0),)), 1)
    assert fate_of(injector, IN, TPDO1, Instant(5)) == PASSED
    injector.start(Instant(10))
    assert fate_of(injector, IN, TPDO1, Instant(15)) == DROPPED
    injector.stop()
    assert fate_of(injector, IN, TPDO1, Instant(20)) == PASSED
    assert injector.counts()["drive_to_host"] == {"frames": 1, "loss": 1, "delayed": 0}


@pytest.mark.parametrize("probability", [0.0, 0.02, 0.3, 1.0])
def test_independent_loss_has_its_rate(probability: float) -> None:
    count = 50_000
    lost = sum(losses(Loss(probability=probability), count=count))
    assert stats.binomtest(lost, count, probability).pvalue > 0.01


def test_independent_loss_does_not_depend_on_the_frame_before() -> None:
    flags = losses(Loss(probability=0.3), count=40_000)
    table = [[0, 0], [0, 0]]
    for before, after in itertools.pairwise(flags):
        table[before][after] += 1
    assert stats.chi2_contingency(table).pvalue > 0.01


def test_bursts_have_a_geometric_length_and_their_long_run_rate() -> None:
    fault = Burst(p_good_to_bad=0.02, p_bad_to_good=0.25)
    flags = losses(fault, count=200_000)
    lengths = list(runs(flags))
    longest = 15
    seen = [sum(length == k for length in lengths) for k in range(1, longest)]
    seen.append(sum(length >= longest for length in lengths))
    share = [stats.geom.pmf(k, 0.25) for k in range(1, longest)] + [stats.geom.sf(longest - 1, 0.25)]
    assert stats.chisquare(seen, [len(lengths) * part for part in share]).pvalue > 0.01
    assert sum(flags) / len(flags) == pytest.approx(0.02 / 0.27, rel=0.05)


def test_a_burst_loses_by_the_state_that_the_chain_is_in() -> None:
    fault = Burst(p_good_to_bad=0.1, p_bad_to_good=0.4, loss_bad=0.5, loss_good=0.05)
    count = 100_000
    expected = 0.2 * 0.5 + 0.8 * 0.05
    assert sum(losses(fault, count=count)) / count == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_periodic_loss_passes_the_first_of_every_period_of_each_cob_id(lost: int) -> None:
    injector = started(PeriodicLoss(lost=lost))
    passed = [
        (cycle, can_id)
        for cycle in range(30)
        for can_id in (TPDO1, TPDO2)
        if not fate_of(injector, IN, can_id, Instant(cycle * MS)).dropped
    ]
    assert passed == [(cycle, can_id) for cycle in range(0, 30, lost + 1) for can_id in (TPDO1, TPDO2)]


def test_a_blackout_loses_all_of_its_window_and_nothing_else() -> None:
    window = keys(from_s=1e-9 * (20 * MS), until_s=1e-9 * (40 * MS))
    flags = losses(Blackout(**window), count=60)
    assert flags == [20 <= k < 40 for k in range(60)]


def test_a_blackout_by_count_loses_that_many_of_each_cob_id() -> None:
    injector = started(Blackout(from_s=1e-9 * (3 * MS), count=4))
    expected = [3 <= k < 7 for k in range(12)]
    assert [fate.dropped for fate in fates(injector, 12, TPDO1)] == expected
    assert [fate.dropped for fate in fates(injector, 12, TPDO2)] == expected


def test_a_fixed_delay_is_the_same_for_every_frame() -> None:
    assert {fate.delay_ns for fate in fates(started(uniform(300_000, 300_000)), 100)} == {300_000}


def test_a_drawn_delay_is_uniform_over_its_range() -> None:
    drawn = [fate.delay_ns for fate in fates(started(uniform(100_000, 400_000)), 20_000)]
    assert min(drawn) >= 100_000
    assert max(drawn) <= 400_000
    assert stats.kstest(drawn, "uniform", args=(100_000, 300_000)).pvalue > 0.01


def test_both_ends_of_a_delay_are_drawn() -> None:
    assert {fate.delay_ns for fate in fates(started(uniform(3, 5)), 200)} == {3, 4, 5}


def test_delays_add_up() -> None:
    both = started(uniform(100, 100), uniform(20, 20))
    assert fate_of(both, IN, TPDO1, Instant(0)) == FrameFate(False, Duration(120))


@examples_of(100)
@given(
    gaps=st.lists(st.integers(0, 2_000), min_size=1, max_size=60),
    most=st.integers(1, 5_000),
    seed=st.integers(0, 2**64),
)
def test_frames_of_a_link_keep_their_order_and_are_never_early(gaps: list[int], most: int, seed: int) -> None:
    injector = started(uniform(0, most), seed=seed)
    arrivals = list(itertools.accumulate(gaps))
    cob_ids = itertools.cycle((TPDO1, TPDO2))
    delays = [
        fate_of(injector, IN, can_id, Instant(at)).delay_ns
        for at, can_id in zip(arrivals, cob_ids, strict=False)
    ]
    releases = [at + delay for at, delay in zip(arrivals, delays, strict=True)]
    assert releases == sorted(releases)
    assert all(0 <= delay <= most for delay in delays)


def test_with_reorder_a_frame_may_overtake() -> None:
    drawn = fates(started(uniform(0, 10 * MS, reorder=True)), 200)
    releases = [k * MS + fate.delay_ns for k, fate in enumerate(drawn)]
    assert releases != sorted(releases)


def test_a_frame_after_the_window_still_waits_for_the_one_in_front() -> None:
    selection = keys(until_s=1e-9 * 10)
    injector = started(Delay(**selection, delay_min_us=100 / 1000, delay_max_us=100 / 1000))
    assert fate_of(injector, IN, TPDO1, Instant(9)).delay_ns == 100
    assert fate_of(injector, IN, TPDO1, Instant(50)).delay_ns == 59
    assert fate_of(injector, IN, TPDO1, Instant(200)) == PASSED


def test_what_a_fault_does_not_select_passes_untouched() -> None:
    injector = started(Loss(probability=1.0, direction="drive_to_host", nodes=(1,)), uniform(50, 50))
    assert fate_of(injector, IN, TPDO1, Instant(0)) == DROPPED
    assert fate_of(injector, OUT, RPDO1, Instant(0)).delay_ns == 50
    assert fate_of(injector, IN, TPDO1 + 1, Instant(0)).delay_ns == 50
    assert fate_of(injector, OUT, SYNC, Instant(0)) == PASSED
    assert fate_of(injector, IN, TPDO1, Instant(0), extended=True) == PASSED


@pytest.mark.parametrize(
    ("can_id", "frames"),
    [
        (0x000, "nmt"),
        (0x080, "sync"),
        (0x081, "emcy"),
        (0x0FF, "emcy"),
        (0x100, "time"),
        (0x181, "pdo"),
        (0x57F, "pdo"),
        (0x581, "sdo"),
        (0x67F, "sdo"),
        (0x701, "heartbeat"),
        (0x77F, "heartbeat"),
        (0x7E5, "lss"),
    ],
)
def test_each_cob_id_is_of_one_class(can_id: int, frames: str) -> None:
    """CiA 301 7.3.5, the pre-defined connection set."""
    selecting = [item for item in COB_IDS if Loss(probability=1.0, frames=(item,)).selects(IN, can_id)]
    assert selecting == [frames, "all"]


def test_a_number_selects_one_cob_id_and_above_7ffh_an_extended_one() -> None:
    injector = started(Loss(probability=1.0, frames=(0x181, 0x12345)))
    assert fate_of(injector, IN, 0x181, Instant(0)).dropped
    assert not fate_of(injector, IN, 0x181, Instant(0), extended=True).dropped
    assert fate_of(injector, IN, 0x12345, Instant(0), extended=True).dropped
    assert not fate_of(injector, IN, 0x12346, Instant(0), extended=True).dropped


def interleaved(*faults: FrameFault) -> dict[tuple[Direction, int], list[FrameFate]]:
    """Fates of three COB-IDs of two nodes, both directions, 500 cycles."""
    injector = started(*faults)
    links = ((OUT, RPDO1), (IN, TPDO1), (IN, TPDO1 + 1))
    return {
        key: [fate_of(injector, key[0], key[1], Instant(k * MS)) for k in range(500)]
        for key in sorted(links, key=lambda link: link[1])
    }


def test_a_change_of_the_losses_does_not_shift_the_delays() -> None:
    delay = uniform(0, MS // 2)
    alone = interleaved(delay)
    burst = Burst(p_good_to_bad=0.2, p_bad_to_good=0.3)
    for faults in (
        (Loss(probability=0.5), delay),
        (burst, Loss(probability=0.1), PeriodicLoss(lost=1), delay),
    ):
        for link, expected in alone.items():
            seen = interleaved(*faults)[link]
            survivors = [(a, b) for a, b in zip(expected, seen, strict=True) if not b.dropped]
            assert 0 < len(survivors) < 500
            assert all(a == b for a, b in survivors)


def test_a_window_does_not_shift_the_draws_within_it() -> None:
    late = keys(from_s=1e-9 * (100 * MS))
    whole = losses(Loss(probability=0.5), count=300)
    part = losses(Loss(probability=0.5, **late), count=300)
    assert part[100:] == whole[100:]
    assert not any(part[:100])


def test_traffic_of_another_node_or_direction_does_not_shift_a_link() -> None:
    fault = Loss(probability=0.5, frames=ANY_FRAME)
    alone = [fate.dropped for fate in fates(started(fault), 200)]
    injector = started(fault)
    among_others = []
    for k in range(200):
        fate_of(injector, OUT, TPDO1, Instant(k * MS))
        fate_of(injector, IN, TPDO1 + 1, Instant(k * MS))
        among_others.append(fate_of(injector, IN, TPDO1, Instant(k * MS)).dropped)
    assert among_others == alone


def test_links_seeds_and_faults_of_a_kind_are_independent() -> None:
    fault = Loss(probability=0.5)
    base = losses(fault, count=400)
    assert losses(fault, count=400) == base
    assert losses(fault, count=400, seed=8) != base
    second = FaultInjector(FaultPlan((fault,)), 7, link="second")
    second.start(Instant(0))
    others = [
        [fate.dropped for fate in fates(second, 400)],
        [fate.dropped for fate in fates(started(fault), 400, direction=OUT)],
        [fate.dropped for fate in fates(started(fault), 400, can_id=TPDO1 + 1)],
    ]
    for other in others:
        assert 150 < sum(a != b for a, b in zip(base, other, strict=True)) < 250
    twice = sum(losses(fault, fault, count=4000)) / 4000
    assert twice == pytest.approx(0.75, abs=0.03)


def test_start_begins_every_stream_anew() -> None:
    injector = started(Loss(probability=0.5), uniform(0, 1000))
    first = fates(injector, 100)
    injector.start(Instant(0))
    assert fates(injector, 100) == first
    assert injector.counts()["drive_to_host"]["frames"] == 100


def test_counts_name_the_fault_that_struck_first() -> None:
    injector = started(PeriodicLoss(lost=1), Loss(probability=1.0), uniform(5, 5))
    fates(injector, 10)
    fates(injector, 3, can_id=SYNC, direction=OUT)
    assert injector.counts() == {
        "host_to_drive": {"frames": 3, "periodic_loss": 0, "loss": 0, "delayed": 0},
        "drive_to_host": {"frames": 10, "periodic_loss": 5, "loss": 5, "delayed": 0},
    }


def test_a_flood_of_extended_identifiers_takes_no_memory() -> None:
    routes = []

    class Counted(FaultInjector):
        def route(self, way: int, can_id: int, extended: bool) -> Route:
            routes.append(can_id)
            return super().route(way, can_id, extended)

    injector = Counted(FaultPlan((Loss(probability=0.5, frames=(*ANY_FRAME, 0x12345)),)), 7)
    injector.start(Instant(0))
    for can_id in range(0x12000, 0x13000):
        fate_of(injector, IN, can_id, Instant(0), extended=True)
    assert routes == [0x12000, 0x12345]


PRINT_FATES = """
from servobench.drivers.timebase import Instant
from tests.unit.virtual_bus.test_faults import IN, fates, started, uniform
from servobench.virtual_bus.faults.kinds.burst import Burst
from servobench.virtual_bus.faults.kinds.loss import Loss
from tests.draws import examples_of
burst = Burst(p_good_to_bad=0.1, p_bad_to_good=0.3)
print(fates(started(Loss(probability=0.1), burst, uniform(0, 1000)), 50))
"""


@pytest.mark.long
def test_fates_do_not_depend_on_the_hash_seed() -> None:
    printed = {
        subprocess.run(
            [sys.executable, "-c", PRINT_FATES],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for hash_seed in ("1", "2")
    }
    assert len(printed) == 1
    assert "FrameFate" in printed.pop()


def test_draws_are_those_of_the_recorded_run() -> None:
    """A golden value: recordings must replay on any machine and with any numpy."""
    drawn = [fate.delay_ns for fate in fates(started(uniform(0, 999_999)), 5)]
    assert drawn == [490520, 310255, 616958, 21205, 612863]
