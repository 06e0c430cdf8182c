"""What a world makes of a fault plan: whom it tells of what, and what it refuses."""

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.world import WorldPlan, check_time, open_world
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.frame_fault import Side
from servobench.virtual_bus.faults.kinds.host_stall import HostStall
from servobench.virtual_bus.faults.kinds.loss import Loss
from tests.motors import LING

STALL = HostStall(at_s=1e-9 * NS_PER_MS, late_min_us=500_000 / 1000, late_max_us=500_000 / 1000)


def plan_of(faults: FaultPlan, bus: str, side: Side = "host") -> WorldPlan:
    return WorldPlan(parse_bus_spec(bus), 1_000_000, False, faults, 1, side=side)


def lost_at(side: Side) -> FaultPlan:
    return FaultPlan((Loss(side=side, probability=1.0),))


def test_the_host_is_told_for_how_long_it_stalls() -> None:
    with open_world(plan_of(FaultPlan(host_stalls=(STALL,)), "simulated"), ()) as world:
        host_stall = world.faults.host_stall
        assert host_stall is not None
        world.faults.start(Instant(5 * NS_PER_MS))
        ticks = [Instant(n * NS_PER_MS) for n in (5, 6, 7)]
        assert [host_stall(now) for now in ticks] == [0, 500_000, 0]
        world.faults.stop()
        assert host_stall(Instant(8 * NS_PER_MS)) == 0


@pytest.mark.parametrize(
    ("bus", "time", "paced"),
    [
        ("simulated", None, False),
        ("simulated", "simulated", False),
        ("simulated", "real", True),
        ("hub:x", None, False),
        ("hub:x", "real", False),
    ],
)
def test_a_simulated_bus_alone_is_paced(bus: str, time: str | None, paced: bool) -> None:
    assert check_time(parse_bus_spec(bus), time) is paced


def test_time_cannot_be_simulated_on_a_bus_that_others_share() -> None:
    with pytest.raises(BadInput, match="--time") as told:
        check_time(parse_bus_spec("hub:x"), "simulated")
    assert "'real' on the bus 'hub:x'" in str(told.value)


def test_where_no_host_stalls_nothing_is_asked() -> None:
    with open_world(plan_of(lost_at("host"), "simulated"), ()) as world:
        assert world.faults.host_stall is None


@pytest.mark.parametrize("side", ["host", "drive"])
def test_frames_are_lost_on_the_side_that_is_named(side: Side) -> None:
    """A TPDO that is lost at the host was on the bus; one that is lost at the drive was not."""
    drive = SimulatedServo(1, LING)
    with open_world(plan_of(lost_at(side), "simulated"), [drive]) as world:
        world.link.send(0x000, b"\x01\x00")
        while world.link.fetch(Instant(world.clock.now() + NS_PER_MS)):
            pass
        world.faults.start(world.clock.now())
        since = world.clock.now()
        world.link.send(0x080, b"")
        heard = []
        while world.link.fetch(Instant(since + NS_PER_MS)):
            heard.append(world.link.last_id)
        assert [can_id for can_id in heard if can_id != 0x080] == []
        sync_alone = world.load_percent(since, Instant(since + NS_PER_MS)) < 10.0
        assert sync_alone == (side == "drive")


@pytest.mark.parametrize(
    ("faults", "side", "key"),
    [
        (lost_at("drive"), "host", "loss.side"),
        (lost_at("host"), "drive", "loss.side"),
        (FaultPlan(host_stalls=(STALL,)), "host", "host_stall"),
        (FaultPlan(host_stalls=(STALL,)), "drive", "host_stall"),
    ],
)
def test_what_cannot_act_on_a_real_time_bus_is_refused_before_it_is_opened(
    faults: FaultPlan, side: Side, key: str
) -> None:
    with pytest.raises(BadInput) as caught, open_world(plan_of(faults, "socketcan:none", side), ()):
        pass
    assert (caught.value.key, caught.value.value) == (key, "the bus socketcan:none")
