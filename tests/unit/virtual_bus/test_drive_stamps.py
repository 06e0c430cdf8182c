"""How a simulated drive stamps: its TPDOs beside the SYNCs and TPDOs that a tap on the segment saw."""

import math
import struct
from itertools import pairwise
from typing import Any, Final, NamedTuple

import pytest

from servobench.drivers.timebase import NS_PER_US, Instant
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.encoder import SpeedSensing
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ServoBench

OFFSET_US: Final = 5_000_000
TICK_NS: Final = 62_500


class Seen(NamedTuple):
    """One answer to a SYNC."""

    sync_at: Instant
    """End of the SYNC on the bus."""
    stamp: int
    """1013h, raw."""
    late_ns: int
    """How much later the TPDO with the stamp ended than behind a SYNC that the drive acts on at once."""


def answers(
    count: int,
    jitters_ns: tuple[int, ...] = (0,),
    period_ns: int = 1_003_000,
    seed: int = 0,
    told_ns: int = 0,
    **keys: Any,
) -> list[Seen]:
    """What a drive with ``keys`` answered to SYNCs, sent so much late of their period in turn. ``told_ns``:
    the period by 1006h, if it is another one."""
    timeline = Timeline()
    segment = CanSegment(timeline)
    seen: list[Seen] = []
    syncs: list[Instant] = []

    def see(frame: Frame, at: Instant) -> None:
        if frame.can_id == 0x80:
            syncs.append(at)
        elif frame.can_id == 0x281:
            (stamp,) = struct.unpack_from("<I", frame.data, 4)
            seen.append(Seen(syncs[len(seen)], stamp, at - syncs[len(seen)]))

    segment.add_monitor(see)
    master = segment.attach("master", Listener())
    parameters = DriveParameters(clock_offset_us=OFFSET_US, **keys)
    AttachedDevice(SimulatedServo(1, LING, parameters, seed), segment)
    master.send(Frame(0x601, struct.pack("<BHBI", 0x23, 0x1006, 0, (told_ns or period_ns) // NS_PER_US)))
    master.send(Frame(0, b"\x01\x01"))
    timeline.run_until(Instant(10_000_000))
    for number in range(count):
        due = 20_000_000 + number * period_ns + jitters_ns[number % len(jitters_ns)]
        timeline.run_until(Instant(due))
        master.send(Frame(0x80))
    timeline.run_until(Instant(timeline.now + 30_000_000))
    assert len(seen) == count
    return seen


def clock_us(at: float) -> float:
    """The drive's clock without drift, unwrapped."""
    return OFFSET_US + at / NS_PER_US


@pytest.mark.parametrize("resolution_us", [2, 62, 100, 400, 1000])
def test_a_coarse_stamp_advances_by_its_resolution(resolution_us: int) -> None:
    seen = answers(300, stamp_resolution_us=resolution_us)
    for each in seen:
        assert each.stamp == math.floor(clock_us(each.sync_at) / resolution_us) * resolution_us
    steps = {later.stamp - earlier.stamp for earlier, later in pairwise(seen)}
    assert math.gcd(*steps) == resolution_us


@pytest.mark.parametrize("unit_us", [0.5, 10.0, 1000.0])
def test_a_stamp_counts_in_its_unit(unit_us: float) -> None:
    for each in answers(100, stamp_unit_us=unit_us, stamp_resolution_us=unit_us):
        assert each.stamp == math.floor(clock_us(each.sync_at) / unit_us)


def test_a_narrow_stamp_wraps() -> None:
    seen = answers(200, stamp_bits=16)
    assert all(each.stamp == math.floor(clock_us(each.sync_at)) % 65_536 for each in seen)
    assert sum(later.stamp < earlier.stamp for earlier, later in pairwise(seen)) == 3, "200.6 ms / 65.536 ms"


def test_a_stamp_of_the_next_inner_tick_wanders_over_a_tick() -> None:
    seen = answers(300, stamp_latched="tick")
    lates_us = [each.stamp - clock_us(each.sync_at) for each in seen]
    for each in seen:
        tick_at = -(-each.sync_at // TICK_NS) * TICK_NS
        assert each.stamp == math.floor(clock_us(tick_at))
    assert min(lates_us) < 5
    assert max(lates_us) > 55, "1003 us are no multiple of 62.5 us"


def test_a_stamp_may_be_latched_a_fixed_time_late() -> None:
    for each in answers(50, stamp_late_us=40):
        assert each.stamp == math.floor(clock_us(each.sync_at + 40_000))


def test_a_task_with_jitter_samples_stamps_and_answers_late() -> None:
    seen = answers(400, sync_jitter_us=300)
    usual_ns = answers(1)[0].late_ns
    lates_us = [each.stamp - clock_us(each.sync_at) for each in seen]
    for each, late_us in zip(seen, lates_us, strict=True):
        assert (each.late_ns - usual_ns) / NS_PER_US == pytest.approx(late_us, abs=10.0)
        # 10 us: stuff bits of the frame in front
        assert -1.0 <= late_us <= 300.0
    assert sum(lates_us) / len(lates_us) == pytest.approx(150, abs=15), (
        "evenly drawn: 87 us / sqrt(400) = 4 us"
    )
    assert answers(400, sync_jitter_us=300) == seen, "the seed decides"
    assert answers(400, sync_jitter_us=300, seed=1) != seen


def test_a_task_with_jitter_samples_the_shaft_when_it_acts() -> None:
    bench = ServoBench(DriveParameters(sync_jitter_us=500, speed=SpeedSensing(filter_hz=None)))
    bench.turn(300)
    moved = []
    for _ in range(20):
        bench.wait_ms(2)
        assert bench.sync() == []
        count = int(bench.servo.drive.firmware.inner.count)
        due = bench.servo.wake_at
        assert due is not None
        bench.now = due
        (position,) = [frame for frame in bench.servo.wake(due) if frame.can_id == 0x281]
        (told,) = struct.unpack_from("<i", position.data)
        assert told == int(bench.servo.drive.firmware.inner.count)
        moved.append(told - count)
    assert max(moved) > 100, "counts while the task slept"


def test_a_stamp_of_the_arrival_does_not_tell_of_the_jitter() -> None:
    seen = answers(100, sync_jitter_us=300, stamp_latched="arrival")
    assert all(each.stamp == math.floor(clock_us(each.sync_at)) for each in seen)
    assert max(each.late_ns for each in seen) > min(each.late_ns for each in seen) + 200_000


def test_jitter_longer_than_a_period_keeps_the_order() -> None:
    seen = answers(100, sync_jitter_us=900, period_ns=400_000)
    assert all(later.stamp >= earlier.stamp for earlier, later in pairwise(seen))


def test_a_locked_cycle_samples_a_phase_behind_the_filtered_sync() -> None:
    jitters_ns = (0, 80_000, 30_000, 100_000, 60_000, 10_000, 90_000)
    seen = answers(1500, jitters_ns, period_ns=1_000_000, sync_phase_us=250)[-500:]
    spacings = [later.stamp - earlier.stamp for earlier, later in pairwise(seen)]
    assert max(abs(spacing - 1000) for spacing in spacings) < 15, "the SYNCs are up to 100 us off"
    mean_us = sum(jitters_ns) / len(jitters_ns) / NS_PER_US
    first = (seen[0].sync_at - jitters_ns[1000 % 7]) / NS_PER_US
    offsets_us = [each.stamp - OFFSET_US - first - 1000 * place for place, each in enumerate(seen)]
    assert sum(offsets_us) / len(seen) - mean_us == pytest.approx(250, abs=5)


def test_a_locked_cycle_never_acts_before_its_sync() -> None:
    for each in answers(300, (0, 90_000), period_ns=1_000_000, sync_phase_us=0):
        assert each.stamp >= math.floor(clock_us(each.sync_at))


def test_a_counter_that_a_master_sets_stands_between_its_writings() -> None:
    bench = ServoBench(DriveParameters(stamp_runs=False))
    bench.wait_ms(5)
    assert bench.read(0x1013, "I") == 0
    assert bench.write(0x1013, "I", 4711) is None
    bench.wait_ms(5)
    assert bench.read(0x1013, "I") == 4711
    bench.nmt(129)
    bench.wait_ms(50)
    assert bench.read(0x1013, "I") == 0


def test_a_master_that_writes_sets_the_clock_by_the_last_sync() -> None:
    """EPOS2: the difference between what is written and what the last SYNC latched moves the clock."""
    bench = ServoBench(DriveParameters(stamp_latched="arrival"))
    bench.sync()
    bench.wait_ms(3)
    assert bench.write(0x1013, "I", 1_000_000) is None
    bench.wait_ms(4)
    assert bench.read(0x1013, "I") == 1_000_000
    bench.sync()
    bench.wait_ms(2)
    assert bench.read(0x1013, "I") == 1_007_000


@pytest.mark.parametrize(
    "keys",
    [
        {"stamp_unit_us": 10.0},
        {"stamp_unit_us": 0.0, "stamp_resolution_us": 0.0},
        {"stamp_bits": 8},
        {"stamp_late_us": 101.0},
    ],
)
def test_a_counter_that_cannot_be_is_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"^stamp: "):
        SimulatedServo(1, LING, DriveParameters(**keys))


def test_a_locked_cycle_rides_over_syncs_that_stay_away() -> None:
    """As while the bench learns the drive's clock, with SYNCs many periods apart."""
    period_ns = 1_000_000
    for each in answers(
        30, (0, 7 * period_ns), period_ns=50 * period_ns, told_ns=period_ns, sync_phase_us=250
    ):
        assert each.stamp - clock_us(each.sync_at) == pytest.approx(250, abs=2)
