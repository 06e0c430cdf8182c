"""Readings from TPDOs: what belongs to which SYNC, and values that wrap."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.core.native import LastStatusword
from servobench.drivers.exchange import DemandChange, Readback, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from tests.draws import examples_of
from tests.unit.drivers.fake_bus import FakeBus, make_network

SCALING = Scaling(0.001, 1.0, 1.0, 1000.0, 1.0)
"""A thousandth of a radian, radians per second, newton metres."""
PERIOD = Duration(NS_PER_MS)
TORQUE_MODE = Mode.CYCLIC_SYNCHRONOUS_TORQUE
SPEED, ACTUAL, STATUS, CHANGE = 0x181, 0x281, 0x381, 0x481


class Rig:
    """Frames of a drive's TPDOs into an assembler; a SYNC is really sent in each cycle."""

    def __init__(self, plan: PdoPlan, scaling: Scaling = SCALING) -> None:
        self.bus: FakeBus
        self.network: CanopenNetwork
        self.bus, self.network = make_network()
        self.plan = plan
        self.told = LastStatusword()
        self.assembler = ReadingAssembler(self.network, plan, scaling, PERIOD, self.told, FollowWatch())

    def deliver(self, can_id: int, *fields: int, after_us: int) -> None:
        pdo = next(pdo for pdo in self.plan.tpdos if pdo.cob_id == can_id)
        self.bus.deliver(can_id, pdo.codec().pack(*fields), after_us * NS_PER_US)

    def cycle(self, speed: tuple[int, ...] | None, actual: tuple[int, ...] | None = None) -> list[Reading]:
        """A SYNC, the frame of the speed after 130 us, that of the position after 260 us."""
        self.network.send_sync()
        if speed is not None:
            self.deliver(SPEED, *speed, after_us=130)
        if actual is not None:
            self.deliver(ACTUAL, *actual, after_us=260)
        return self.wait()

    def wait(self) -> list[Reading]:
        self.network.pump(self.network.deadline_after(PERIOD))
        return self.assembler.take()


def rig_of(
    *, stamp: bool = True, coherent: bool = False, demand_changes: bool = False, count: bool = False
) -> Rig:
    wish = PlanWish(features=Features(stamp=stamp, counted=count), coherent=coherent)
    return Rig(mode_plan(1, wish, demand_changes=demand_changes))


@pytest.fixture(params=[True, False], ids=["stamped", "unstamped"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    made = rig_of(stamp=request.param)
    yield made
    made.bus.shutdown()


def speed(rig: Rig, velocity: int, ms: float) -> tuple[int, ...]:
    """The fields of the frame of the speed, sampled ``ms`` after the drive's clock began."""
    stamped = len(rig.plan.tpdos[0].entries) > 1
    return (velocity, round(1000 * ms) % 2**32) if stamped else (velocity,)


def test_a_reading_is_complete_with_the_frame_of_the_speed() -> None:
    rig = rig_of()
    rig.assembler.anchor_position(5000, Instant(7))
    rig.told.take(0x0237, Instant(9))
    (first,) = rig.cycle((3, 1_000_000), (250, 5000, 200))
    assert (first.velocity_rad_s, first.device_time_ns) == (3.0, 10**9)
    assert first.received_at == 130 * NS_PER_US
    assert (first.position_rad, first.position_told_at) == (5.0, 7)
    assert (first.statusword, first.status_told_at) == (0x0237, 9)
    assert math.isnan(first.torque_nm)
    rig.deliver(STATUS, 0x0218, 10, after_us=0)
    (second,) = rig.cycle((3, 1_001_000))
    assert (second.torque_nm, second.torque_told_at) == (250.0, 260 * NS_PER_US)
    assert (second.statusword, second.status_told_at) == (0x0218, 10**6)
    assert second.position_told_at == 260 * NS_PER_US
    rig.bus.shutdown()


def test_a_count_in_the_frame_of_the_speed_is_of_the_same_sync() -> None:
    rig = rig_of(count=True)
    (first,) = rig.cycle((3, 5000), (250, 200))
    assert (first.counted_rad, first.position_told_at) == (5.0, first.received_at)
    rig.cycle(None)
    (second,) = rig.cycle((4, 5007), (250, 200))
    assert second.counted_rad == second.position_rad == pytest.approx(5.007), "carried on by no speed"
    rig.bus.shutdown()


@pytest.mark.parametrize("stamp", [True, False])
def test_a_position_of_another_frame_is_no_count(stamp: bool) -> None:
    rig = rig_of(stamp=stamp)
    rig.cycle(speed(rig, 3, 1000), (250, 5000, 200))
    (second,) = rig.cycle(speed(rig, 3, 1001))
    assert math.isnan(second.counted_rad)
    assert second.position_rad == pytest.approx(5.003)
    rig.bus.shutdown()


@pytest.mark.parametrize("last", [5000, -(2**31), 2**31 - 2])
@pytest.mark.parametrize("further", [0, 7, -7, 2**31 - 1, -(2**31)])
def test_a_raw_position_is_counted_on_from_the_last_one(last: int, further: int) -> None:
    rig = rig_of()
    raw = (last + further + 2**31) % 2**32 - 2**31
    assert rig.assembler.position_rad(raw) == rig.assembler.position_rad(None) == 0.0, "none was told yet"
    rig.assembler.anchor_position(last, Instant(7))
    assert rig.assembler.position_rad(raw) == pytest.approx((last + further) * 0.001, rel=1e-12, abs=1e-9)
    assert rig.assembler.position_rad(None) == pytest.approx(last * 0.001)
    rig.bus.shutdown()


def test_a_stamp_in_another_frame_than_the_speed_is_not_used() -> None:
    plan = mode_plan(1, PlanWish())
    first, second, third = plan.tpdos
    stamp = first.entries[1]
    moved = (
        replace(first, entries=first.entries[:1]),
        replace(second, entries=second.entries[:1]),
        replace(third, entries=(second.entries[1], stamp)),
        replace(third, number=4, cob_id=CHANGE),
    )
    rig = Rig(PdoPlan(moved, plan.rpdos))
    rig.deliver(STATUS, 5000, 777, after_us=50)
    (reading,) = rig.cycle((3,))
    assert reading.device_time_ns is None
    rig.bus.shutdown()


def test_a_lost_frame_takes_nothing_else_with_it(rig: Rig) -> None:
    assert len(rig.cycle(speed(rig, 1, 1), (10, 0, 0))) == 1
    assert rig.cycle(None, (20, 0, 0)) == []
    (third,) = rig.cycle(speed(rig, 3, 3))
    assert (third.velocity_rad_s, third.torque_nm) == (3.0, 20.0)
    assert third.received_at - third.torque_told_at == 870 * NS_PER_US


def test_a_frame_that_comes_twice_makes_two_readings() -> None:
    rig = rig_of()
    rig.network.send_sync()
    for after_us in (130, 300):
        rig.deliver(SPEED, 5, 1000, after_us=after_us)
    first, second = rig.wait()
    assert first.device_time_ns == second.device_time_ns
    assert first.position_rad == second.position_rad
    rig.bus.shutdown()


def test_a_pdo_of_another_length_is_counted_and_ignored(rig: Rig) -> None:
    rig.bus.deliver(SPEED, b"\x27\x02")
    rig.bus.deliver(ACTUAL, b"")
    assert rig.wait() == []
    assert rig.assembler.malformed == 2


@pytest.mark.parametrize("lacking", [0, 1, 2])
def test_a_plan_without_speed_position_or_statusword_is_refused(lacking: int) -> None:
    bus, network = make_network()
    plan = mode_plan(1, PlanWish())
    short = PdoPlan(tuple(pdo for place, pdo in enumerate(plan.tpdos) if place != lacking), plan.rpdos)
    with pytest.raises(ValueError, match=("606Ch", "6064h", "6041h")[lacking]):
        ReadingAssembler(network, short, SCALING, PERIOD, LastStatusword(), FollowWatch())
    bus.shutdown()


# ---- the position ---------------------------------------------------------------------------------------


def test_a_position_is_carried_on_by_the_speed(rig: Rig) -> None:
    """Told with SYNC 1 and SYNC 6; in between by the mean of two speeds, over a lost reading as well."""
    rig.cycle(speed(rig, 100, 1), (0, 5000, 0))
    positions = [
        rig.cycle(None if velocity is None else speed(rig, velocity, ms))
        for ms, velocity in enumerate((100, 200, None, 200), start=2)
    ]
    found = [readings[0].position_rad if readings else None for readings in positions]
    assert found == [pytest.approx(5.1), pytest.approx(5.25), None, pytest.approx(5.65)]
    rig.cycle(speed(rig, 200, 6), (0, 7000, 0))
    (anchored,) = rig.cycle(speed(rig, 200, 7))
    assert anchored.position_rad == pytest.approx(7.2), "each telling anchors it anew"


def test_a_position_whose_speed_was_lost_is_of_its_own_sync(rig: Rig) -> None:
    rig.cycle(speed(rig, 100, 1), (0, 5000, 0))
    rig.cycle(None, (0, 5100, 0))
    (reading,) = rig.cycle(speed(rig, 100, 3))
    assert reading.position_rad == pytest.approx(5.2)


def test_the_drives_clock_tells_how_far_a_position_is_carried() -> None:
    """SYNCs that lag: 1 ms by the host's count, 1.5 ms by the drive's clock."""
    rig = rig_of()
    rig.cycle((100, 1000), (0, 5000, 0))
    (reading,) = rig.cycle((100, 2500))
    assert reading.position_rad == pytest.approx(5.15)
    rig.bus.shutdown()


def test_an_overtaken_reading_carries_nothing_on() -> None:
    rig = rig_of()
    rig.cycle((100, 1000), (0, 5000, 0))
    (newer,) = rig.cycle((100, 3000))
    (older,) = rig.cycle((100, 2000))
    (newest,) = rig.cycle((100, 4000))
    assert [reading.position_rad for reading in (newer, older, newest)] == pytest.approx([5.2, 5.1, 5.3])
    assert older.device_time_ns == 2_000_000
    rig.bus.shutdown()


@pytest.mark.parametrize("step_ms", [1000, -1000])
def test_a_drives_clock_that_is_set_moves_no_position(step_ms: int) -> None:
    rig = rig_of()
    rig.cycle((100, 5_000_000), (0, 5000, 0))
    (stepped,) = rig.cycle((100, 5_001_000 + 1000 * step_ms))
    assert stepped.position_rad == pytest.approx(5.0), "the way of this one cycle is not known"
    (after,) = rig.cycle((100, 5_002_000 + 1000 * step_ms))
    assert after.position_rad == pytest.approx(5.1)
    rig.bus.shutdown()


@pytest.mark.parametrize(("velocity", "torque"), [(-1, 1), (1, -1)])
def test_signs_are_turned_and_the_position_is_carried_on_by_the_turned_velocity(
    velocity: int, torque: int
) -> None:
    rig = Rig(
        mode_plan(1, PlanWish()),
        replace(SCALING, velocity_sign=velocity, torque_sign=torque),
    )
    rig.cycle((velocity * 100, 1000), (200, 5000, 0))
    (reading,) = rig.cycle((velocity * 100, 2000))
    assert reading.velocity_rad_s == 100.0
    assert reading.position_rad == pytest.approx(5.1)
    assert reading.torque_nm == torque * 200.0
    rig.bus.shutdown()


def test_no_error_adds_up_over_the_tellings(rig: Rig) -> None:
    """The speed is told 1 % too high for a thousand cycles, the position with every tenth."""
    for cycle in range(1, 1002):
        every_tenth = (0, 100 * cycle, 0) if cycle % 10 == 0 else None
        readings = rig.cycle(speed(rig, 101, cycle), every_tenth)
    assert readings[0].position_rad == pytest.approx(100.1, abs=0.011)


@pytest.mark.parametrize("lost", [False, True])
def test_in_a_coherent_plan_the_position_is_of_the_readings_own_sync(lost: bool) -> None:
    rig = rig_of(coherent=True)
    for sync, position in ((1, 5000), (2, 5100)):
        rig.network.send_sync()
        rig.deliver(SPEED, 0x0237, 10 * sync, position, after_us=130)
        if sync == 1 or not lost:
            rig.deliver(ACTUAL, 100, 1000 * sync, after_us=260)
        readings = rig.wait()
    if lost:
        rig.network.send_sync()
        rig.deliver(ACTUAL, 100, 3000, after_us=260)
        readings = rig.wait()
    (reading,) = readings
    assert reading.position_rad == pytest.approx(5.2 if lost else 5.1)
    assert (reading.torque_nm, reading.statusword) == (20.0, 0x0237)
    rig.bus.shutdown()


@examples_of(50)
@given(st.integers(-(2**31), 2**31 - 1), st.lists(st.integers(-(2**30), 2**30), min_size=1, max_size=20))
def test_position_runs_on_where_its_counter_wraps(start: int, steps: list[int]) -> None:
    rig = rig_of(coherent=True, stamp=False)
    exact = [start]
    for step in steps:
        exact.append(exact[-1] + step)
    found = []
    for position in exact:
        rig.network.send_sync()
        rig.deliver(SPEED, 0, 0, (position + 2**31) % 2**32 - 2**31, after_us=130)
        rig.deliver(ACTUAL, 0, after_us=260)
        found += [reading.position_rad for reading in rig.wait()]
    assert found == [pytest.approx(position * 0.001) for position in exact]
    rig.bus.shutdown()


# ---- the drive's clock ----------------------------------------------------------------------------------


def test_the_drives_clock_runs_on_where_its_counter_wraps() -> None:
    rig = rig_of()
    stamps = (2**32 - 1500, 2**32 - 500, 500, 2**32 - 400, 1500)
    found = [rig.cycle((0, stamp))[0].device_time_ns for stamp in stamps]
    base = (2**32 - 1500) * 1000
    assert found == [base, base + 1_000_000, base + 2_000_000, base + 1_100_000, base + 3_000_000]
    rig.bus.shutdown()


# ---- read-backs -----------------------------------------------------------------------------------------


def test_each_torque_demand_is_a_read_back_of_the_readings_so_far() -> None:
    rig = rig_of()
    rig.cycle((0, 1000), (0, 0, 300))
    rig.cycle(None, (0, 0, -300))
    rig.cycle((0, 3000), (0, 0, -300))
    period = NS_PER_MS
    assert rig.assembler.take_readbacks() == [
        Readback(300, Instant(260 * NS_PER_US), 1),
        Readback(-300, Instant(period + 260 * NS_PER_US), 1),
        Readback(-300, Instant(2 * period + 260 * NS_PER_US), 2),
    ]
    assert rig.assembler.take_readbacks() == []
    rig.bus.shutdown()


def test_a_demand_told_on_change_is_on_the_drives_clock_and_no_read_back() -> None:
    rig = rig_of(demand_changes=True)
    rig.cycle((0, 2**32 - 100))
    rig.deliver(CHANGE, 250, 60, after_us=400)
    rig.wait()
    (change,) = rig.assembler.take_demand_changes()
    at = Instant(1_400 * NS_PER_US)
    assert change == DemandChange(250, (2**32 + 60) * 1000, at), "counted on over the wrap"
    assert rig.assembler.take_demand_changes() == []
    assert rig.assembler.take_readbacks() == []
    rig.bus.shutdown()
