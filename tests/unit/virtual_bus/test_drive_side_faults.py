"""Faults of frames at a drive's own connection, behind the echo: seen by a tap on the segment between."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Instant
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.core.native import HELD_MAX
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_log import FaultLog, entry_line, read_line
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.frame_fault import FrameFault, Side
from servobench.virtual_bus.faults.kinds.blackout import Blackout
from servobench.virtual_bus.faults.kinds.corruption import Corruption
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.reorder import Reorder
from servobench.virtual_bus.faults.kinds.slow_drive import SlowDrive
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.hosting.faulty_device import FaultyDevice
from servobench.virtual_bus.hosting.injection import Faults, Injection, refuse_misplaced
from servobench.virtual_bus.timeline import Timeline
from tests.motors import LING

INTO, OUT = (Direction.HOST_TO_DRIVE,), (Direction.DRIVE_TO_HOST,)
SYNC, TPDO1, TPDO2 = 0x80, 0x181, 0x281
INTERMISSION_NS = 3 * NS_PER_US
"""Behind the SYNC: only a TPDO that is not delayed has to wait for it."""


@dataclass
class Cycle:
    """One SYNC as the tap saw it, and what came of it at node 1."""

    sync_at: int
    stamp: int | None = None
    """1013h in TPDO2, ns."""
    tpdo_at: int | None = None
    """End of the first TPDO1."""
    tpdos: int = 0


@dataclass
class Tapped:
    """What a run showed."""

    cycles: list[Cycle] = field(default_factory=list)
    log: list[str] = field(default_factory=list)
    echoes: list[int] = field(default_factory=list)
    """When the host heard its own SYNCs."""


def at_drive(*directions: Direction, side: Side = "drive", **selection: object) -> dict[str, Any]:
    way = {"direction": directions[0].label} if directions else {}
    return {"side": side, **way, **selection}


def run(
    faults: Faults | Sequence[FrameFault],
    nodes: int = 1,
    cycles: int = 200,
    seed: int = 5,
    period_us: int = 1000,
) -> Tapped:
    """SYNCs at 1 kHz to drives 1 .. ``nodes``, all of them with clocks of 1 us and no offset."""
    plan = faults if isinstance(faults, FaultPlan | RecordedFaults) else FaultPlan(tuple(faults))
    timeline = Timeline()
    segment = CanSegment(timeline)
    seen, log = Tapped(), FaultLog()
    injection = Injection(plan, seed, log, error_frames=True)
    host = SimulatedBus("host", segment=segment, receive_own_messages=True)
    if injection.fates is not None:
        host.frame_port.put_before(injection.fates, Direction.HOST_TO_DRIVE)
    host.port.on_sent = lambda frame, at: seen.echoes.append(at) if frame.can_id == SYNC else None

    def tap(frame: Frame, at: Instant) -> None:
        if frame.can_id == SYNC:
            seen.cycles.append(Cycle(at))
        elif frame.can_id == TPDO1 and seen.cycles:
            seen.cycles[-1].tpdos += 1
            seen.cycles[-1].tpdo_at = seen.cycles[-1].tpdo_at or at
        elif frame.can_id == TPDO2 and seen.cycles:
            seen.cycles[-1].stamp = struct.unpack_from("<I", frame.data, 4)[0] * NS_PER_US

    segment.add_monitor(tap)
    for node in range(1, nodes + 1):
        servo = SimulatedServo(node, LING, DriveParameters(clock_offset_us=0))
        attached = AttachedDevice(injection.wrap(servo), segment, f"node {node}")
        injection.on_start(attached.wake_now)
    host.frame_port.transmit(Frame(0, b"\x01\x00"))
    timeline.run_until(Instant(5 * NS_PER_MS))
    if injection.fates is not None:
        injection.fates.start(timeline.now)
    injection.start(timeline.now)
    for _ in range(cycles):
        host.frame_port.transmit(Frame(SYNC))
        timeline.run_until(Instant(timeline.now + period_us * NS_PER_US))
    seen.log = [entry_line(entry) for entry in log.entries()]
    host.shutdown()
    return seen


def us(*bounds: int, stem: str = "delay") -> dict[str, Any]:
    return {f"{stem}_min_us": bounds[0], f"{stem}_max_us": bounds[-1]}


SYNC_DELAY = Delay(**at_drive(*INTO, frames=("sync",)), **us(200))


def test_a_sync_that_is_delayed_on_its_way_into_the_drive_has_its_echo_in_time() -> None:
    plain, delayed = run([]), run([SYNC_DELAY])
    assert delayed.echoes == plain.echoes
    assert [cycle.sync_at for cycle in delayed.cycles] == delayed.echoes
    for cycle in delayed.cycles:
        assert cycle.stamp is not None
        assert 0 <= cycle.sync_at + 200 * NS_PER_US - cycle.stamp < NS_PER_US


def test_the_same_delay_at_the_host_moves_the_echo_too() -> None:
    host_side = SYNC_DELAY.model_copy(update={"side": "host"})
    unnamed = SYNC_DELAY.model_copy(update={"side": None})
    plain, delayed = run([]), run([host_side])
    moved = [after - before for before, after in zip(plain.echoes, delayed.echoes, strict=True)]
    assert moved == [200 * NS_PER_US] * 200
    assert run([unnamed]).echoes == delayed.echoes


def test_a_tpdo_that_is_delayed_on_its_way_out_was_sampled_in_time() -> None:
    delay = Delay(**at_drive(*OUT), **us(300))
    plain, delayed = run([]), run([delay])
    for before, after in zip(plain.cycles, delayed.cycles, strict=True):
        assert after.stamp == before.stamp
        assert after.tpdo_at is not None
        assert before.tpdo_at is not None
        assert after.tpdo_at - before.tpdo_at == 300 * NS_PER_US - INTERMISSION_NS


def test_what_is_lost_behind_the_bus_was_on_it() -> None:
    lost = Blackout(**at_drive(*INTO, frames=("sync",)), count=3)
    seen = run([lost])
    assert [cycle.tpdos for cycle in seen.cycles] == [0, 0, 0, *[1] * 197]
    assert len(seen.echoes) == 200
    assert seen.log[0] == (
        '{"kind":"blackout","at_ns":48000,"direction":"host_to_drive","side":"drive","node":1,"can_id":128,"n":0}'
    )


def test_each_drive_has_a_gateway_of_its_own() -> None:
    """SYNCs are lost to one drive and heard by the other, by the nodes of the table."""
    lost = Loss(**at_drive(*INTO, frames=("sync",), nodes=(1,)), probability=1.0)
    assert {cycle.tpdos for cycle in run([lost], nodes=2).cycles} == {0}
    other = lost.model_copy(update={"nodes": (2,)})
    assert {cycle.tpdos for cycle in run([other], nodes=2).cycles} == {1}
    everywhere = Loss(**at_drive(*INTO, frames=("sync",)), probability=0.5)
    log = run([everywhere], nodes=2).log
    struck = [[line for line in log if f'"node":{node}' in line] for node in (1, 2)]
    assert all(60 < len(lines) < 140 for lines in struck)
    assert [line.replace('"node":2', '"node":1') for line in struck[1]] != struck[0]


def test_frames_of_other_drives_do_not_come_to_a_drives_gateway() -> None:
    seen = run([Delay(**at_drive(), **us(50))], nodes=2, cycles=3)
    assert seen.log
    for entry in (read_line(line, "f", 1) for line in seen.log):
        assert entry.can_id & 0x7F == entry.at_drive


def test_sides_do_not_disturb_each_others_streams() -> None:
    loss = Loss(**at_drive(*OUT, side="host"), probability=0.2)
    behind = Loss(**at_drive(*OUT), probability=0.2)
    both = run([behind, loss]).log
    alone = [run([fault]).log for fault in (loss, behind)]
    assert [line for line in both if '"side"' in line] == alone[1]
    first = [line for line in both if '"side"' not in line]
    assert first
    assert first != [line.replace('"side":"drive","node":1,', "") for line in alone[1]]
    more = run([Delay(**at_drive(*OUT), **us(0, 100)), behind]).log
    assert [line for line in more if '"loss"' in line] == alone[1]


def test_damaged_doubled_and_overtaken_frames_behind_the_bus() -> None:
    sync = at_drive(*INTO, frames=("sync",))
    doubled = run([Duplicate(**sync, probability=1.0, later_us=(100 * NS_PER_US) / 1000)])
    assert {cycle.tpdos for cycle in doubled.cycles} == {2}
    late = run([Reorder(**at_drive(*OUT, frames=(TPDO1,)), probability=1.0, **us(400, stem="held"))])
    plain = run([])
    for before, after in zip(plain.cycles, late.cycles, strict=True):
        assert (after.tpdo_at or 0) - (before.tpdo_at or 0) == 400 * NS_PER_US - INTERMISSION_NS
    damaged = run([Corruption(**at_drive(*OUT), probability=1.0, effect="data")])
    assert [cycle.stamp for cycle in damaged.cycles] != [cycle.stamp for cycle in plain.cycles]


def test_an_error_frame_has_no_side() -> None:
    with pytest.raises(BadInput, match="every node"):
        Corruption(**at_drive(), probability=0.1)


EVERYTHING: tuple[FrameFault, ...] = (
    Loss(**at_drive(), probability=0.05),
    Loss(**at_drive(side="host"), probability=0.05),
    Delay(**at_drive(*INTO, frames=("sync",)), **us(0, 300)),
    Delay(**at_drive(*OUT), **us(10, 200)),
    Delay(**at_drive(*OUT, side="host"), **us(10, 200)),
    Reorder(**at_drive(*OUT), probability=0.05, **us(700, stem="held")),
    Duplicate(**at_drive(), probability=0.05, later_us=(90 * NS_PER_US) / 1000),
    Corruption(**at_drive(), probability=0.05, effect="data"),
)


def test_a_replay_of_both_sides_gives_the_same_traffic() -> None:
    plan = FaultPlan(EVERYTHING, (SlowDrive(tpdo_delay_min_us=0 / 1000, tpdo_delay_max_us=80_000 / 1000),))
    first = run(plan, nodes=2)
    recorded = RecordedFaults(tuple(read_line(line, "f", n) for n, line in enumerate(first.log, start=1)))
    again = run(recorded, nodes=2, seed=77)
    assert again.cycles == first.cycles
    assert again.log == first.log
    sides = [('"side"' in line, line.split('"')[3]) for line in first.log]
    assert {(True, "delay"), (False, "delay"), (True, "corruption"), (True, "reorder")} <= set(sides)


def test_no_more_is_held_than_there_is_room_for() -> None:
    delay = Delay(**at_drive(*OUT, frames=("all",)), **us(9_000_000))
    injection = Injection(FaultPlan((delay,)), 1)
    gateway = injection.wrap(SimulatedServo(1, LING))
    assert isinstance(gateway, FaultyDevice)
    gateway.start(Instant(0))
    injection.start(Instant(0))
    gateway.receive(Frame(0, b"\x01\x00"), Instant(1))
    for n in range(HELD_MAX):
        assert gateway.receive(Frame(SYNC), Instant(n + 2)) == []
    assert gateway.held.overflow == HELD_MAX, "two TPDOs a SYNC"
    assert len(gateway.wake(Instant(10 * NS_PER_S))) == HELD_MAX


def test_every_frame_passes_once_the_plan_has_ended() -> None:
    loss = Loss(**at_drive(), probability=1.0)
    injection = Injection(FaultPlan((loss,)), 1)
    gateway = injection.wrap(SimulatedServo(1, LING))
    gateway.start(Instant(0))
    gateway.receive(Frame(0, b"\x01\x00"), Instant(1))
    injection.start(Instant(1))
    assert gateway.receive(Frame(SYNC), Instant(2)) == []
    injection.stop()
    assert [frame.can_id for frame in gateway.receive(Frame(SYNC), Instant(3))] == [TPDO1, TPDO2]


def test_a_drive_to_which_nothing_happens_has_no_gateway() -> None:
    plan = FaultPlan((SYNC_DELAY.model_copy(update={"nodes": (2,)}),))
    servo = SimulatedServo(1, LING)
    assert Injection(plan, 1).wrap(servo) is servo
    assert Injection(FaultPlan((SYNC_DELAY,)), 1, side="drive").wrap(servo) is servo, "the bus has it already"
    assert Injection(FaultPlan((SYNC_DELAY,)), 1).fates is None


@pytest.mark.parametrize(
    ("fault_side", "program", "remedy"),
    [
        ("drive", "host", "give these faults to the drives: hil simulate --faults FILE"),
        ("host", "drive", "give these faults to the bench: hil run"),
        ("host", "host", None),
        ("drive", "drive", None),
        (None, "host", None),
        (None, "drive", None),
    ],
)
def test_on_a_real_time_bus_each_program_takes_the_faults_of_its_side(
    fault_side: Side | None, program: Side, remedy: str | None
) -> None:
    plan = FaultPlan((SYNC_DELAY.model_copy(update={"side": fault_side}),))
    if remedy is None:
        refuse_misplaced(plan, program, "the bus hub:x")
        assert Injection(plan, 1, side=program).fates is not None
        return
    with pytest.raises(BadInput) as caught:
        refuse_misplaced(plan, program, "the bus hub:x")
    assert (caught.value.key, caught.value.remedy) == ("delay.side", remedy)
