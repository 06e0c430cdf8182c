"""Profile position mode over the frames of the whole drive, against closed forms."""

import math
from itertools import pairwise

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State
from servobench.virtual_bus.drive.firmware import FirmwareParameters
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.unit.virtual_bus.motion_bench import (
    AT_ONCE,
    BIT_12,
    BIT_13,
    COUNTS,
    ENABLED,
    LIMITED,
    NEW_SET_POINT,
    ON_SET_POINT,
    REACHED,
    RELATIVE,
    RPM_PER_TURN_S,
    MotionBench,
)
from tests.unit.virtual_bus.profile_moves import (
    CLOSE,
    COUNT_PER_PERIOD,
    DOWN,
    SETTLED_MS,
    SPEED,
    UP,
    bench_with_profile,
    duration_ms,
    way,
)


@pytest.mark.parametrize("target", [5.0, -5.0, 1.5, 0.3, -0.02])
def test_a_move_is_the_trapezoid(target: float) -> None:
    bench = bench_with_profile()
    bench.target(target)
    assert not bench.reached
    passed = 0
    while not bench.reached:
        bench.wait_ms(1)
        passed += 1
        expected = math.copysign(way(passed / 1000, abs(target)), target)
        # A move begins on the grid of motion periods, up to one of them beside the set-point.
        assert bench.turns == pytest.approx(expected, abs=CLOSE + SPEED * 1e-3)
        assert passed < 3000
    assert passed == pytest.approx(duration_ms(abs(target)) + SETTLED_MS, abs=4)
    bench.wait_ms(50)
    assert bench.turns == pytest.approx(target, abs=CLOSE)
    assert not bench.statusword & (BIT_12 | BIT_13 | LIMITED)


def test_the_hand_shake_bit_by_bit() -> None:
    bench = bench_with_profile()
    assert bench.statusword & (REACHED | BIT_12) == REACHED, "at rest where it is"
    bench.set(Object.TARGET_POSITION, "i", COUNTS)
    bench.wait_ms(5)
    assert bench.turns == pytest.approx(0.0, abs=CLOSE), "a target alone moves nothing"
    bench.control(ENABLED | NEW_SET_POINT)
    assert bench.statusword & (REACHED | BIT_12) == BIT_12
    bench.wait_ms(30)
    assert bench.statusword & BIT_12, "until bit 4 falls"
    bench.control(ENABLED)
    assert not bench.statusword & BIT_12
    bench.until_reached()
    bench.control(ENABLED | NEW_SET_POINT)
    assert bench.statusword & BIT_12, "the same target again is taken too"
    bench.until_reached(50)
    assert bench.turns == pytest.approx(1.0, abs=CLOSE)


@pytest.mark.parametrize("words", [(0x6040_0010, 0x607A_0020), (0x607A_0020, 0x6040_0010)])
def test_target_and_bit_4_may_come_in_one_pdo_in_any_order(words: tuple[int, int]) -> None:
    bench = bench_with_profile()
    bench.map_rpdo(2, *words)
    for target in (COUNTS, -COUNTS // 2):
        for controlword in (ENABLED | NEW_SET_POINT, ENABLED):
            if words[0] >> 16 == Object.CONTROLWORD:
                bench.send(2, "Hi", controlword, target)
            else:
                bench.send(2, "iH", target, controlword)
            bench.wait_ms(1)
        bench.until_reached()
        assert bench.turns == pytest.approx(target / COUNTS, abs=CLOSE)


def test_a_set_point_waits_for_the_one_under_way() -> None:
    bench = bench_with_profile()
    bench.target(1.5)
    bench.set(Object.TARGET_POSITION, "i", -COUNTS // 2)
    bench.control(ENABLED | NEW_SET_POINT)
    bench.control(ENABLED)
    assert bench.statusword & BIT_12, "no room for a third one"
    bench.set(Object.TARGET_POSITION, "i", 9 * COUNTS)
    bench.control(ENABLED | NEW_SET_POINT)
    bench.control(ENABLED)
    first_ms = bench.wait_until(lambda: not bench.statusword & BIT_12, 1000)
    assert first_ms == pytest.approx(duration_ms(1.5) + SETTLED_MS, abs=5)
    assert bench.turns == pytest.approx(1.5, abs=CLOSE)
    assert not bench.reached, "the second one has begun"
    assert bench.until_reached() == pytest.approx(duration_ms(2.0) + SETTLED_MS, abs=5)
    assert bench.turns == pytest.approx(-0.5, abs=CLOSE)
    bench.wait_ms(300)
    assert bench.turns == pytest.approx(-0.5, abs=CLOSE), "the third one was refused"


def test_at_once_takes_the_place_of_all_that_went_before() -> None:
    bench = bench_with_profile()
    bench.target(20.0)
    bench.set(Object.TARGET_POSITION, "i", 30 * COUNTS)
    bench.control(ENABLED | NEW_SET_POINT)
    bench.control(ENABLED)
    bench.wait_ms(200)
    assert bench.statusword & BIT_12
    bench.target(4.0, AT_ONCE)
    assert not bench.statusword & BIT_12, "a single set-point again: room for one more"
    # Already at the profile velocity, it is as if 4 turns had been the target from the start.
    assert 200 + bench.until_reached() == pytest.approx(duration_ms(4.0) + SETTLED_MS, abs=5)
    bench.wait_ms(100)
    assert bench.turns == pytest.approx(4.0, abs=CLOSE)


def test_at_once_backwards_stops_first() -> None:
    bench = bench_with_profile()
    bench.target(20.0)
    bench.wait_ms(300)
    bench.target(0.0, AT_ONCE)
    begun = bench.turns
    farthest = max(bench.watch(250, lambda: bench.turns))
    assert farthest == pytest.approx(begun + SPEED**2 / (2 * DOWN), abs=0.03)
    bench.until_reached()
    assert bench.turns == pytest.approx(0.0, abs=CLOSE)


def test_on_set_point_passes_the_first_target_without_a_stop() -> None:
    bench = bench_with_profile()
    bench.target(3.0)
    bench.set(Object.TARGET_POSITION, "i", 6 * COUNTS)
    bench.control(ENABLED | NEW_SET_POINT | ON_SET_POINT)
    bench.control(ENABLED | ON_SET_POINT)
    slowest = min(speed for speed in bench.watch(340, lambda: bench.turns_s)[120:])
    assert slowest == pytest.approx(SPEED, rel=0.02)
    assert 340 + bench.until_reached() == pytest.approx(duration_ms(6.0) + SETTLED_MS, abs=5)
    assert bench.turns == pytest.approx(6.0, abs=CLOSE)


def test_a_passed_target_is_not_waited_for_in_its_window() -> None:
    bench = bench_with_profile()
    bench.set(Object.POSITION_WINDOW_TIME, "H", 500)
    bench.target(2.0)
    bench.set(Object.TARGET_POSITION, "i", 4 * COUNTS)
    bench.control(ENABLED | NEW_SET_POINT | ON_SET_POINT)
    assert max(bench.watch(700, lambda: bench.turns)) < 4.05


def test_relative_counts_from_the_target_before() -> None:
    bench = bench_with_profile()
    bench.target(1.0, RELATIVE)
    bench.until_reached()
    bench.target(1.0, RELATIVE)
    bench.until_reached()
    assert bench.turns == pytest.approx(2.0, abs=CLOSE)
    bench.target(3.0, RELATIVE)
    bench.wait_ms(100)
    bench.target(-1.0, RELATIVE | AT_ONCE)
    bench.until_reached()
    assert bench.turns == pytest.approx(4.0, abs=CLOSE), "2 + 3 - 1, though 5 was never reached"


def test_a_limit_switch_ends_a_move() -> None:
    bench = bench_with_profile()
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.fit(0b10, positive=3.0)
    bench.target(10.0)
    bench.set(Object.TARGET_POSITION, "i", 12 * COUNTS)
    bench.control(ENABLED | NEW_SET_POINT)
    bench.control(ENABLED)
    bench.wait_until(lambda: bool(bench.statusword & LIMITED), 1000)
    bench.wait_ms(300)
    assert bench.turns == pytest.approx(3.0 + SPEED**2 / (2 * 200.0), abs=0.05)
    assert bench.inputs & 0b111 == 0b010
    assert not bench.statusword & (REACHED | BIT_12), "the waiting set-point is dropped too"
    assert bench.state is State.OPERATION_ENABLED
    standing = bench.turns
    bench.target(12.0)
    bench.wait_ms(200)
    assert bench.turns == pytest.approx(standing, abs=0.02), "no farther"
    bench.target(1.0)
    bench.until_reached()
    assert bench.turns == pytest.approx(1.0, abs=CLOSE), "but back"


def test_end_velocity_carries_the_shaft_past_its_target() -> None:
    bench = bench_with_profile()
    bench.set(0x6082, "I", 2 * RPM_PER_TURN_S * 1000)
    bench.target(3.0)
    bench.wait_until(lambda: bench.turns > 3.1, 1000)
    assert bench.turns_s == pytest.approx(2.0, rel=0.05)


def test_a_mode_that_begins_under_way_comes_to_rest_by_its_ramp() -> None:
    bench = MotionBench(Mode.PROFILE_VELOCITY)
    bench.profile(SPEED, UP, DOWN)
    bench.speed(SPEED)
    bench.wait_ms(5)
    bench.until_reached()
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_POSITION)
    begun = bench.turns
    bench.until_reached()
    assert bench.turns - begun == pytest.approx(SPEED**2 / (2 * DOWN), abs=0.03)


def test_a_position_beyond_the_turn_of_the_integer_is_reached_through_the_wrap() -> None:
    bench = bench_with_profile(DriveParameters(encoder_counts_per_revolution=1 << 28))
    bench.set(Object.FOLLOWING_ERROR_WINDOW, "I", 0xFFFF_FFFF)
    for _ in range(3):
        bench.set(Object.TARGET_POSITION, "i", 3 << 28)
        bench.control(ENABLED | NEW_SET_POINT | RELATIVE)
        bench.control(ENABLED)
        bench.until_reached()
    position = bench.read(Object.POSITION_ACTUAL_VALUE, "i")
    assert position / (1 << 28) == pytest.approx(9 - 16, abs=CLOSE)


def test_the_motion_does_not_depend_on_how_often_the_drive_is_asked() -> None:
    def run(pieces: int) -> bytes:
        bench = bench_with_profile()
        bench.target(2.0)
        for _ in range(300 * pieces):
            bench.wait_ms(1 / pieces)
            bench.sync()
        return bench.servo.drive.firmware.inner.state()

    assert run(1) == run(4)


def test_a_coarse_grid_of_inner_ticks_moves_alike() -> None:
    assert FirmwareParameters(inner_rate_hz=4000).inner_rate_hz == 4000
    bench = bench_with_profile(DriveParameters(inner_rate_hz=4000))
    bench.target(5.0)
    assert bench.until_reached() == pytest.approx(duration_ms(5.0) + SETTLED_MS, abs=5)


def test_speed_never_jumps_more_than_the_profile_allows() -> None:
    bench = bench_with_profile()
    bench.target(4.0)
    speeds = bench.watch(500, lambda: bench.turns_s)
    assert max(abs(later - speed) for speed, later in pairwise(speeds)) < UP * 1e-3 + COUNT_PER_PERIOD
