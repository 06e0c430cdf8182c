"""The loop at SYNCs that another node makes, against a made-up bus."""

from collections.abc import Iterable
from itertools import accumulate, repeat
from random import Random

import pytest

from servobench.drivers.errors import LimitExceeded, NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.loop import Loop, LoopOutcome
from servobench.hil.loop.pace import CALIBRATION_SPACINGS, PERIOD_ERROR_MAX, HeardSync, Stall
from servobench.hil.loop.safety import TorqueLimits
from servobench.hil.loop.samples import Dropout, DropoutCause, Sample
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TIMING, FakeBus, FakeDrive, make_axis

FIRST_AT = 3 * PERIOD + 123_456
BEFORE = CALIBRATION_SPACINGS + 1
"""SYNCs until the loop is calibrated."""
DELAY = 250_000


class Rig:
    """A loop at the SYNCs of another node that end on the bus at given instants, and what it recorded."""

    def __init__(self, instants: Iterable[int], stall: Stall | None = None, dropouts_max: int = 1000) -> None:
        self.records: list[CycleRecord] = []
        self.drive = FakeDrive(lambda sequence: DELAY)
        self.bus = FakeBus([self.drive])
        self.log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
        limits = TorqueLimits(5.0, 200.0, dropouts_consecutive_max=dropouts_max)
        self.axis = make_axis(self.drive, self.records, limits=limits, syncs=self.log)
        pace = HeardSync(self.bus, self.bus, PERIOD, self.log, stall)
        self.bus.produce(instants, pace.hear)
        self.loop = Loop(self.bus, self.bus, [self.axis], pace, TIMING)

    def run(self, cycles: int) -> LoopOutcome:
        self.loop.calibrate()
        return self.loop.run(Duration(cycles * PERIOD), lambda: False, lambda at: None, lambda done: None)

    def causes(self) -> dict[int, DropoutCause]:
        """By cycle."""
        observations = {record.sequence: record.observation for record in self.records}
        return {cycle: each.cause for cycle, each in observations.items() if isinstance(each, Dropout)}


def steady(count: int, period: int = PERIOD) -> list[int]:
    return list(accumulate(repeat(period, count - 1), initial=FIRST_AT))


def test_every_cycle_starts_with_its_sync_and_no_sync_is_sent() -> None:
    rig = Rig(steady(100))
    outcome = rig.run(40)
    assert (outcome.cycles, outcome.cycles_missed) == (40, 0)
    assert rig.bus.handed_at == []
    assert [record.due_at for record in rig.records] == steady(100)[BEFORE : BEFORE + 40]
    for record in rig.records:
        assert record.sync_handed_at == record.sync_on_bus_at == record.woke_at == record.due_at
        assert isinstance(record.observation, Sample)
        assert record.observation.sampled_at == record.due_at
        assert record.delay == DELAY
        assert record.sending is not None
        assert record.sending.handed_at == record.due_at + DELAY


@pytest.mark.parametrize("drift_ppm", [-1000, 0, 1000])
@pytest.mark.parametrize("jitter_us", [0, 150, 300])
def test_the_grid_follows_the_stamps(drift_ppm: int, jitter_us: int) -> None:
    draw = Random(f"{drift_ppm} {jitter_us}")
    period = PERIOD + PERIOD * drift_ppm // 1_000_000
    instants = [at + draw.randrange(jitter_us * NS_PER_US + 1) for at in steady(2200, period)]
    rig = Rig(instants)
    outcome = rig.run(2000)
    assert (outcome.cycles, outcome.cycles_missed, rig.log.surplus) == (2000, 0, 0)
    assert [record.due_at for record in rig.records] == instants[BEFORE : BEFORE + 2000]
    assert {record.delay for record in rig.records} == {DELAY}


def test_without_a_sync_by_half_a_period_after_it_was_due_the_cycle_is_missed() -> None:
    instants = steady(100)
    gone = instants[BEFORE + 9]
    instants[BEFORE + 19] += PERIOD // 2 - 1
    instants[BEFORE + 29] += PERIOD * 6 // 10
    instants.remove(gone)
    rig = Rig(instants)
    outcome = rig.run(40)
    # What came 0.6 periods late has a cycle of its own; the SYNC 0.4 periods after it has none.
    assert rig.causes() == {10: DropoutCause.MISSED, 30: DropoutCause.MISSED}
    missed = rig.records[9]
    assert (missed.due_at, missed.woke_at, missed.sync_on_bus_at, missed.command) == (gone, None, None, None)
    assert rig.records[30].due_at == instants[BEFORE + 28]
    assert (outcome.cycles_missed, rig.log.surplus, rig.log.crowded) == (2, 1, 1)


def test_of_syncs_that_piled_up_the_newest_starts_a_cycle() -> None:
    calls = iter(range(10**9))
    rig = Rig(steady(100), lambda _now: Duration(3_200_000 if next(calls) == 9 else 0))
    outcome = rig.run(40)
    assert rig.causes() == dict.fromkeys((10, 11, 12), DropoutCause.MISSED)
    assert (outcome.cycles, outcome.cycles_missed) == (40, 3)
    assert [record.due_at for record in rig.records] == steady(100)[BEFORE : BEFORE + 40]
    late = rig.records[12]
    assert late.woke_at is not None
    assert late.woke_at - late.due_at == 200_000
    assert isinstance(late.observation, Sample)
    assert late.observation.sampled_at == late.due_at


def test_a_late_host_is_served_as_long_as_no_newer_sync_has_come() -> None:
    rig = Rig(steady(100), lambda _now: Duration(900_000))
    rig.run(40)
    assert rig.causes() == {}
    assert {record.woke_at - record.due_at for record in rig.records if record.woke_at} == {900_000}


def test_a_second_sync_within_half_a_period_is_surplus_and_starts_nothing() -> None:
    instants = steady(100)
    rig = Rig(sorted([*instants, instants[BEFORE + 9] + 300_000]))
    rig.run(40)
    assert rig.log.surplus == 1
    assert [record.due_at for record in rig.records] == instants[BEFORE : BEFORE + 40]
    assert rig.records[9].sync_on_bus_at == instants[BEFORE + 9]


def test_a_producer_that_stops_ends_the_run_with_dropouts() -> None:
    rig = Rig(steady(BEFORE + 20), dropouts_max=8)
    with pytest.raises(LimitExceeded, match="no usable reading for 9 cycles"):
        rig.run(100)
    assert set(rig.causes()) == set(range(21, 30))


def test_without_any_sync_the_remedy_is_named() -> None:
    with pytest.raises(NoAnswer, match=r"no SYNC was heard within 1\.002 s.*COB-ID 080h"):
        Rig([]).run(10)


@pytest.mark.parametrize("beyond", [-1.1, 1.1])
def test_another_period_is_refused_with_both(beyond: float) -> None:
    period = round(PERIOD * (1.0 + beyond * PERIOD_ERROR_MAX))
    expected = rf"SYNC comes every {period / 1000:.1f} us, and loop\.period_us is 1000"
    with pytest.raises(PeerFault, match=expected):
        Rig(steady(150, period)).run(10)


def test_twice_the_period_and_two_producers_are_refused() -> None:
    with pytest.raises(PeerFault, match=r"every 2000\.0 us"):
        Rig(steady(150, 2 * PERIOD)).run(10)
    both = sorted(at + shift for at in steady(150) for shift in (0, 400_000))
    with pytest.raises(PeerFault, match="only one node may produce SYNC"):
        Rig(both).run(10)


def test_the_period_is_told_with_syncs_lost_and_late() -> None:
    instants = [at for number, at in enumerate(steady(200)) if number not in (5, 6, 20)]
    instants[0] += 400_000
    rig = Rig(instants)
    rig.run(40)
    assert rig.causes() == {}


def test_what_came_before_calibration_and_run_is_no_answer_of_theirs() -> None:
    rig = Rig(steady(200))
    rig.bus.pump(Instant(FIRST_AT + 20 * PERIOD + DELAY - 1))
    rig.loop.calibrate()
    rig.bus.pump(Instant(rig.bus.at + 30 * PERIOD))
    rig.loop.run(Duration(40 * PERIOD), lambda: False, lambda at: None, lambda done: None)
    assert {record.delay for record in rig.records} == {DELAY}
    assert rig.axis.by_stamp.clock.offset_ns is not None
    assert rig.causes() == {}


def test_own_and_foreign_syncs_are_told_apart() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    own = log.handed(1, Instant(0))
    log.stray(Instant(20_000))
    log.came(Instant(50_000))
    assert (own.on_bus_at, log.surplus, log.crowded) == (50_000, 1, 1)
    assert log.last_of(1) is own
