"""A drive under measurement: what it is told, what its axis is made of, and what is kept of its cycles."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish, status_timer_ms
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.frame_port import EchoBasis, FrameTap
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.loop import Actuation, LoopTiming
from servobench.hil.loop.samples import AT_REST
from servobench.hil.loop.scenario import Quantity
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.measuring.subject import Excitation, MeasureRequest, Subject, timing_of
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.hil.cycles import in_cycle

ASKED = MeasureRequest("simulated", (1,), 40, 1000, 1_000_000, enable=True, speed_max_rad_s=20.0, seed=5)
DISABLED = replace(ASKED, enable=False)
NO_ROOM = "no room on the bus for 6074h on change: a longer period, or fewer nodes"


class Told:
    """A drive that notes how it is configured."""

    def __init__(self, drive: ServoDrive) -> None:
        self._drive = drive
        self.settings: list[DriveSettings] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive, name)

    def configure(self, settings: DriveSettings) -> list[str]:
        self.settings.append(settings)
        return self._drive.configure(settings)


class Commands(FrameTap):
    """The data of the frames that command node 1."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        del direction, extended, remote, at
        if can_id == 0x201:
            self.sent.append(data)


class Bench:
    """Subjects on a bus with one simulated drive."""

    def __init__(self, lacks: tuple[str, ...] = ()) -> None:
        servo = SimulatedServo(1, LING, DriveParameters(lacks=lacks), 1)
        self._world = open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 1), [servo])
        world = self._world.__enter__()
        self.clock = world.clock
        self.network = CanopenNetwork(world.link, world.clock, writes=RIG)
        drive = ServoDrive(self.network, 1)
        drive.connect(Instant(world.clock.now() + NS_PER_S))
        self.drive = Told(drive)
        self.unit_nm = drive.objects.read(Object.MOTOR_RATED_TORQUE) / 1e6
        """A step of 6071h, thousandths of 6076h, which is in mN m."""

    def subject(self, asked: MeasureRequest = ASKED) -> Subject:
        return Subject(cast(ServoDrive, self.drive), self.clock, asked)

    def close(self) -> None:
        self.network.fall_silent()
        self._world.__exit__(None, None, None)


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


def test_the_loop_of_a_measurement_is_that_of_a_bench_that_says_nothing() -> None:
    assert timing_of(ASKED) == LoopTiming(
        period=Duration(1_000_000),
        decide_after=Duration(700_000),
        settle=Duration(50 * NS_PER_MS),
        actuation=Actuation.ON_ARRIVAL,
        sync_latency=Duration(48_000),
        command_latency=Duration(84_000),
    )


@pytest.mark.parametrize(
    ("period_us", "settle_ms"), [(250, 50), (4_999, 50), (5_000, 50), (5_001, 50.01), (20_000, 200)]
)
def test_it_settles_for_ten_periods_or_for_50_ms(period_us: int, settle_ms: float) -> None:
    assert timing_of(replace(ASKED, period_us=period_us)).settle == round(settle_ms * NS_PER_MS)
    assert replace(ASKED, period_us=period_us).period == period_us * 1_000


def plan(*, changes: bool, every: int) -> Any:
    wish = PlanWish(
        Mode.CYCLIC_SYNCHRONOUS_TORQUE, position_every_cycles=every, status_timer_ms=status_timer_ms(150)
    )
    return mode_plan(1, wish, demand_changes=changes)


def test_an_enabled_drive_is_watched_closely_and_limited(bench: Bench) -> None:
    subject = bench.subject()
    assert (subject.configured, subject.tells_demand, subject.notes) == (False, False, [])
    subject.configure(changes=True, every=1)
    assert bench.drive.settings == [
        DriveSettings(
            sync_period_ns=Duration(1_000_000),
            plan=plan(changes=True, every=1),
            mode=Mode.CYCLIC_SYNCHRONOUS_TORQUE,
            position_every_cycles=1,
            command_timeout_ms=100,
            drive_heartbeat_ms=50,
            drive_heartbeat_timeout_ms=150,
            host_heartbeat_ms=50,
            host_heartbeat_timeout_ms=150,
            unwatched=False,
            torque_max_nm=30 * bench.unit_nm,
            speed_max_rad_s=20.0,
        )
    ]
    assert (subject.configured, subject.tells_demand) == (True, True)
    assert subject.notes == bench.drive.notes


def test_a_disabled_one_is_watched_as_far_as_it_can_be_and_not_limited(bench: Bench) -> None:
    subject = bench.subject(DISABLED)
    subject.configure(changes=False, every=4)
    assert bench.drive.settings == [
        DriveSettings(
            sync_period_ns=Duration(1_000_000),
            plan=None,
            mode=Mode.CYCLIC_SYNCHRONOUS_TORQUE,
            position_every_cycles=4,
            command_timeout_ms=None,
            drive_heartbeat_ms=50,
            drive_heartbeat_timeout_ms=1000,
            host_heartbeat_ms=50,
            host_heartbeat_timeout_ms=1000,
            unwatched=True,
            torque_max_nm=30 * bench.unit_nm,
            speed_max_rad_s=None,
        )
    ]
    assert NO_ROOM not in subject.notes


def test_each_command_takes_the_voltage_of_a_disabled_drive_away(bench: Bench) -> None:
    """Somebody else may have enabled it: 6040h = 0 travels with each torque."""
    subject = bench.subject(DISABLED)
    subject.configure(changes=False, every=1)
    commands = Commands()
    bench.network.link.tap(commands)
    bench.drive.control.set_point.send_torque(0.0, 1)
    assert [int.from_bytes(data[:2], "little") for data in commands.sent] == [0]


@pytest.mark.parametrize(("period_us", "timeout_ms"), [(9_999, 100), (10_000, 100), (10_100, 101)])
def test_a_command_is_missed_after_ten_cycles_at_least(bench: Bench, period_us: int, timeout_ms: int) -> None:
    bench.subject(replace(ASKED, period_us=period_us)).configure(changes=False, every=1)
    assert bench.drive.settings[-1].command_timeout_ms == timeout_ms


def test_without_room_the_demand_comes_with_the_sync_alone(bench: Bench) -> None:
    subject = bench.subject()
    subject.configure(changes=False, every=1)
    assert [settings.plan for settings in bench.drive.settings] == [None]
    assert subject.notes == [NO_ROOM, *bench.drive.notes]
    assert subject.tells_demand


@pytest.mark.parametrize(
    ("lacks", "plans", "tells", "first"),
    [
        (("tpdo events",), 2, False, "no 6074h on change: "),
        (("6074",), 1, False, ""),
        (("1013",), 1, True, ""),
    ],
)
def test_a_drive_that_cannot_tell_its_demand_on_change_has_the_lesser_plan(
    lacks: tuple[str, ...], plans: int, tells: bool, first: str
) -> None:
    bench = Bench(lacks)
    try:
        subject = bench.subject()
        subject.configure(changes=True, every=1)
        assert [settings.plan is None for settings in bench.drive.settings] == [False, True][-plans:]
        assert subject.tells_demand is tells
        said = subject.notes[: len(subject.notes) - len(bench.drive.notes)]
        assert [text[: len(first)] for text in said] == ([first] if first else [])
    finally:
        bench.close()


def test_a_bound_below_eight_steps_is_refused_before_anything_is_written(bench: Bench) -> None:
    unit = bench.unit_nm
    subject = bench.subject(replace(ASKED, torque_max_nm=7.9 * unit))
    with pytest.raises(BadInput) as caught:
        subject.configure(changes=True, every=1)
    assert (caught.value.source, caught.value.key, caught.value.value) == ("--torque-max-nm", "", 7.9 * unit)
    assert (subject.configured, bench.drive.settings) == (False, [])


def joined(bench: Bench, asked: MeasureRequest = ASKED, number: int = 0, changes: bool = True) -> Any:
    subject = bench.subject(asked)
    subject.configure(changes=changes, every=1)
    said: list[str] = []
    log = SyncLog(Duration(47_000), asked.period, EchoBasis.BUS)
    axis = subject.join(number, log, said.append)
    return subject, axis, said, log


def test_the_axis_of_a_drive_follows_no_reference_and_loses_nothing_early(bench: Bench) -> None:
    subject, axis, said, log = joined(bench)
    parts = axis.parts
    assert (parts.name, parts.drive, parts.compensator) == ("node 1", subject.probe, subject.probe.decision)
    assert (parts.reference.quantity, parts.load.quantity) == (Quantity.SPEED, Quantity.TORQUE)
    assert parts.load_machine is None
    assert parts.syncs is log
    assert (parts.horizon, parts.deadline) == (50, 50 * NS_PER_MS)
    # 44 bits and the data of the frame with the speed, none of them stuffed, at 1 Mbit/s
    assert parts.transit == (44 + 8 * bench.drive.reading_bytes) * 1_000
    assert (parts.acts_at_syncs, parts.acts_later) == (False, 0)
    parts.tell("a clock that was set")
    assert said == ["node 1: a clock that was set"]
    assert subject.notes[-1] == "a clock that was set"


def test_commands_of_later_drives_wait_for_those_before_them(bench: Bench) -> None:
    _, first, _, _ = joined(bench, number=1)
    _, third, _, _ = joined(bench, number=3)
    assert third.parts.acts_later == 3 * first.parts.acts_later > 0


def test_demand_changes_are_placed_by_the_axis_s_own_clock_where_they_are_told(bench: Bench) -> None:
    subject, axis, _, _ = joined(bench)
    assert subject.probe.map is axis.by_stamp.clock
    subject, _, _, _ = joined(bench, changes=False)
    assert subject.probe.map is None


def test_the_torques_of_each_drive_are_its_own_and_within_its_bound(bench: Bench) -> None:
    sequences = []
    for asked, number in ((ASKED, 0), (ASKED, 1), (replace(ASKED, seed=4), 1)):
        _, axis, _, _ = joined(bench, asked, number)
        expected = Excitation(30, bench.unit_nm, 20.0, asked.seed + number)
        found = []
        for _ in range(40):
            set_point = axis.parts.controller.output(in_cycle())
            assert set_point == expected.output(in_cycle())
            command = axis.parts.guard.command(1, set_point.torque_nm, Instant(0), Instant(0))
            assert command.torque_nm == set_point.torque_nm, "the guard lets all of them pass"
            axis.parts.controller.update(in_cycle(), command)
            expected.update(in_cycle(), command)
            found.append(command.torque_nm)
        sequences.append(found)
    assert sequences[0] != sequences[1], "two drives, two sequences"
    assert sequences[0] == sequences[2], "the seed and the number are added"


def limits(axis: Axis, torque_nm: float) -> tuple[bool, bool, int]:
    """Whether a speed of 20.1 rad/s ends it, whether so much torque is cut, and after how many cycles
    without a reading it ends."""
    guard = axis.parts.guard
    cut = guard.limit(torque_nm) < torque_nm
    fast = guard.check_speed(20.1) is not None and guard.check_speed(20.0) is None
    count = 1
    while guard.check_cycle(False, 0.0, AT_REST) is None:
        count += 1
    return fast, cut, count


def test_an_enabled_drive_is_stopped_by_speed_and_when_it_is_blind(bench: Bench) -> None:
    _, axis, _, _ = joined(bench)
    assert limits(axis, 30.5 * bench.unit_nm) == (True, True, 101)
    slow = replace(ASKED, period_us=20_000)
    _, axis, _, _ = joined(bench, slow)
    assert limits(axis, 30.0 * bench.unit_nm) == (True, False, 11)


def test_a_disabled_one_is_stopped_by_nothing(bench: Bench) -> None:
    _, axis, _, _ = joined(bench, DISABLED)
    assert limits(axis, 30.5 * bench.unit_nm) == (False, True, DISABLED.cycles + 1)
    assert axis.parts.guard.check_speed(math.inf) is None
