"""What a fault plan does to a simulated segment and to the drives on it, seen from the host's end."""

from typing import Any, Final

import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.frame_port import ERROR_FLAG
from servobench.hil.configuration.config import BusSegment
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.bus_off import BusOff
from servobench.virtual_bus.faults.kinds.corruption import Corruption
from servobench.virtual_bus.faults.kinds.loss import Loss
from tests.motors import LING

ASK: Final = bytes.fromhex("4000100000000000")
"""Upload of 1000h: every node has it."""


def plan_of(faults: FaultPlan | None, **more: Any) -> WorldPlan:
    return WorldPlan(parse_bus_spec("simulated"), 1_000_000, faults=faults, seed=3, **more)


def wait(world: World, span: int) -> list[int]:
    """What comes within a time."""
    until, came = Instant(world.clock.now() + span), []
    while world.link.fetch(until):
        came.append(world.link.last_id)
    return came


def answers(world: World, node: int = 1) -> bool:
    world.link.send(0x600 + node, ASK)
    return 0x580 + node in wait(world, NS_PER_MS)


def test_error_frames_are_counted_and_shown_to_taps_as_they_come() -> None:
    shown: list[tuple[str, int, bytes, bool, bool, Instant]] = []
    plan = FaultPlan((Corruption(probability=1.0, frames=("sync",)),))
    with open_world(plan_of(plan), []) as world:
        world.tap_errors(lambda *frame: shown.append(frame))
        world.link.send(0x080, b"")
        assert wait(world, NS_PER_MS) == [0x080], "nothing is struck before the start"
        world.faults.start(world.clock.now())
        began = world.clock.now()
        world.link.send(0x080, b"")
        assert wait(world, 200_000) == []
        errors = world.error_frames()
        assert errors > 1, "it is sent again and again"
        assert len(shown) == errors
        assert {(way, extended, remote) for way, _, _, extended, remote, _ in shown} == {("rx", True, False)}
        assert all(can_id & ERROR_FLAG and len(data) == 8 for _, can_id, data, _, _, _ in shown)
        instants = [at for *_, at in shown]
        assert instants == sorted(set(instants))
        assert began < instants[0] < instants[-1] <= began + 200_000
        world.faults.stop()
        assert 0x080 in wait(world, NS_PER_MS)


def test_a_drive_goes_off_the_bus_and_comes_back_at_its_instants() -> None:
    """2 ms after the start, for 3 ms; the drive itself would not act as soon. The other one acknowledges."""
    fault = BusOff(nodes=(1,), at_s=0.002, recover_after_s=0.003)
    drives = [SimulatedServo(1, LING), SimulatedServo(2, LING)]
    with open_world(plan_of(FaultPlan(node_faults=(fault,))), drives) as world:
        wait(world, NS_PER_MS)
        world.faults.start(world.clock.now())
        assert answers(world)
        wait(world, 1_500_000)
        assert not answers(world), "2.5 to 3.5 ms after the start"
        assert answers(world, 2)
        wait(world, 2 * NS_PER_MS)
        assert answers(world), "6.5 ms after the start"


def test_each_segment_has_its_drives_and_is_struck_by_chances_of_its_own() -> None:
    plan = plan_of(
        FaultPlan((Loss(side="host", probability=0.5, direction="host_to_drive", frames=("sdo",)),)),
        segments=(BusSegment(name="second"),),
        segment_of={2: "second"},
    )
    drives = [SimulatedServo(1, LING), SimulatedServo(2, LING)]
    with open_world(plan, drives) as world:
        (second,) = world.further
        world.wait(Instant(NS_PER_MS))
        for link in (world.link, second.link):
            while link.fetch(world.clock.now()):
                pass
        world.faults.start(world.clock.now())
        answered: dict[int, list[bool]] = {1: [], 2: []}
        for _ in range(32):
            for node, link in ((1, world.link), (2, second.link)):
                link.send(0x600 + node, ASK)
                until, came = Instant(world.clock.now() + NS_PER_MS), set[int]()
                while link.fetch(until):
                    came.add(link.last_id)
                answered[node].append(0x580 + node in came)
        assert answered[1] != answered[2]
        assert all(8 < answers.count(True) < 24 for answers in answered.values())


@pytest.mark.parametrize("span", [1, 10])
def test_time_passes_to_where_a_frame_comes_or_to_the_end(span: int) -> None:
    with open_world(plan_of(None, segments=(BusSegment(name="second"),)), [SimulatedServo(1, LING)]) as world:
        end = Instant(world.clock.now() + Duration(span * NS_PER_MS))
        world.wait(end)
        boot_up_at = world.clock.now()
        assert 0 < boot_up_at < end
        assert world.link.fetch(boot_up_at)
        assert world.link.last_id == 0x701
        world.wait(end)
        assert world.clock.now() == end
