"""Interpolated position over the frames of the whole drive: tracking, bit 4, and set-points that cease."""

import math

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

INTERPOLATING = ENABLED | 0x10
RECORD = Object.INTERPOLATION_DATA_RECORD
PERIOD_MS = 4


def line_bench(controlword: int = INTERPOLATING) -> MotionBench:
    """60C2h set; RPDO2 carries controlword and 60C1h:1."""
    bench = MotionBench(Mode.INTERPOLATED_POSITION, enabled=False)
    bench.set(Object.INTERPOLATION_TIME_PERIOD, "B", PERIOD_MS, 1)
    bench.map_rpdo(2, 0x6040_0010, 0x60C1_0120)
    bench.enable()
    bench.control(controlword)
    return bench


def go_to(bench: MotionBench, turns: float, controlword: int = INTERPOLATING) -> None:
    bench.send(2, "Hi", controlword, round(turns * COUNTS))


def demanded(bench: MotionBench) -> float:
    """6062h, turns."""
    return bench.read(Object.POSITION_DEMAND_VALUE, "i") / COUNTS


def test_between_set_points_the_demand_is_a_straight_line() -> None:
    bench = line_bench()
    go_to(bench, 0.0)
    bench.wait_ms(PERIOD_MS)
    for target, before in ((0.02, 0.0), (0.03, 0.02), (0.0, 0.03)):
        go_to(bench, target)
        step = (target - before) / PERIOD_MS
        bench.wait_ms(1)
        place = demanded(bench)
        assert 0.0 <= (place - before) / step <= 1.0, "as of the last motion period"
        for _ in range(PERIOD_MS - 1):
            bench.wait_ms(1)
            assert demanded(bench) - place == pytest.approx(step, abs=4 / COUNTS)
            place = demanded(bench)
    bench.wait_ms(1)
    assert demanded(bench) == pytest.approx(0.0, abs=1 / COUNTS)


def test_a_stream_of_set_points_is_tracked() -> None:
    bench = line_bench()
    worst = 0.0
    for cycle in range(250):
        go_to(bench, 0.5 - 0.5 * math.cos(0.004 * PERIOD_MS * cycle * math.pi))
        assert cycle < 2 or bench.statusword & BIT_12, "interpolation is active"
        bench.wait_ms(PERIOD_MS)
        worst = max(worst, abs(bench.read(Object.FOLLOWING_ERROR_ACTUAL_VALUE, "i")) / COUNTS)
    assert worst < 0.004
    assert not bench.statusword & (BIT_13 | LIMITED)


def test_without_bit_4_set_points_wait_and_the_last_is_in_force_from_its_edge_on() -> None:
    bench = line_bench(ENABLED)
    go_to(bench, 0.03, ENABLED)
    go_to(bench, 0.05, ENABLED)
    bench.wait_ms(50)
    assert bench.turns == pytest.approx(0.0, abs=1e-3)
    assert not bench.statusword & (BIT_12 | REACHED)
    bench.control(INTERPOLATING)
    assert bench.statusword & BIT_12
    bench.until_reached(500)
    assert bench.turns == pytest.approx(0.05, abs=0.002)


def test_bit_4_taken_back_brings_the_shaft_to_rest_by_6084() -> None:
    bench = line_bench()
    bench.set(Object.PROFILE_DECELERATION, "I", 3000)
    for cycle in range(50):
        go_to(bench, 0.02 * cycle)
        bench.wait_ms(PERIOD_MS)
    begun, started = bench.turns, bench.turns_s
    assert started == pytest.approx(5.0, abs=0.3)
    go_to(bench, 1.0, ENABLED)
    bench.wait_ms(200)
    assert bench.turns - begun == pytest.approx(started**2 / (2 * 50), abs=0.02)
    assert abs(bench.turns_s) < 0.05
    assert bench.state is State.OPERATION_ENABLED


def test_set_points_that_cease_leave_the_shaft_at_the_last_one() -> None:
    bench = line_bench()
    for cycle in range(50):
        go_to(bench, 0.02 * cycle)
        bench.wait_ms(PERIOD_MS)
    bench.wait_ms(200)
    assert bench.turns == pytest.approx(0.98, abs=0.002)
    assert abs(bench.turns_s) < 0.05
    assert bench.statusword & REACHED


def test_a_deadline_of_the_rpdo_stops_it_by_6007() -> None:
    bench = line_bench()
    bench.set(0x1401, "H", 20, 5)
    for cycle in range(50):
        go_to(bench, 0.02 * cycle)
        bench.wait_ms(PERIOD_MS)
    bench.wait_until(lambda: bench.state is State.SWITCH_ON_DISABLED, 500)
    assert 0x8250 in bench.emergencies()
    assert abs(bench.turns_s) < 0.1


def test_a_halt_stops_and_its_end_leads_to_the_set_point_in_force() -> None:
    bench = line_bench()
    for cycle in range(50):
        go_to(bench, 0.02 * cycle)
        bench.wait_ms(PERIOD_MS)
    bench.control(INTERPOLATING | HALT)
    bench.until_reached(500)
    standing = bench.turns
    assert not bench.statusword & BIT_12
    go_to(bench, standing + 0.02, INTERPOLATING | HALT)
    bench.wait_ms(50)
    assert bench.turns == pytest.approx(standing, abs=0.002)
    bench.control(INTERPOLATING)
    bench.until_reached(500)
    assert bench.turns == pytest.approx(standing + 0.02, abs=0.002)


def test_a_limit_switch_bars_the_way_and_bit_12_says_so() -> None:
    bench = line_bench()
    bench.fit(0b10, positive=0.5)
    for cycle in range(40):
        go_to(bench, 0.02 * cycle)
        bench.wait_ms(PERIOD_MS)
    assert bench.statusword & (BIT_12 | LIMITED) == LIMITED
    assert bench.state is State.OPERATION_ENABLED


def test_a_set_point_beyond_reach_is_a_following_error_without_a_bit_of_its_own() -> None:
    bench = line_bench()
    bench.set(Object.MAX_TORQUE, "H", 100)
    go_to(bench, 30.0)
    bench.wait_until(lambda: bench.state is not State.OPERATION_ENABLED, 200)
    assert bench.emergencies() == [0x8611]
    assert not bench.statusword & BIT_13
