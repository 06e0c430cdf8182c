"""The cyclic synchronous modes over the frames of the whole drive: what is followed, how soon and closely."""

import math

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State
from servobench.virtual_bus.drive.machine import MACHINE
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import (
    BIT_12,
    BIT_13,
    COUNTS,
    ENABLED,
    HALT,
    INPUTS_HELD,
    LIMITED,
    RPM_PER_TURN_S,
    MotionBench,
)

MILLI_RPM = RPM_PER_TURN_S * 1000
CSP, CSV, CST = (
    Mode.CYCLIC_SYNCHRONOUS_POSITION,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE,
)
LOAD = 0x2100


def position_bench(period_ms: int = 1) -> MotionBench:
    """CSP with 60C2h set; RPDO2 carries controlword and target position."""
    bench = MotionBench(CSP, enabled=False)
    bench.set(Object.INTERPOLATION_TIME_PERIOD, "B", period_ms, 1)
    bench.map_rpdo(2, 0x6040_0010, 0x607A_0020)
    bench.enable()
    return bench


def go_to(bench: MotionBench, turns: float) -> None:
    bench.send(2, "Hi", ENABLED, round(turns * COUNTS))


def lag(bench: MotionBench) -> float:
    """60F4h, turns."""
    return bench.read(Object.FOLLOWING_ERROR_ACTUAL_VALUE, "i") / COUNTS


# ---- position ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("period_ms", [1, 2, 10])
def test_set_points_are_joined_by_straight_lines(period_ms: int) -> None:
    """A ramp of 10 turns/s in set-points: the shaft runs evenly, one interpolation period behind."""
    bench = position_bench(period_ms)
    speeds: list[float] = []
    for cycle in range(200 // period_ms):
        go_to(bench, 10.0 * cycle * period_ms / 1000)
        for _ in range(period_ms):
            bench.wait_ms(1)
            speeds.append(bench.turns_s)
    assert speeds[100:] == pytest.approx([10.0] * len(speeds[100:]), abs=0.4)
    last = 10.0 * (200 // period_ms - 1) * period_ms / 1000
    assert bench.turns == pytest.approx(last, abs=10.0 * 1.5e-3)
    assert abs(lag(bench)) < 0.005


@pytest.mark.parametrize("phase_ms", [0.0, 0.3, 0.9])
def test_set_points_that_wait_for_a_sync_run_as_evenly(phase_ms: float) -> None:
    bench = position_bench()
    bench.set(0x1401, "B", 1, 2)
    bench.wait_ms(phase_ms)
    speeds: list[float] = []
    for cycle in range(200):
        bench.sync()
        bench.wait_ms(0.7)
        go_to(bench, 0.005 * cycle)
        bench.wait_ms(0.3)
        speeds.append(bench.turns_s)
    assert speeds[100:] == pytest.approx([5.0] * 100, abs=0.4)
    assert abs(lag(bench)) < 0.005


def test_a_sine_is_followed_closely() -> None:
    bench = position_bench()
    worst = 0.0
    for cycle in range(500):
        go_to(bench, 0.5 - 0.5 * math.cos(0.004 * cycle * math.pi))
        bench.wait_ms(1)
        worst = max(worst, abs(lag(bench)))
    assert worst < 0.003
    assert not bench.statusword & (BIT_13 | LIMITED)
    assert bench.statusword & BIT_12


def test_without_another_set_point_the_shaft_stays_at_the_last_one() -> None:
    bench = position_bench()
    for cycle in range(100):
        go_to(bench, 0.01 * cycle)
        bench.wait_ms(1)
    bench.wait_ms(200)
    assert bench.turns == pytest.approx(0.99, abs=0.002)
    assert abs(bench.turns_s) < 0.05


def test_a_missing_set_point_costs_no_jump() -> None:
    bench = position_bench()
    speeds = []
    for cycle in range(200):
        if cycle % 10:
            go_to(bench, 0.005 * cycle)
        bench.wait_ms(1)
        speeds.append(bench.turns_s)
    assert max(speeds[50:]) < 2.2 * 5.0
    assert abs(lag(bench)) < 0.01


def test_the_position_offset_is_added() -> None:
    bench = position_bench()
    bench.set(Object.POSITION_OFFSET, "i", COUNTS // 100)
    go_to(bench, 0.02)
    bench.wait_ms(300)
    assert bench.turns == pytest.approx(0.03, abs=0.001)


def test_the_velocity_offset_is_fed_forward_in_the_place_of_the_drives_own() -> None:
    def worst_lag(offset: float) -> float:
        bench = position_bench()
        bench.set(Object.VELOCITY_OFFSET, "i", round(offset * MILLI_RPM))
        worst = 0.0
        for cycle in range(200):
            go_to(bench, 0.005 * cycle)
            bench.wait_ms(1)
            worst = max(worst, abs(lag(bench)) if cycle > 150 else 0.0)
        return worst

    gain = 0.25 * math.tau * 30.0
    assert worst_lag(0.0) < 0.005
    assert worst_lag(5.0) < 0.005
    assert worst_lag(3.0) == pytest.approx(2.0 / gain, rel=0.1), "the position loop makes up for the rest"


def test_the_torque_offset_is_fed_forward() -> None:
    def dip(feed_raw: int) -> float:
        bench = position_bench()
        go_to(bench, 0.0)
        bench.wait_ms(50)
        bench.set(LOAD, "i", 1000, 1)
        bench.set(Object.TORQUE_OFFSET, "h", feed_raw)
        return max(abs(place) for place in bench.watch(100, lambda: bench.turns))

    assert dip(500) < 0.2 * dip(0)


def test_the_target_is_cut_at_the_software_limits() -> None:
    bench = position_bench()
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -COUNTS // 4, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", COUNTS // 4, 2)
    for cycle in range(200):
        go_to(bench, 0.005 * cycle)
        bench.wait_ms(1)
    bench.wait_ms(100)
    assert bench.turns == pytest.approx(0.25, abs=0.002)
    assert bench.statusword & LIMITED


def test_a_set_point_beyond_reach_is_a_following_error() -> None:
    bench = position_bench()
    bench.set(Object.MAX_TORQUE, "H", 100)
    go_to(bench, 30.0)
    bench.wait_until(lambda: bench.state is not State.OPERATION_ENABLED, 200)
    assert bench.statusword & BIT_13
    assert bench.emergencies() == [0x8611]
    bench.wait_until(lambda: bench.state is State.FAULT, 3000)
    assert abs(bench.turns_s) < 0.2


def test_the_speed_limit_of_the_motor_holds() -> None:
    bench = position_bench(period_ms=100)
    bench.set(Object.MAX_MOTOR_SPEED, "I", 2 * RPM_PER_TURN_S)
    bench.set(Object.FOLLOWING_ERROR_WINDOW, "I", 0xFFFF_FFFF)
    go_to(bench, 1.0)
    fastest = max(bench.watch(400, lambda: bench.turns_s))
    assert fastest == pytest.approx(2.0, abs=0.3)
    bench.wait_ms(500)
    assert bench.turns == pytest.approx(1.0, abs=0.002)


def test_positions_wrap_as_integer32() -> None:
    bench = MotionBench(CSP, DriveParameters(encoder_counts_per_revolution=1 << 28), enabled=False)
    bench.set(Object.FOLLOWING_ERROR_WINDOW, "I", 0xFFFF_FFFF)
    bench.map_rpdo(2, 0x6040_0010, 0x607A_0020)
    bench.enable()
    for cycle in range(1000):
        raw = (round(0.01 * cycle * (1 << 28)) + (1 << 31)) % (1 << 32) - (1 << 31)
        bench.send(2, "Hi", ENABLED, raw)
        bench.wait_ms(1)
    bench.wait_ms(50)
    assert bench.read(0x6064, "i") / (1 << 28) == pytest.approx(9.99 - 16.0, abs=0.003)


@pytest.mark.parametrize("kind", ["switch", "held"])
def test_a_limit_switch_bars_the_way_and_bit_12_says_so(kind: str) -> None:
    bench = position_bench()
    if kind == "switch":
        bench.fit(0b10, positive=0.5)
    for cycle in range(300):
        go_to(bench, 0.005 * cycle)
        bench.wait_ms(1)
        if kind == "held" and cycle == 100:
            bench.set(MACHINE, "I", 0b10, INPUTS_HELD)
    assert bench.statusword & (BIT_12 | BIT_13 | LIMITED) == LIMITED
    assert bench.state is State.OPERATION_ENABLED
    standing = bench.turns
    assert 0.49 < standing < 0.65
    go_to(bench, standing - 0.2)
    bench.wait_ms(200)
    assert bench.turns == pytest.approx(standing - 0.2, abs=0.01)
    assert bench.statusword & (BIT_12 | LIMITED) == BIT_12


# ---- velocity ---------------------------------------------------------------------------------------------


def velocity_bench(period_ms: int = 1) -> MotionBench:
    bench = MotionBench(CSV, enabled=False)
    bench.set(Object.INTERPOLATION_TIME_PERIOD, "B", period_ms, 1)
    bench.enable()
    return bench


@pytest.mark.parametrize("period_ms", [20, 100])
def test_a_speed_is_reached_at_the_end_of_the_interpolation_period(period_ms: int) -> None:
    bench = velocity_bench(period_ms)
    bench.speed(5.0)
    for passed in range(1, period_ms + 1):
        bench.wait_ms(1)
        assert bench.turns_s == pytest.approx(5.0 * passed / period_ms, abs=0.4)
    bench.wait_ms(30)
    assert bench.turns_s == pytest.approx(5.0, abs=0.1)
    assert bench.statusword & BIT_12


def test_60c5_and_60c6_bound_the_change_of_speed() -> None:
    bench = velocity_bench()
    bench.set(Object.MAX_ACCELERATION, "I", 100 * RPM_PER_TURN_S)
    bench.set(Object.MAX_DECELERATION, "I", 50 * RPM_PER_TURN_S)
    bench.speed(10.0)
    bench.wait_ms(50)
    assert bench.turns_s == pytest.approx(5.0, abs=0.3)
    assert bench.statusword & LIMITED
    bench.wait_ms(70)
    assert not bench.statusword & LIMITED
    bench.speed(0.0)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(5.0, abs=0.3)


def test_offsets_are_added_and_fed_forward() -> None:
    bench = velocity_bench(10)
    bench.speed(3.0)
    bench.set(Object.VELOCITY_OFFSET, "i", 2 * MILLI_RPM)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(5.0, abs=0.15)

    def dip(feed_raw: int) -> float:
        loaded = velocity_bench()
        loaded.speed(5.0)
        loaded.wait_ms(200)
        loaded.set(LOAD, "i", 1000, 1)
        loaded.set(Object.TORQUE_OFFSET, "h", feed_raw)
        return 5.0 - min(loaded.watch(60, lambda: loaded.turns_s))

    assert dip(500) < 0.4 * dip(0)


def test_the_speed_limit_cuts_the_target() -> None:
    bench = velocity_bench()
    bench.set(Object.MAX_MOTOR_SPEED, "I", 2 * RPM_PER_TURN_S)
    bench.speed(-9.0)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(-2.0, abs=0.1)
    assert bench.statusword & LIMITED


def test_halt_is_no_bit_of_the_cyclic_modes() -> None:
    bench = velocity_bench()
    bench.speed(5.0)
    bench.wait_ms(50)
    bench.control(ENABLED | HALT)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(5.0, abs=0.1)


def test_the_software_limit_ends_a_velocity() -> None:
    bench = velocity_bench()
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -COUNTS, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", COUNTS, 2)
    bench.speed(10.0)
    bench.wait_ms(500)
    assert bench.turns == pytest.approx(1.0, abs=0.05)
    assert bench.statusword & (BIT_12 | LIMITED) == LIMITED
    bench.speed(-1.0)
    bench.wait_ms(50)
    assert bench.statusword & (BIT_12 | LIMITED) == BIT_12


# ---- torque -----------------------------------------------------------------------------------------------


@pytest.fixture
def torque_bench() -> MotionBench:
    return MotionBench(CST, DriveParameters(brake_torque_nm=0.0))


def test_the_torque_offset_is_added_to_the_target(torque_bench: MotionBench) -> None:
    torque_bench.set(Object.TARGET_TORQUE, "h", 200)
    torque_bench.set(Object.TORQUE_OFFSET, "h", -50)
    torque_bench.wait_ms(5)
    assert torque_bench.read(Object.TORQUE_DEMAND, "h") == 150
    assert torque_bench.read(Object.TORQUE_ACTUAL_VALUE, "h") == pytest.approx(150, abs=2)


def test_ends_of_the_axis_hold_in_torque_too(torque_bench: MotionBench) -> None:
    bench = torque_bench
    bench.set(Object.QUICK_STOP_DECELERATION, "I", 200 * RPM_PER_TURN_S)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -COUNTS, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 2 * COUNTS, 2)
    bench.set(Object.TARGET_TORQUE, "h", 300)
    bench.wait_ms(800)
    assert bench.turns == pytest.approx(2.0, abs=0.05)
    assert bench.statusword & (BIT_12 | LIMITED) == LIMITED
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 0x7FFF_FFFF, 2)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -0x8000_0000, 1)
    bench.wait_ms(20)
    assert bench.statusword & BIT_12, "without limits the target acts again"
    assert bench.read(Object.TORQUE_DEMAND, "h") == 300
    before = bench.speed_rad_s
    bench.wait_ms(10)
    gained = bench.speed_rad_s - before
    friction_nm = LING.viscous_friction_nm_s * (before + gained / 2)
    assert gained == pytest.approx((0.6 - friction_nm) / LING.inertia_kg_m2 * 0.010, rel=0.02)


def test_a_limit_switch_in_torque_lets_the_other_way_free(torque_bench: MotionBench) -> None:
    bench = torque_bench
    bench.fit(0b01, negative=-0.5)
    bench.set(Object.TARGET_TORQUE, "h", -200)
    bench.wait_ms(400)
    assert bench.statusword & (BIT_12 | LIMITED) == LIMITED
    assert abs(bench.turns_s) < 0.05
    bench.set(Object.TARGET_TORQUE, "h", 200)
    bench.wait_ms(50)
    assert bench.statusword & (BIT_12 | LIMITED) == BIT_12
    assert bench.turns_s > 1.0


def test_a_following_error_from_elsewhere_is_no_bit_of_a_mode_without_one(torque_bench: MotionBench) -> None:
    torque_bench.servo.drive.fail(0x8611, ErrorRegister.DEVICE_PROFILE)
    assert torque_bench.read(Object.ERROR_CODE, "H") == 0x8611
    assert not torque_bench.statusword & BIT_13


# ---- from one mode into another ---------------------------------------------------------------------------


@pytest.mark.parametrize("start", list(Mode)[1:])
@pytest.mark.parametrize("end", list(Mode)[1:])
def test_every_mode_follows_every_other_without_leaving_operation(start: Mode, end: Mode) -> None:
    """A resting shaft with set-points of rest stays at rest, and the display follows at once."""
    offered = MotionBench(CST, enabled=False).read(Object.SUPPORTED_DRIVE_MODES, "I")
    if not (offered >> (start - 1) & offered >> (end - 1) & 1):
        return
    bench = MotionBench(start)
    bench.set(Object.MODES_OF_OPERATION, "b", end)
    assert bench.read(Object.MODES_OF_OPERATION_DISPLAY, "b") == end
    bench.wait_ms(100)
    assert bench.state is State.OPERATION_ENABLED
    assert bench.turns == pytest.approx(0.0, abs=0.001)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.NONE)
    assert bench.read(Object.MODES_OF_OPERATION_DISPLAY, "b") == end, "0 is no change"
