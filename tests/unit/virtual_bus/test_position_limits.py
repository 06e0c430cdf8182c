"""Profile position inside its limits: speeds, accelerations, halt, windows, following error."""

import math

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import State
from tests.unit.virtual_bus.motion_bench import (
    BIT_13,
    COUNTS,
    ENABLED,
    HALT,
    LIMITED,
    RPM_PER_TURN_S,
    MotionBench,
)
from tests.unit.virtual_bus.profile_moves import (
    CLOSE,
    DOWN,
    SETTLED_MS,
    SPEED,
    UP,
    bench_with_profile,
    duration_ms,
)


@pytest.mark.parametrize(
    ("index", "value"),
    [
        (Object.MAX_PROFILE_VELOCITY, 4 * RPM_PER_TURN_S * 1000),
        (Object.MAX_MOTOR_SPEED, 4 * RPM_PER_TURN_S),
    ],
)
def test_each_limit_of_speed_is_kept_and_told(index: Object, value: int) -> None:
    bench = bench_with_profile()
    bench.set(index, "I", value)
    bench.target(3.0)
    bench.wait_ms(100)
    assert bench.statusword & LIMITED
    fastest = max(bench.watch(300, lambda: bench.turns_s))
    assert fastest == pytest.approx(4.0, rel=0.02)


@pytest.mark.parametrize(
    ("index", "value", "total_s"),
    [
        (Object.MAX_ACCELERATION, 20.0, 0.5 + (5.0 - 2.5 - 1.0) / 10.0 + 0.2),
        (Object.MAX_DECELERATION, 20.0, 0.1 + (5.0 - 0.5 - 2.5) / 10.0 + 0.5),
    ],
)
def test_accelerations_are_inside_60c5_and_60c6(index: Object, value: float, total_s: float) -> None:
    bench = bench_with_profile()
    bench.set(index, "I", round(value * RPM_PER_TURN_S))
    bench.target(5.0)
    assert bench.until_reached() == pytest.approx(1000 * total_s + SETTLED_MS, abs=4)


def test_targets_are_cut_at_607d_less_the_home_offset() -> None:
    bench = bench_with_profile()
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -COUNTS, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 2 * COUNTS, 2)
    bench.target(5.0)
    bench.wait_ms(5)
    assert bench.statusword & LIMITED
    bench.until_reached()
    assert bench.turns == pytest.approx(2.0, abs=CLOSE)
    bench.set(Object.HOME_OFFSET, "i", COUNTS // 2)
    bench.target(-5.0)
    bench.until_reached()
    assert bench.turns == pytest.approx(-1.5, abs=CLOSE)
    bench.target(0.0)
    bench.until_reached()
    assert not bench.statusword & LIMITED


@pytest.mark.parametrize(("option", "deceleration"), [(1, DOWN), (2, 200.0), (3, math.inf), (4, math.inf)])
def test_halt_stops_by_605d_and_the_move_goes_on_after_it(option: int, deceleration: float) -> None:
    bench = bench_with_profile()
    bench.set(Object.HALT_OPTION, "h", option)
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.target(5.0)
    bench.wait_ms(200)
    begun = bench.turns
    bench.control(ENABLED | HALT)
    assert not bench.reached
    stopped_ms = bench.until_reached()
    braking = SPEED**2 / (2 * deceleration)
    assert bench.turns - begun == pytest.approx(braking, abs=0.07)
    assert stopped_ms == pytest.approx(1000 * SPEED / deceleration, abs=15 if option < 3 else 80)
    assert bench.state is State.OPERATION_ENABLED
    bench.wait_ms(50)
    standing = bench.turns
    bench.control(ENABLED)
    assert not bench.reached
    assert bench.until_reached() == pytest.approx(duration_ms(5.0 - standing) + SETTLED_MS, abs=5)
    assert bench.turns == pytest.approx(5.0, abs=CLOSE)


def test_a_set_point_during_a_halt_waits_for_its_end() -> None:
    bench = bench_with_profile()
    bench.control(ENABLED | HALT)
    bench.target(1.0, controlword=ENABLED | HALT)
    bench.wait_ms(200)
    assert bench.turns == pytest.approx(0.0, abs=CLOSE)
    bench.control(ENABLED)
    bench.until_reached()
    assert bench.turns == pytest.approx(1.0, abs=CLOSE)


def test_the_window_and_its_time_decide_when_a_target_is_reached() -> None:
    for window, time_ms, later_ms in ((0xFFFF_FFFF, 0, 0), (200, 200, 200)):
        bench = bench_with_profile()
        bench.set(Object.POSITION_WINDOW, "I", window)
        bench.set(Object.POSITION_WINDOW_TIME, "H", time_ms)
        bench.target(1.5)
        assert bench.until_reached() == pytest.approx(duration_ms(1.5) + later_ms, abs=4)


def test_a_shaft_pushed_out_of_the_window_has_not_reached_its_target() -> None:
    bench = bench_with_profile()
    bench.target(1.0)
    bench.until_reached()
    bench.set(Object.POSITION_WINDOW, "I", 1)
    bench.set(0x2100, "i", 1500, 1)
    assert not all(bench.watch(60, lambda: bench.reached))
    bench.wait_ms(500)
    assert bench.turns == pytest.approx(1.0, abs=CLOSE), "the loops hold against the load"


def following_ms(bench: MotionBench, limit_ms: int) -> int | None:
    """When the drive fails, with a torque that cannot follow."""
    bench.set(Object.MAX_TORQUE, "H", 20)
    bench.target(50.0)
    for passed in range(limit_ms):
        if bench.state is not State.OPERATION_ENABLED:
            return passed
        bench.wait_ms(1)
    return None


def test_a_following_error_fails_after_its_time_and_shows_in_bit_13() -> None:
    def failing_ms(time_ms: int) -> int:
        bench = bench_with_profile()
        bench.set(Object.FOLLOWING_ERROR_WINDOW, "I", COUNTS // 4)
        bench.set(Object.FOLLOWING_ERROR_TIME_OUT, "H", time_ms)
        failed_ms = following_ms(bench, 1000)
        assert failed_ms is not None
        assert bench.statusword & BIT_13
        assert bench.read(Object.ERROR_CODE, "H") == 0x8611
        assert bench.emergencies() == [0x8611]
        bench.set(Object.MAX_TORQUE, "H", 2000)
        bench.wait_until(lambda: bench.state is State.FAULT, 2000)
        assert bench.statusword & BIT_13
        bench.control(0x80)
        assert bench.state is State.SWITCH_ON_DISABLED
        assert not bench.statusword & BIT_13
        return failed_ms

    times = failing_ms(0), failing_ms(50)
    # 0.04 N m against 0.0008 kg m^2: s = (100 turns/s^2 - 7.96 turns/s^2) t^2 / 2 = 0.25 turns
    assert times[0] == pytest.approx(1000 * math.sqrt(0.5 / (UP - 0.04 / 0.0008 / math.tau)), abs=4)
    assert times[1] - times[0] == pytest.approx(50, abs=2)


def test_no_following_error_with_the_window_switched_off() -> None:
    bench = bench_with_profile()
    bench.set(Object.FOLLOWING_ERROR_WINDOW, "I", 0xFFFF_FFFF)
    assert following_ms(bench, 600) is None
    assert abs(bench.read(Object.FOLLOWING_ERROR_ACTUAL_VALUE, "i")) > COUNTS


def test_a_broken_encoder_is_noticed_as_a_following_error() -> None:
    bench = bench_with_profile()
    bench.target(50.0)
    bench.wait_ms(200)
    bench.servo.drive.firmware.hold_encoder(True)
    assert bench.wait_until(lambda: bench.state is not State.OPERATION_ENABLED, 500) > 100
    assert bench.emergencies() == [0x8611]


def test_60f4_is_demand_less_actual_position() -> None:
    bench = bench_with_profile()
    bench.target(3.0)
    for _ in range(100):
        bench.wait_ms(1)
        demand, actual = bench.read(Object.POSITION_DEMAND_VALUE, "i"), bench.read(0x6064, "i")
        assert bench.read(Object.FOLLOWING_ERROR_ACTUAL_VALUE, "i") == pytest.approx(demand - actual, abs=1)
        assert bench.read(0x60FC, "i") == demand
