"""Profile velocity mode over the frames of the whole drive, against closed forms."""

import math

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State
from tests.unit.virtual_bus.motion_bench import (
    BIT_12,
    COUNTS,
    ENABLED,
    HALT,
    LIMITED,
    REACHED,
    RPM_PER_TURN_S,
    MotionBench,
)

UP, DOWN = 100.0, 50.0
"""turns/s^2."""
MILLI_RPM = RPM_PER_TURN_S * 1000
WINDOW = 20_000 / MILLI_RPM
"""606Dh at power-on, turns/s."""


@pytest.fixture
def bench() -> MotionBench:
    made = MotionBench(Mode.PROFILE_VELOCITY)
    made.profile(30.0, UP, DOWN)
    return made


def reach(bench: MotionBench, turns_s: float) -> int:
    """Milliseconds to a speed."""
    bench.speed(turns_s)
    bench.wait_ms(1.5)
    return round(1.5 + bench.until_reached())


@pytest.mark.parametrize(
    ("start", "target", "ramp_s"),
    [
        (0.0, 10.0, 10.0 / UP),
        (0.0, -10.0, 10.0 / UP),
        (10.0, 4.0, 6.0 / DOWN),
        (-10.0, -15.0, 5.0 / UP),
        (10.0, -10.0, 10.0 / DOWN + 10.0 / UP),
    ],
)
def test_a_change_of_speed_takes_its_ramp(
    bench: MotionBench, start: float, target: float, ramp_s: float
) -> None:
    reach(bench, start)
    bench.wait_ms(100)
    # Reached is 10 ms inside the window of a third of a turn/s, at whose edge the ramp is a bit earlier.
    rate = DOWN if abs(target) < abs(start) else UP
    expected_ms = 1000 * (ramp_s - WINDOW / rate) + 10
    assert reach(bench, target) == pytest.approx(expected_ms, abs=5)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(target, rel=0.01)


def test_the_ramp_itself(bench: MotionBench) -> None:
    bench.speed(10.0)
    for passed in range(1, 100):
        bench.wait_ms(1)
        assert bench.turns_s == pytest.approx(passed / 1000 * UP, abs=0.3)
    demand = bench.read(Object.VELOCITY_DEMAND_VALUE, "i") / MILLI_RPM
    assert demand == pytest.approx(10.0, abs=0.2)


def test_another_target_in_the_middle_of_a_ramp_goes_on_from_there(bench: MotionBench) -> None:
    bench.speed(20.0)
    bench.wait_ms(100)
    bench.speed(0.0)
    fastest = max(bench.watch(40, lambda: bench.turns_s))
    assert fastest == pytest.approx(10.0, abs=0.5)
    bench.wait_ms(200)
    assert bench.turns_s == pytest.approx(0.0, abs=0.05)


def test_the_window_and_its_time_make_bit_10(bench: MotionBench) -> None:
    reach(bench, 10.0)
    bench.set(Object.VELOCITY_WINDOW_TIME, "H", 300)
    assert reach(bench, 5.0) == pytest.approx(1000 * (5.0 - WINDOW) / DOWN + 300, abs=5)
    bench.set(Object.VELOCITY_WINDOW, "H", 0)
    bench.wait_ms(2)
    assert not bench.reached, "no shaft stays at one speed to a thousandth of a rev/min"


def test_bit_12_says_standstill_until_the_threshold_is_exceeded_for_its_time(bench: MotionBench) -> None:
    bench.set(Object.VELOCITY_THRESHOLD, "H", 60_000)
    bench.set(Object.VELOCITY_THRESHOLD_TIME, "H", 50)
    assert bench.statusword & BIT_12
    bench.speed(2.0)
    passed = bench.wait_until(lambda: not bench.statusword & BIT_12, 200)
    assert passed == pytest.approx(1000 * 1.0 / UP + 50, abs=4)
    bench.speed(0.0)
    below = bench.wait_until(lambda: bool(bench.statusword & BIT_12), 200)
    assert below == pytest.approx(1000 * 1.0 / DOWN, abs=4), "at once, CiA 402-2 object 606Fh"


def test_a_short_excess_of_the_threshold_changes_nothing(bench: MotionBench) -> None:
    bench.set(Object.VELOCITY_THRESHOLD, "H", 60_000)
    bench.set(Object.VELOCITY_THRESHOLD_TIME, "H", 1000)
    bench.speed(3.0)
    bench.wait_ms(40)
    assert bench.turns_s > 2.0
    assert bench.statusword & BIT_12
    bench.speed(0.0)
    assert all(bench.watch(100, lambda: bench.statusword & BIT_12))


@pytest.mark.parametrize(
    ("index", "value"),
    [(Object.MAX_PROFILE_VELOCITY, 4 * MILLI_RPM), (Object.MAX_MOTOR_SPEED, 4 * RPM_PER_TURN_S)],
)
def test_speed_limits_cut_the_target_and_tell(bench: MotionBench, index: Object, value: int) -> None:
    bench.set(index, "I", value)
    bench.speed(-9.0)
    bench.wait_ms(200)
    assert bench.turns_s == pytest.approx(-4.0, rel=0.01)
    assert bench.statusword & (LIMITED | REACHED) == LIMITED
    bench.speed(3.0)
    bench.wait_ms(300)
    assert bench.statusword & (LIMITED | REACHED) == REACHED


@pytest.mark.parametrize(("option", "deceleration"), [(1, DOWN), (2, 400.0), (3, math.inf)])
def test_halt_stops_by_605d_and_its_end_ramps_up_again(
    bench: MotionBench, option: int, deceleration: float
) -> None:
    bench.set(Object.HALT_OPTION, "h", option)
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 400 * RPM_PER_TURN_S)
    reach(bench, 10.0)
    bench.wait_ms(50)
    begun = bench.turns
    bench.control(ENABLED | HALT)
    assert not bench.reached
    bench.until_reached()
    assert bench.turns - begun == pytest.approx(10.0**2 / (2 * deceleration), abs=0.08)
    assert bench.statusword & BIT_12
    assert bench.state is State.OPERATION_ENABLED
    bench.control(ENABLED)
    assert not bench.reached
    bench.wait_ms(50)
    assert bench.turns_s == pytest.approx(0.05 * UP, abs=0.4)
    bench.until_reached()


def test_a_halt_that_is_there_from_the_start_keeps_the_shaft_at_rest() -> None:
    bench = MotionBench(Mode.PROFILE_VELOCITY, enabled=False)
    bench.speed(10.0)
    for controlword in (0x06, 0x07, ENABLED | HALT):
        bench.control(controlword)
    bench.wait_ms(100)
    assert bench.turns == pytest.approx(0.0, abs=0.01)
    assert bench.reached
    bench.control(ENABLED)
    bench.wait_ms(300)
    assert bench.turns_s == pytest.approx(10.0, rel=0.02)


def test_the_software_limit_is_not_run_over(bench: MotionBench) -> None:
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -2 * COUNTS, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 3 * COUNTS, 2)
    bench.speed(10.0)
    bench.wait_ms(1500)
    assert bench.turns == pytest.approx(3.0, abs=0.05)
    assert abs(bench.turns_s) < 0.05
    assert bench.statusword & (LIMITED | REACHED) == LIMITED
    bench.speed(-5.0)
    bench.wait_ms(20)
    assert not bench.statusword & LIMITED, "away from it there is no limit"
    bench.wait_ms(2500)
    assert bench.turns == pytest.approx(-2.0, abs=0.05)


def test_a_limit_switch_stops_by_the_quick_stop_ramp(bench: MotionBench) -> None:
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.fit(0b01, negative=-1.0)
    bench.speed(-10.0)
    bench.wait_ms(1000)
    assert bench.turns == pytest.approx(-1.0 - 10.0**2 / (2 * 200.0), abs=0.05)
    assert bench.inputs & 0b111 == 0b001
    assert bench.state is State.OPERATION_ENABLED
    bench.speed(10.0)
    bench.wait_ms(400)
    assert bench.turns_s == pytest.approx(10.0, rel=0.02)


def test_a_load_is_held_by_the_speed_loop(bench: MotionBench) -> None:
    reach(bench, 10.0)
    bench.set(0x2100, "i", 1000, 1)
    bench.wait_ms(400)
    assert bench.turns_s == pytest.approx(10.0, rel=0.01)
    assert bench.read(Object.TORQUE_ACTUAL_VALUE, "h") == pytest.approx(1000 * 1.0 / 2.0, rel=0.15)
