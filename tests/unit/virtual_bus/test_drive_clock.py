"""The drive's own clock as its TPDOs tell it, held against the SYNCs that a tap on the segment saw."""

import struct
from itertools import pairwise
from typing import Any

import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.clock_drift import ClockDrift
from servobench.virtual_bus.faults.kinds.clock_step import ClockStep
from servobench.virtual_bus.faults.node_fault import NodeFault
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.hosting.injection import Injection
from servobench.virtual_bus.timeline import Timeline
from tests.fates import keys
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ServoBench

OFFSET_US = 5_000_000
PERIOD_NS = 1_003_000
"""Not a multiple of the inner period of 62.5 us: SYNC and inner ticks drift through each other."""


class TappedDrive:
    """A drive with ``faults`` on a segment, asked by a SYNC per period."""

    def __init__(self, *faults: NodeFault, drift_ppm: float = 0.0) -> None:
        self.timeline = Timeline()
        segment = CanSegment(self.timeline)
        segment.add_monitor(self._see)
        self.master = segment.attach("master", Listener())
        self.errors_us: list[tuple[Instant, float]] = []
        """Of each stamp: the SYNC's end, and how far the clock is ahead of a perfect one."""
        self._sync_at = Instant(0)
        parameters = DriveParameters(clock_offset_us=OFFSET_US, clock_drift_ppm=drift_ppm)
        injection = Injection(FaultPlan(node_faults=faults), seed=1)
        attached = AttachedDevice(injection.wrap(SimulatedServo(1, LING, parameters)), segment)
        injection.on_start(attached.wake_now)
        self.nmt(1)
        injection.start(self.timeline.now)
        self.zero = self.timeline.now

    def nmt(self, command: int) -> None:
        """An NMT command, and time for it and for what it brings."""
        self.master.send(Frame(0, bytes([command, 0])))
        self.timeline.run_until(Instant(self.timeline.now + NS_PER_MS))

    def run(self, seconds: float) -> None:
        """SYNCs up to an instant of the plan."""
        while self.timeline.now - self.zero < seconds * NS_PER_S:
            self.master.send(Frame(0x80))
            self.timeline.run_until(Instant(self.timeline.now + PERIOD_NS))

    def _see(self, frame: Frame, at: Instant) -> None:
        if frame.can_id == 0x80:
            self._sync_at = at
        elif frame.can_id == 0x281:
            (stamp_us,) = struct.unpack_from("<I", frame.data, 4)
            self.errors_us.append((self._sync_at, stamp_us - OFFSET_US - self._sync_at / NS_PER_US))


def after(seconds: float) -> dict[str, Any]:
    return keys(at_s=1e-9 * (round(seconds * NS_PER_S)))


def test_the_stamp_is_the_end_of_the_sync() -> None:
    drive = TappedDrive()
    drive.run(0.2)
    assert len(drive.errors_us) == 200
    assert all(-1.0 < error <= 0.0 for _, error in drive.errors_us), "1013h counts whole microseconds"


@pytest.mark.parametrize("drift_ppm", [1000.0, -1000.0])
def test_a_drive_with_a_fast_or_slow_clock_tells_so(drift_ppm: float) -> None:
    drive = TappedDrive(drift_ppm=drift_ppm)
    drive.run(2.0)
    for sync_at, error in drive.errors_us:
        assert error == pytest.approx(drift_ppm * sync_at / NS_PER_S, abs=2.0)


@pytest.mark.parametrize("drift_ppm", [1000.0, -1000.0])
def test_planned_drift_turns_the_rate_and_no_stamp_jumps(drift_ppm: float) -> None:
    drift = ClockDrift(
        from_s=1e-9 * (NS_PER_S // 2),
        until_s=1e-9 * (3 * NS_PER_S // 2),
        drift_ppm=drift_ppm,
    )
    drive = TappedDrive(drift)
    drive.run(2.0)
    for sync_at, error in drive.errors_us:
        within_s = min(max(sync_at - drive.zero - drift.from_ns, 0) / NS_PER_S, 1.0)
        assert error == pytest.approx(drift_ppm * within_s, abs=2.0)


@pytest.mark.parametrize("step_us", [-350, 2_000, 1_000_000])
def test_a_planned_step_shows_from_the_next_sync_on(step_us: int) -> None:
    step_ns = Duration(step_us * NS_PER_US)
    drive = TappedDrive(ClockStep(**after(0.1), step_min_us=1e-3 * step_ns, step_max_us=1e-3 * step_ns))
    drive.run(0.2)
    errors = [error for _, error in drive.errors_us]
    jumps = [(at, new - old) for (_, old), (at, new) in pairwise(drive.errors_us) if abs(new - old) > 1.0]
    assert len(jumps) == 1
    assert 0 <= jumps[0][0] - drive.zero - 100 * NS_PER_MS < PERIOD_NS
    assert errors[-1] == pytest.approx(step_us, abs=1.0)


@pytest.mark.parametrize(("command", "restarts"), [(129, True), (130, False)])
def test_a_reset_of_the_node_restarts_the_clock(command: int, restarts: bool) -> None:
    """Reset of communication leaves it alone, and no reset mends the oscillator."""
    step_ns = Duration(NS_PER_S)
    drive = TappedDrive(
        ClockStep(**after(0.05), step_min_us=1e-3 * step_ns, step_max_us=1e-3 * step_ns), drift_ppm=1000.0
    )
    drive.run(0.1)
    reset_at = drive.timeline.now
    drive.nmt(command)
    drive.timeline.run_until(Instant(reset_at + 50 * NS_PER_MS))
    drive.nmt(1)
    drive.errors_us.clear()
    drive.run(1.0)
    assert drive.errors_us
    for sync_at, error in drive.errors_us:
        began, ahead = (reset_at, -reset_at / NS_PER_US) if restarts else (0, 1e6)
        # The reset acts at the end of its frame, less than 200 us after it was sent.
        assert error == pytest.approx(ahead + 1000.0 * (sync_at - began) / NS_PER_S, abs=200.0)


def test_a_written_stamp_counts_on_and_is_forgotten_by_a_reset() -> None:
    bench = ServoBench(DriveParameters(clock_offset_us=OFFSET_US))
    bench.wait_ms(10)
    assert bench.write(0x1013, "I", 77) is None
    bench.wait_ms(5)
    assert bench.read(0x1013, "I") == 77 + 5_000
    bench.nmt(129)
    bench.wait_ms(42)
    assert bench.read(0x1013, "I") == OFFSET_US + 42_000
