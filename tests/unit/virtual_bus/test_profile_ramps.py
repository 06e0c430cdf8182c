"""6086h, 60A3h and 60A4h: the form of the ramps in profile position and profile velocity (CiA 402-2)."""

import math
from itertools import pairwise

import pytest

from servobench.drivers.cia402.objects402 import Object, Unit, unit_word
from servobench.drivers.cia402.profile import Mode
from tests.unit.virtual_bus.motion_bench import AT_ONCE, COUNTS, RPM_PER_TURN_S, MotionBench

LINEAR, SINE, JERK_FREE, JERK_LIMITED = range(4)
JERK_USE, JERK = 0x60A3, 0x60A4
SPEED, UP, DOWN = 8.0, 80.0, 40.0
"""turns/s, turns/s^2."""
TURNS_S3 = 1600.0
INVALID_VALUE = 0x0609_0030


def shaped(mode: Mode, form: int, jerk_turns_s3: float = TURNS_S3) -> MotionBench:
    bench = MotionBench(mode)
    bench.profile(SPEED, UP, DOWN)
    bench.set(Object.MOTION_PROFILE_TYPE, "h", form)
    bench.set(JERK, "I", round(jerk_turns_s3 * RPM_PER_TURN_S), 1)
    return bench


def ramp_s(form: int, change: float, rate: float, jerk: float = TURNS_S3) -> float:
    if form == SINE:
        return 2.0 * change / rate
    if form == LINEAR:
        return change / rate
    return change / rate + rate / jerk if change >= rate * rate / jerk else 2.0 * math.sqrt(change / jerk)


def demanded(bench: MotionBench) -> float:
    """606Bh, turns/s."""
    return bench.read(Object.VELOCITY_DEMAND_VALUE, "i") / RPM_PER_TURN_S / 1000


@pytest.mark.parametrize("form", [LINEAR, SINE, JERK_LIMITED])
@pytest.mark.parametrize(("start", "target", "rate"), [(0.0, 4.0, UP), (4.0, 1.0, DOWN), (0.0, -0.5, UP)])
def test_a_change_of_speed_takes_the_time_of_its_ramp(
    form: int, start: float, target: float, rate: float
) -> None:
    bench = shaped(Mode.PROFILE_VELOCITY, form)
    bench.speed(start)
    bench.wait_ms(600)
    bench.speed(target)
    seen = [demanded(bench), *bench.watch(400, lambda: demanded(bench))]
    lasted = next(ms for ms, speed in enumerate(seen) if abs(speed - target) < 1e-3)
    assert lasted == pytest.approx(1000 * ramp_s(form, abs(target - start), rate), abs=5)
    half = next(ms for ms, speed in enumerate(seen) if abs(speed - start) >= 0.5 * abs(target - start))
    assert half == pytest.approx(0.5 * lasted, abs=3)
    steps = [abs(after - before) for before, after in pairwise(seen)]
    peak = rate if form != JERK_LIMITED else min(rate, math.sqrt(TURNS_S3 * abs(target - start)))
    assert max(steps) == pytest.approx(peak / 1000, rel=0.05)
    bends = [abs(after - before) for before, after in pairwise(steps)]
    if form == JERK_LIMITED:
        assert max(bends) <= TURNS_S3 * 1e-6 * 1.05 + 2e-4
    assert (max(bends) > 0.5 * rate / 1000) is (form == LINEAR)


@pytest.mark.parametrize("form", [LINEAR, SINE, JERK_LIMITED])
def test_a_move_takes_the_time_of_its_ramps(form: int) -> None:
    bench = shaped(Mode.PROFILE_POSITION, form)
    bench.set(Object.POSITION_WINDOW, "I", 0xFFFF_FFFF)
    bench.set(Object.POSITION_WINDOW_TIME, "H", 0)
    up, down = ramp_s(form, SPEED, UP), ramp_s(form, SPEED, DOWN)
    bench.target(6.0)
    lasted = bench.until_reached()
    assert lasted == pytest.approx(1000 * (up + down + 6.0 / SPEED - 0.5 * (up + down)), abs=4)
    bench.wait_ms(300)
    assert bench.turns == pytest.approx(6.0, abs=2e-3)
    bench.target(6.05)
    bench.wait_ms(500)
    assert bench.turns == pytest.approx(6.05, abs=2e-3)


def test_a_target_that_changes_at_once_does_not_jerk() -> None:
    bench = shaped(Mode.PROFILE_POSITION, JERK_LIMITED)
    bench.target(6.0)
    bench.wait_ms(80)
    bench.target(0.5, AT_ONCE)
    seen = bench.watch(900, lambda: bench.read(Object.POSITION_DEMAND_VALUE, "i") / COUNTS)
    speeds = [(after - before) * 1000 for before, after in pairwise(seen)]
    rates = [(after - before) * 1000 for before, after in pairwise(speeds)]
    assert (
        max(abs(after - before) for before, after in pairwise(rates))
        <= 1000 / COUNTS * 4000 + 0.001 * TURNS_S3
    )
    assert bench.turns == pytest.approx(0.5, abs=2e-3)


def test_another_jerk_counts_at_once_in_profile_velocity() -> None:
    bench = shaped(Mode.PROFILE_VELOCITY, JERK_LIMITED, 40.0)
    bench.speed(4.0)
    bench.wait_ms(20)
    bench.set(JERK, "I", round(TURNS_S3 * RPM_PER_TURN_S), 1)
    took = bench.wait_until(lambda: abs(demanded(bench) - 4.0) < 1e-3, 1000)
    assert took == pytest.approx(1000 * ramp_s(JERK_LIMITED, 4.0, UP), abs=8)


def test_the_unit_of_the_jerk_is_that_of_60abh() -> None:
    bench = MotionBench(Mode.PROFILE_VELOCITY, enabled=False)
    bench.set(Object.SI_UNIT_JERK, "I", unit_word(0, Unit.REVOLUTION, Unit.CUBIC_SECOND))
    bench.enable()
    bench.profile(SPEED, UP, DOWN)
    bench.set(Object.MOTION_PROFILE_TYPE, "h", JERK_LIMITED)
    bench.set(JERK, "I", round(TURNS_S3), 1)
    bench.speed(4.0)
    took = bench.wait_until(lambda: abs(demanded(bench) - 4.0) < 1e-3, 1000)
    assert took == pytest.approx(1000 * ramp_s(JERK_LIMITED, 4.0, UP), abs=3)


@pytest.mark.parametrize(
    ("index", "code", "sub", "value"),
    [
        (Object.MOTION_PROFILE_TYPE, "h", 0, JERK_FREE),
        (Object.MOTION_PROFILE_TYPE, "h", 0, -1),
        (JERK_USE, "B", 0, 2),
        (JERK_USE, "B", 0, 0),
    ],
)
def test_a_form_that_the_drive_lacks_is_refused(index: int, code: str, sub: int, value: int) -> None:
    assert MotionBench(Mode.PROFILE_POSITION).write(index, code, value, sub) == INVALID_VALUE


def test_no_jerk_is_refused() -> None:
    assert MotionBench(Mode.PROFILE_POSITION).write(JERK, "I", 0, 1) is not None
