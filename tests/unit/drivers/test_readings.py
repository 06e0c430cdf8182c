"""Readings from TPDOs: which sets are whole, and values that wrap."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.network import CanopenNetwork
from drivers.pdo_plans import torque_plan
from drivers.readings import ReadingAssembler, Seen
from drivers.scaling import Scaling
from drivers.timebase import NS_PER_MS, NS_PER_US, Duration
from tests.unit.drivers.fake_bus import FakeBus, make_network

SCALING = Scaling(1.0, 1.0, 1.0, 1000.0, 1.0)
PERIOD = Duration(NS_PER_MS)


class Rig:
    """TPDOs of chosen SYNCs into an assembler; the velocity tells which SYNC a TPDO1 answers."""

    def __init__(self, *, device_stamp: bool = True) -> None:
        self.bus: FakeBus
        self.network: CanopenNetwork
        self.bus, self.network = make_network()
        self.plan = torque_plan(1, device_stamp=device_stamp)
        self.told = Seen()
        self.assembler = ReadingAssembler(self.network, self.plan, SCALING, PERIOD, self.told)
        self.stamped = device_stamp

    def first(self, sync: int, delay_us: int = 130) -> None:
        data = self.plan.tpdos[0].codec().pack(0x0227, sync, -sync)
        self.bus.deliver(0x181, data, sync * PERIOD + delay_us * NS_PER_US)

    def second(self, sync: int, delay_us: int = 260) -> None:
        fields = (10 * sync, 1000 * sync) if self.stamped else (10 * sync,)
        data = self.plan.tpdos[1].codec().pack(*fields)
        self.bus.deliver(0x281, data, sync * PERIOD + delay_us * NS_PER_US)

    def run(self) -> list[tuple[float, float]]:
        """Velocity and tenth of position of each reading; equal if it is coherent."""
        self.network.pump(self.network.deadline_after(Duration(100 * NS_PER_MS)))
        return [(reading.velocity_rad_s, reading.position_rad / 10) for reading in self.assembler.take()]


@pytest.fixture(params=[True, False], ids=["stamped", "unstamped"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    made = Rig(device_stamp=request.param)
    yield made
    made.bus.shutdown()


def test_whole_sets_become_readings(rig: Rig) -> None:
    for sync in (1, 2, 3):
        rig.first(sync)
        rig.second(sync)
    assert rig.run() == [(1, 1), (2, 2), (3, 3)]
    assert rig.told.statusword == 0x0227
    assert rig.assembler.incomplete == rig.assembler.incoherent == 0


def test_a_lost_first_leaves_no_reading(rig: Rig) -> None:
    rig.first(1)
    rig.second(1)
    rig.second(2)
    rig.first(3)
    rig.second(3)
    assert rig.run() == [(1, 1), (3, 3)]
    assert rig.assembler.incomplete == 1


def test_a_lost_second_leaves_no_reading(rig: Rig) -> None:
    rig.first(1)
    rig.first(2)
    rig.second(2)
    assert rig.run() == [(2, 2)]


def test_a_set_of_two_syncs_is_thrown_away(rig: Rig) -> None:
    rig.first(1)
    rig.second(1)
    rig.first(2)
    rig.second(3)
    rig.first(4)
    rig.second(4)
    assert rig.run() == [(1, 1), (4, 4)]
    assert rig.assembler.incoherent == 1


def test_a_set_after_a_gap_is_taken(rig: Rig) -> None:
    rig.first(1)
    rig.second(1)
    rig.first(20)
    rig.second(20)
    assert rig.run() == [(1, 1), (20, 20)]


def test_frames_far_apart_are_one_set_if_the_drives_clock_says_so() -> None:
    rig = Rig()
    for sync in (1, 2):
        rig.first(sync, 100)
        rig.second(sync, 900)
    assert rig.run() == [(2, 2)], "the first has no earlier stamp to tell by"
    rig.bus.shutdown()


def test_a_pdo_of_another_length_is_counted_and_ignored(rig: Rig) -> None:
    rig.bus.deliver(0x181, b"\x27\x02")
    rig.bus.deliver(0x281, b"")
    assert rig.run() == []
    assert rig.assembler.malformed == 2


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(-(2**31), 2**31 - 1), st.lists(st.integers(-(2**30), 2**30), min_size=1, max_size=20))
def test_position_runs_on_where_its_counter_wraps(start: int, steps: list[int]) -> None:
    rig = Rig(device_stamp=False)
    codec = rig.plan.tpdos[1].codec()
    exact = [start]
    for step in steps:
        exact.append(exact[-1] + step)
    for sync, position in enumerate(exact):
        rig.first(sync)
        wrapped = (position + 2**31) % 2**32 - 2**31
        rig.bus.deliver(0x281, codec.pack(wrapped), sync * PERIOD + 260 * NS_PER_US)
    rig.network.pump(rig.network.deadline_after(Duration(100 * NS_PER_MS)))
    assert [reading.position_rad for reading in rig.assembler.take()] == exact
    rig.bus.shutdown()


def test_the_drives_clock_runs_on_where_its_counter_wraps() -> None:
    rig = Rig()
    codec = rig.plan.tpdos[1].codec()
    for sync, stamp in enumerate((2**32 - 1500, 2**32 - 500, 500, 400)):
        rig.first(sync)
        rig.bus.deliver(0x281, codec.pack(0, stamp), sync * PERIOD + 260 * NS_PER_US)
    rig.network.pump(rig.network.deadline_after(Duration(100 * NS_PER_MS)))
    stamps = [reading.device_time_ns for reading in rig.assembler.take()]
    base = (2**32 - 1500) * 1000
    assert stamps == [base, base + 1_000_000, base + 2_000_000, base + 1_900_000]
    rig.bus.shutdown()


def test_a_plan_without_position_is_refused() -> None:
    bus, network = make_network()
    plan = torque_plan(1, device_stamp=True)
    short = type(plan)(plan.tpdos[:1], plan.rpdos)
    with pytest.raises(ValueError, match="6064h"):
        ReadingAssembler(network, short, SCALING, PERIOD, Seen())
    bus.shutdown()


class SeldomRig:
    """A position every fourth SYNC; each SYNC is really sent, so that the gaps are known."""

    def __init__(self) -> None:
        self.bus, self.network = make_network()
        self.plan = torque_plan(1, device_stamp=True, position_every_cycles=4)
        scaling = Scaling(0.001, 1.0, 1.0, 1000.0, 1.0)
        self.assembler = ReadingAssembler(self.network, self.plan, scaling, PERIOD, Seen())

    def cycle(self, velocity: int | None, position: int | None = None) -> float | None:
        """Position of the reading of this cycle; None if there is none."""
        self.network.send_sync()
        if velocity is not None:
            self.bus.deliver(0x181, self.plan.tpdos[0].codec().pack(0x0227, velocity, 0), 130 * NS_PER_US)
        if position is not None:
            self.bus.deliver(0x281, self.plan.tpdos[1].codec().pack(position), 260 * NS_PER_US)
        self.network.pump(self.network.deadline_after(PERIOD))
        readings = self.assembler.take()
        assert all(reading.device_time_ns is None for reading in readings)
        return readings[0].position_rad if readings else None


def test_a_position_that_comes_seldom_is_carried_along_by_the_speed() -> None:
    rig = SeldomRig()
    rig.assembler.anchor_position(5000)
    assert rig.cycle(100) == pytest.approx(5.1)
    assert rig.cycle(100, position=5200) == pytest.approx(5.2)
    assert rig.cycle(200) == pytest.approx(5.4)
    assert rig.cycle(None) is None
    assert rig.cycle(200) == pytest.approx(5.8), "a lost reading leaves no gap in the way"
    assert rig.cycle(200, position=7000) == pytest.approx(6.0)
    assert rig.cycle(0) == pytest.approx(7.0)
    assert rig.assembler.incomplete == rig.assembler.incoherent == 0
    rig.bus.shutdown()
