"""Tasks that take PDOs in and send them: each instant computed apart, to the ns."""

import math
from struct import pack

import numpy as np
import pytest

from servobench.drivers.timebase import NEVER, Instant
from servobench.virtual_bus.device.device_options import TaskOptions
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of
from tests.unit.virtual_bus.servo_bench import ENABLE, SYNC, ServoBench

MS = 1_000_000
RPDO, TPDO = 0x201, 0x181
POWER_ON = 123_457


class TaskBench(ServoBench):
    """Enabled in CST; time goes from wake to wake, to the ns."""

    def __init__(self, tasks: TaskOptions, drive: DriveParameters | None = None) -> None:
        drive = DriveParameters(tasks=tasks) if drive is None else drive
        super().__init__(drive)
        for command in ENABLE:
            self.command(command)
            self.wait_ms(10)
        self.frames: list[tuple[Instant, Frame]] = []
        self.acted: list[tuple[Instant, float]] = []

    def run_to(self, end: int) -> None:
        """Note when frames leave and when the torque demand changes."""
        inner = self.servo.drive.firmware.inner
        while True:
            due = self.servo.wake_at
            at = end if due is None or due is NEVER else min(int(due), end)
            self.now = Instant(max(self.now, at))
            before = inner.torque_in_force()
            self.frames += [(self.now, frame) for frame in self.servo.wake(self.now)]
            if inner.torque_in_force() != before:
                self.acted.append((self.now, inner.torque_in_force()))
            if self.now >= end:
                return

    def command_at(self, at: int, raw: int) -> None:
        """A frame with 6071h ends."""
        self.run_to(at)
        inner = self.servo.drive.firmware.inner
        before = inner.torque_in_force()
        self.frames += [(self.now, frame) for frame in self.receive(Frame(RPDO, pack("<Hh", 0xF, raw)))]
        if inner.torque_in_force() != before:
            self.acted.append((self.now, inner.torque_in_force()))

    def sync_at(self, at: int) -> None:
        self.run_to(at)
        self.frames += [(self.now, frame) for frame in self.receive(SYNC)]

    def told_at(self) -> list[int]:
        return [int(at) for at, frame in self.frames if frame.can_id == TPDO]


def tick_after(at: int, period_ns: int, first: int) -> int:
    """By search, not by a division."""
    tick = first
    while tick < at:
        tick += period_ns
    while tick - period_ns >= at:
        tick -= period_ns
    return tick


@pytest.mark.parametrize("seed", few_of(range(8), 3))
def test_a_command_acts_at_the_next_tick_and_its_dead_time(seed: int) -> None:
    draw = np.random.default_rng([43, seed])
    period, dead = int(draw.integers(50_000, 2 * MS)), int(draw.choice([0, 1, 370_001]))
    phase = int(draw.integers(0, period))
    bench = TaskBench(TaskOptions(rpdo_ns=period, rpdo_phase_ns=phase, dead_ns=dead))
    expected = []
    at = int(bench.now)
    for number in range(20):
        at += int(draw.integers(1, 5 * MS))
        bench.command_at(at, 10 + number)
        expected.append(tick_after(at, period, phase) + dead)
        at = max(at, expected[-1] + 1)
    bench.run_to(at + 10 * MS)
    assert [when for when, _ in bench.acted] == expected


def test_without_a_task_a_command_acts_when_its_frame_ends() -> None:
    bench = TaskBench(TaskOptions())
    at = int(bench.now) + 1_234_567
    bench.command_at(at, 50)
    assert bench.acted[0][0] == at


def test_of_two_commands_before_a_tick_the_last_one_acts() -> None:
    bench = TaskBench(TaskOptions(rpdo_ns=2 * MS))
    start = tick_after(int(bench.now), 2 * MS, 0) + 10
    bench.command_at(start, 50)
    bench.command_at(start + 100, 70)
    bench.run_to(start + 4 * MS)
    unit_nm = bench.servo.drive.objects.torque_unit_nm
    assert [(when, round(torque / unit_nm)) for when, torque in bench.acted] == [(start - 10 + 2 * MS, 70)]


@pytest.mark.parametrize("seed", few_of(range(6), 2))
def test_a_sync_is_answered_at_the_next_tick(seed: int) -> None:
    draw = np.random.default_rng([44, seed])
    period = int(draw.integers(100_000, MS))
    phase = int(draw.integers(0, period))
    bench = TaskBench(TaskOptions(tpdo_ns=period, tpdo_phase_ns=phase))
    bench.frames.clear()
    at, expected = int(bench.now), []
    for _ in range(20):
        at += int(draw.integers(MS, 3 * MS))
        bench.sync_at(at)
        expected.append(tick_after(at, period, phase))
    bench.run_to(at + 5 * MS)
    assert bench.told_at() == expected


def test_a_locked_task_is_as_far_behind_each_sync() -> None:
    """The RPDO's tick too counts from the last SYNC."""
    tasks = TaskOptions(400_000, 150_000, 0, 400_000, 70_000, locked=True)
    bench = TaskBench(tasks)
    bench.frames.clear()
    start, expected, told = int(bench.now), [], []
    for cycle in range(30):
        at = start + cycle * MS + 7_919 * (cycle % 5)
        bench.sync_at(at)
        told.append(at + 70_000)
        sent = at + 301_000
        bench.command_at(sent, 100 + cycle)
        expected.append(tick_after(sent, 400_000, at + 150_000))
    bench.run_to(at + 5 * MS)
    assert bench.told_at() == told
    assert [int(when) for when, _ in bench.acted] == expected


def test_an_event_is_told_at_the_tick_of_the_task() -> None:
    """TPDO1 by event, the statusword in it."""
    bench = TaskBench(TaskOptions(tpdo_ns=700_000, tpdo_phase_ns=123_000))
    for sub, code, value in ((1, "I", 0x8000_0181), (2, "B", 255), (1, "I", 0x181)):
        bench.write(0x1800, code, value, sub)
    bench.run_to(int(bench.now) + 3 * MS)
    bench.frames.clear()
    bench.run_to(int(bench.now) + 40 * MS)
    bench.command_at(int(bench.now) + 11, 300)
    bench.run_to(int(bench.now) + 20 * MS)
    told = bench.told_at()
    assert len(told) > 3
    assert {(at - 123_000) % 700_000 for at in told} == {0}


def test_leaving_operational_forgets_what_waits_for_the_task() -> None:
    bench = TaskBench(TaskOptions(dead_ns=5 * MS))
    bench.command_at(int(bench.now) + 100, 300)
    bench.nmt(128)
    bench.nmt(1)
    bench.run_to(int(bench.now) + 20 * MS)
    assert bench.acted == []


def test_a_synchronous_command_waits_for_its_task_and_then_for_a_sync() -> None:
    bench = TaskBench(TaskOptions(rpdo_ns=400_000))
    for sub, code, value in ((1, "I", 0x8000_0201), (2, "B", 1), (1, "I", 0x201)):
        assert bench.write(0x1400, code, value, sub) is None
    start = tick_after(int(bench.now), 400_000, 0) + MS * 2
    bench.command_at(start + 100_000, 200)
    bench.sync_at(start + 300_000)
    assert bench.acted == [], "its tick is at 400 us: too late for this SYNC"
    before = bench.servo.drive.firmware.inner.torque_in_force()
    bench.sync_at(start + 1_300_000)
    assert math.isfinite(before)
    assert bench.servo.drive.firmware.inner.torque_in_force() != before


@pytest.mark.parametrize("phase_ns", [-1, 400_000])
def test_a_phase_of_a_period_is_none(phase_ns: int) -> None:
    with pytest.raises(ValueError, match="tpdo task: phase"):
        TaskOptions(tpdo_ns=400_000, tpdo_phase_ns=phase_ns)
