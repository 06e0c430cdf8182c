"""Velocity mode over the frames of the whole drive: ramps by closed form, bits 4 to 6, limits, units."""

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State
from tests.unit.virtual_bus.motion_bench import (
    BIT_12,
    BIT_13,
    COUNTS,
    ENABLED,
    HALT,
    LIMITED,
    REACHED,
    MotionBench,
)

ENABLE_RAMP, UNLOCK_RAMP, REFERENCE_RAMP = 0x10, 0x20, 0x40
FOLLOWING = ENABLED | ENABLE_RAMP | UNLOCK_RAMP | REFERENCE_RAMP
UP, DOWN = 3000, 1500
"""r/min per second."""
TARGET = 600
"""r/min."""


def ramped_bench(controlword: int = FOLLOWING) -> MotionBench:
    """Enabled in the mode, with the target set and the ramps at rest."""
    bench = MotionBench(Mode.VELOCITY)
    set_ramp(bench, Object.VL_VELOCITY_ACCELERATION, 2 * UP, 2)
    set_ramp(bench, Object.VL_VELOCITY_DECELERATION, DOWN, 1)
    bench.set(Object.VL_TARGET_VELOCITY, "h", TARGET)
    bench.wait_ms(20)
    assert bench.turns == pytest.approx(0.0, abs=1e-3), "without bits 4 to 6 a target moves nothing"
    bench.control(controlword)
    return bench


def set_ramp(bench: MotionBench, index: int, speed: int, seconds: int) -> None:
    bench.set(index, "I", speed, 1)
    bench.set(index, "H", seconds, 2)


def rpm(bench: MotionBench) -> float:
    return 60.0 * bench.turns_s


def demand(bench: MotionBench) -> int:
    return bench.read(Object.VL_VELOCITY_DEMAND, "h")


def test_a_target_is_reached_by_6048_and_left_by_6049() -> None:
    bench = ramped_bench()
    bench.wait_ms(100)
    assert demand(bench) == pytest.approx(0.1 * UP, abs=6)
    assert rpm(bench) == pytest.approx(0.1 * UP, abs=25)
    bench.wait_ms(200)
    assert demand(bench) == TARGET
    assert bench.read(Object.VL_VELOCITY_ACTUAL_VALUE, "h") == pytest.approx(TARGET, abs=10)
    begun = bench.turns
    bench.set(Object.VL_TARGET_VELOCITY, "h", 0)
    bench.wait_ms(200)
    assert demand(bench) == pytest.approx(TARGET - 0.2 * DOWN, abs=6)
    bench.wait_ms(300)
    assert demand(bench) == 0
    way = (TARGET / 60) ** 2 / (2 * DOWN / 60)
    assert bench.turns - begun == pytest.approx(way, abs=0.05), "v^2 / 2a"
    assert abs(rpm(bench)) < 5


def test_through_zero_the_ramps_take_turns() -> None:
    bench = ramped_bench()
    bench.wait_ms(300)
    bench.set(Object.VL_TARGET_VELOCITY, "h", -300)
    bench.wait_ms(200)
    assert demand(bench) == pytest.approx(TARGET - 0.2 * DOWN, abs=6)
    bench.wait_ms(200 + 110)
    assert demand(bench) == -300


def test_bit_5_locks_the_ramp_where_it_is() -> None:
    bench = ramped_bench()
    bench.wait_ms(100)
    bench.control(FOLLOWING & ~UNLOCK_RAMP)
    bench.wait_ms(2)
    held = demand(bench)
    bench.wait_ms(100)
    assert demand(bench) == held == pytest.approx(0.1 * UP, abs=9)
    bench.control(FOLLOWING)
    bench.wait_ms(150)
    assert demand(bench) == TARGET


@pytest.mark.parametrize("bit", [ENABLE_RAMP, REFERENCE_RAMP])
def test_without_bit_4_or_6_it_comes_to_rest_by_6049(bit: int) -> None:
    bench = ramped_bench()
    bench.wait_ms(300)
    bench.control(FOLLOWING & ~bit)
    bench.wait_ms(200)
    assert demand(bench) == pytest.approx(TARGET - 0.2 * DOWN, abs=6)
    bench.wait_ms(300)
    assert abs(rpm(bench)) < 5
    assert bench.state is State.OPERATION_ENABLED
    bench.control(FOLLOWING)
    bench.wait_ms(250)
    assert demand(bench) == TARGET


@pytest.mark.parametrize(("option", "steepness"), [(1, DOWN), (2, 6000)])
def test_a_halt_goes_by_605d_and_ends_in_bit_10(option: int, steepness: int) -> None:
    bench = ramped_bench()
    bench.set(Object.HALT_OPTION, "h", option)
    set_ramp(bench, Object.VL_VELOCITY_QUICK_STOP, 6000, 1)
    bench.wait_ms(300)
    begun = bench.turns
    bench.control(FOLLOWING | HALT)
    bench.until_reached(800)
    assert bench.turns - begun == pytest.approx((TARGET / 60) ** 2 / (2 * steepness / 60), abs=0.1)
    bench.control(FOLLOWING)
    bench.wait_ms(250)
    assert demand(bench) == TARGET
    assert not bench.statusword & (REACHED | BIT_12 | BIT_13)


def test_6046_bounds_the_amount_either_way() -> None:
    bench = ramped_bench()
    bench.set(Object.VL_VELOCITY_MIN_MAX_AMOUNT, "I", 50, 1)
    bench.set(Object.VL_VELOCITY_MIN_MAX_AMOUNT, "I", 400, 2)
    for asked, held in ((TARGET, 400), (-TARGET, -400), (20, 50), (-20, -50), (0, 0), (300, 300)):
        bench.set(Object.VL_TARGET_VELOCITY, "h", asked)
        bench.wait_ms(600)
        assert demand(bench) == held
        assert bool(bench.statusword & LIMITED) == (asked != held)


def test_604c_sets_the_unit_of_targets_and_ramps() -> None:
    """Sub 1 over sub 2 r/min: here a tenth of a turn per second."""
    bench = MotionBench(Mode.VELOCITY)
    bench.set(Object.VL_DIMENSION_FACTOR, "i", 6, 1)
    set_ramp(bench, Object.VL_VELOCITY_ACCELERATION, 500, 1)
    bench.set(Object.VL_TARGET_VELOCITY, "h", 100)
    bench.control(FOLLOWING)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(5.0, abs=0.5)
    bench.wait_ms(200)
    assert bench.turns_s == pytest.approx(10.0, abs=0.2)
    assert bench.read(Object.VL_VELOCITY_ACTUAL_VALUE, "h") == pytest.approx(100, abs=2)


def test_the_velocity_bit_of_607e_turns_the_target_too() -> None:
    bench = MotionBench(Mode.VELOCITY, enabled=False)
    bench.set(Object.POLARITY, "B", 0x40)
    bench.enable()
    bench.set(Object.VL_TARGET_VELOCITY, "h", 60)
    bench.control(FOLLOWING)
    bench.wait_ms(500)
    assert bench.turns < -0.1
    assert bench.read(Object.VL_VELOCITY_ACTUAL_VALUE, "h") == pytest.approx(60, abs=8)


def test_a_time_of_zero_is_a_ramp_without_limit() -> None:
    bench = ramped_bench(ENABLED)
    set_ramp(bench, Object.VL_VELOCITY_ACCELERATION, 1, 0)
    bench.control(FOLLOWING)
    bench.wait_ms(40)
    assert demand(bench) == TARGET


def test_the_end_of_the_axis_ends_a_velocity() -> None:
    bench = ramped_bench(ENABLED)
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 12_000)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -COUNTS, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", COUNTS, 2)
    bench.control(FOLLOWING)
    bench.wait_ms(800)
    assert bench.turns == pytest.approx(1.0, abs=0.05)
    assert bench.statusword & LIMITED
    bench.set(Object.VL_TARGET_VELOCITY, "h", -60)
    bench.wait_ms(100)
    assert bench.turns_s < -0.5
