"""Readings from TPDOs: what belongs to which SYNC, and values that wrap."""

from collections.abc import Iterator

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.core.native import LastStatusword
from servobench.drivers.exchange import DemandChange, Readback, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from tests.unit.drivers.fake_bus import FakeBus, make_network

SCALING = Scaling(0.001, 1.0, 1.0, 1000.0, 1.0)
"""A thousandth of a radian, radians per second, newton metres."""
PERIOD = Duration(NS_PER_MS)
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


def test_a_count_in_the_frame_of_the_speed_is_of_the_same_sync() -> None:
    rig = rig_of(count=True)
    (first,) = rig.cycle((3, 5000), (250, 200))
    assert (first.counted_rad, first.position_told_at) == (5.0, first.received_at)
    rig.cycle(None)
    (second,) = rig.cycle((4, 5007), (250, 200))
    assert second.counted_rad == second.position_rad == pytest.approx(5.007), "carried on by no speed"
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


def test_the_drives_clock_tells_how_far_a_position_is_carried() -> None:
    """SYNCs that lag: 1 ms by the host's count, 1.5 ms by the drive's clock."""
    rig = rig_of()
    rig.cycle((100, 1000), (0, 5000, 0))
    (reading,) = rig.cycle((100, 2500))
    assert reading.position_rad == pytest.approx(5.15)
    rig.bus.shutdown()


# ---- the drive's clock ----------------------------------------------------------------------------------


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
