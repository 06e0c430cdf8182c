"""607Bh, positions that wrap, and bits 6 and 7 of 60F2h, by which way a move then goes (CiA 402-2)."""

from itertools import pairwise

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from tests.unit.virtual_bus.motion_bench import COUNTS, ENABLED, LIMITED, NEW_SET_POINT, RELATIVE, MotionBench

RANGE = 0x607B
LINEAR, NEGATIVE, POSITIVE, SHORTEST = 0x00, 0x40, 0x80, 0xC0
FULL = 360
"""Position units of a turn."""
CLOSE = 3


def ranged(mode: Mode, low: int = 0, high: int = FULL) -> MotionBench:
    """In degrees, without a home."""
    bench = MotionBench(mode, enabled=False)
    bench.set(Object.FEED_CONSTANT, "I", FULL, 1)
    bench.set(RANGE, "i", low, 1)
    bench.set(RANGE, "i", high, 2)
    bench.enable()
    bench.set(Object.PROFILE_ACCELERATION, "I", 6000)
    bench.set(Object.PROFILE_DECELERATION, "I", 6000)
    bench.set(Object.POSITION_WINDOW, "I", 1)
    return bench


def place(bench: MotionBench) -> int:
    return bench.read(Object.POSITION_ACTUAL_VALUE, "i")


def travelled(bench: MotionBench) -> float:
    """Degrees since power-on, without a wrap."""
    return bench.read(Object.POSITION_ACTUAL_INTERNAL_VALUE, "i") * FULL / COUNTS


def moved(bench: MotionBench, target: int, flags: int = 0) -> float:
    """Degrees that the shaft has turned to get there."""
    before = travelled(bench)
    bench.set(Object.TARGET_POSITION, "i", target)
    bench.control(ENABLED | NEW_SET_POINT | flags)
    bench.control(ENABLED)
    bench.until_reached(10_000)
    return travelled(bench) - before


@pytest.mark.parametrize(("low", "high"), [(0, FULL), (-180, 180), (1000, 1360), (-7, 4)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_actual_and_the_demand_value_wrap(low: int, high: int, sign: int) -> None:
    """607Bh: a value that reaches or exceeds the range goes on at its other end."""
    bench = ranged(Mode.PROFILE_VELOCITY, low, high)
    bench.speed(sign * 2.0)
    seen = bench.watch(1200, lambda: place(bench))
    assert min(seen) == low
    assert max(seen) == high - 1, "both ends are one place"
    turns = sum(abs(after - before) > (high - low) // 2 for before, after in pairwise(seen))
    assert turns == pytest.approx(abs(travelled(bench)) / (high - low), abs=1)
    away = (travelled(bench) - place(bench)) % (high - low)
    assert min(away, high - low - away) <= 0.5
    demand = bench.read(Object.POSITION_DEMAND_VALUE, "i")
    assert abs((demand - place(bench) + 1) % (high - low)) <= 2


def test_a_mapped_position_wraps_as_an_asked_one() -> None:
    bench = ranged(Mode.PROFILE_VELOCITY, -5, 5)
    bench.map_tpdo(3, Object.POSITION_ACTUAL_VALUE << 16 | 32, kind=1)
    bench.speed(1.0)
    told = set()
    for _ in range(30):
        bench.wait_ms(3)
        bench.sync()
        [frame] = [each for each in bench.sent[-8:] if each.can_id == 0x381][-1:]
        told.add(int.from_bytes(frame.data, "little", signed=True))
        assert int.from_bytes(frame.data, "little", signed=True) == place(bench)
    assert {min(told), max(told)} == {-5, 4}


@pytest.mark.parametrize(
    ("option", "ways"),
    [
        (LINEAR, [350, -340, 170, 0]),
        (NEGATIVE, [-10, -340, -190, 0]),
        (POSITIVE, [350, 20, 170, 0]),
        (SHORTEST, [-10, 20, 170, 0]),
    ],
)
def test_a_move_goes_the_way_that_60f2h_says(option: int, ways: list[int]) -> None:
    """60F2h bits 6 and 7, rotary axis direction option: 00 linear, 01 negative, 10 positive, 11 shortest."""
    bench = ranged(Mode.PROFILE_POSITION)
    bench.set(Object.POSITIONING_OPTION_CODE, "H", option)
    for target, way in zip((350, 10, 180, 180), ways, strict=True):
        assert moved(bench, target) == pytest.approx(way, abs=CLOSE)
        assert place(bench) == pytest.approx(target, abs=CLOSE)


def test_a_shaft_that_is_pushed_beyond_its_target_does_not_go_round_to_it() -> None:
    bench = ranged(Mode.PROFILE_POSITION)
    bench.set(Object.POSITIONING_OPTION_CODE, "H", POSITIVE)
    moved(bench, 180)
    bench.set(0x2100, "i", -2000, 1)
    bench.wait_until(lambda: place(bench) > 181, 100)
    assert moved(bench, 180) == pytest.approx(0, abs=CLOSE)


def test_of_two_ways_alike_the_shortest_is_the_positive_one() -> None:
    bench = ranged(Mode.PROFILE_POSITION)
    bench.set(Object.POSITIONING_OPTION_CODE, "H", SHORTEST)
    assert moved(bench, 180) == pytest.approx(180, abs=CLOSE)
    assert moved(bench, 0) == pytest.approx(180, abs=CLOSE)


@pytest.mark.parametrize("option", [LINEAR, NEGATIVE, POSITIVE, SHORTEST])
def test_a_relative_move_may_be_more_than_a_turn(option: int) -> None:
    bench = ranged(Mode.PROFILE_POSITION)
    bench.set(Object.POSITIONING_OPTION_CODE, "H", option)
    assert moved(bench, 800, RELATIVE) == pytest.approx(800, abs=CLOSE)
    assert place(bench) == pytest.approx(80, abs=CLOSE)
    assert moved(bench, -500, RELATIVE) == pytest.approx(-500, abs=CLOSE)
    assert place(bench) == pytest.approx(300, abs=CLOSE)


def test_a_target_outside_of_the_range_is_wrapped() -> None:
    bench = ranged(Mode.PROFILE_POSITION)
    assert moved(bench, 730) == pytest.approx(10, abs=CLOSE)
    assert moved(bench, -10) == pytest.approx(340, abs=CLOSE)


def test_software_limits_prevent_the_wrap() -> None:
    """607Dh bounds the target that 607Bh has wrapped."""
    bench = ranged(Mode.PROFILE_POSITION)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 20, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 340, 2)
    assert moved(bench, 355) == pytest.approx(340, abs=CLOSE)
    assert bench.statusword & LIMITED
    assert moved(bench, 370) == pytest.approx(-320, abs=CLOSE)


def test_a_free_motion_stops_at_a_software_limit_after_turns_of_the_range() -> None:
    bench = ranged(Mode.PROFILE_VELOCITY)
    bench.speed(2.0)
    bench.wait_until(lambda: travelled(bench) > 2.1 * FULL, 5000)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 1, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 340, 2)
    bench.wait_ms(2000)
    assert bench.statusword & LIMITED
    assert place(bench) == pytest.approx(340, abs=CLOSE)
    assert travelled(bench) == pytest.approx(2 * FULL + 340, abs=CLOSE)


@pytest.mark.parametrize("step", [7, -7])
def test_cyclic_set_points_pass_the_wrap_without_a_jump(step: int) -> None:
    bench = ranged(Mode.CYCLIC_SYNCHRONOUS_POSITION)
    position = 0
    for _ in range(120):
        position = (position + step) % FULL
        bench.set(Object.TARGET_POSITION, "i", position)
        bench.wait_ms(4)
        assert abs(bench.turns_s) < 8.0
    bench.wait_ms(200)
    assert travelled(bench) == pytest.approx(120 * step, abs=CLOSE)
    assert place(bench) == pytest.approx(position, abs=CLOSE)


@pytest.mark.parametrize(("low", "high"), [(0, 0), (5, 5), (5, -5), (-(2**31), 2**31 - 1)])
def test_without_a_range_positions_are_those_of_an_integer32(low: int, high: int) -> None:
    bench = ranged(Mode.PROFILE_POSITION, low, high)
    bench.set(Object.POSITIONING_OPTION_CODE, "H", NEGATIVE)
    assert moved(bench, 800) == pytest.approx(800, abs=CLOSE)
    assert place(bench) == pytest.approx(800, abs=CLOSE)


def test_a_stored_range_is_there_after_a_reset() -> None:
    bench = ranged(Mode.PROFILE_POSITION)
    bench.control(0x06)
    bench.set(0x1010, "I", 0x6576_6173, 1)
    bench.set(RANGE, "i", 0, 2)
    bench.nmt(0x81)
    bench.wait_ms(300)
    assert bench.read(RANGE, "i", 2) == FULL
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_POSITION)
    bench.enable()
    moved(bench, 730)
    assert place(bench) == pytest.approx(10, abs=CLOSE)
