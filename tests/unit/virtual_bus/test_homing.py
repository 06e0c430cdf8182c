"""Homing over the frames of the whole drive: where each method finds its home, and what it says on the way.

The places that are expected stand here as the standard describes them, not as the drive's table has them.
"""

import math

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State
from servobench.virtual_bus.drive.homing_methods import HOMING_METHODS
from servobench.virtual_bus.drive.machine import MACHINE
from tests.unit.virtual_bus.motion_bench import (
    BIT_12,
    BIT_13,
    COUNTS,
    ENABLED,
    HALT,
    INDEX,
    INPUTS_HELD,
    REACHED,
    RPM_PER_TURN_S,
    MotionBench,
)

START = 0x10
MODE_BITS = REACHED | BIT_12 | BIT_13
UNDER_WAY, NOT_STARTED, DONE, FAILED = 0, REACHED, BIT_12 | REACHED, BIT_13 | REACHED
FAST, SLOW, RATE = 10.0, 2.0, 400.0
"""turns/s, turns/s, turns/s^2."""

NEGATIVE_AT, POSITIVE_AT = -1.6, 1.6
HOME_FROM, HOME_TO = -0.3, 0.4
"""turns."""
PULSE_AT = 0.25
LEFT_EDGE, RIGHT_EDGE = round(HOME_FROM * COUNTS), round(HOME_TO * COUNTS) + 1
NEGATIVE_EDGE, POSITIVE_EDGE = round(NEGATIVE_AT * COUNTS) + 1, round(POSITIVE_AT * COUNTS)
TO_THE_LEFT, TO_THE_RIGHT = -1, +1

PLACES: dict[int, tuple[int, int]] = {
    1: (NEGATIVE_EDGE, TO_THE_RIGHT),
    2: (POSITIVE_EDGE, TO_THE_LEFT),
    3: (LEFT_EDGE, TO_THE_LEFT),
    4: (LEFT_EDGE, TO_THE_RIGHT),
    5: (RIGHT_EDGE, TO_THE_RIGHT),
    6: (RIGHT_EDGE, TO_THE_LEFT),
    7: (LEFT_EDGE, TO_THE_LEFT),
    8: (LEFT_EDGE, TO_THE_RIGHT),
    9: (RIGHT_EDGE, TO_THE_LEFT),
    10: (RIGHT_EDGE, TO_THE_RIGHT),
    11: (RIGHT_EDGE, TO_THE_RIGHT),
    12: (RIGHT_EDGE, TO_THE_LEFT),
    13: (LEFT_EDGE, TO_THE_RIGHT),
    14: (LEFT_EDGE, TO_THE_LEFT),
}
"""Edge and the side of it on which the index pulse is looked for; methods 17..30 end at the edge."""


def pulse_beside(count: float, side: int) -> int:
    """The first index pulse on that side."""
    turns = count / COUNTS - PULSE_AT
    turn = math.floor(turns) + 1 if side > 0 else math.ceil(turns) - 1
    return round((turn + PULSE_AT) * COUNTS)


def home_of(method: int) -> int:
    edge, side = PLACES[method if method <= 14 else method - 16]
    return pulse_beside(edge, side) if method <= 14 else edge


def bench_at(start: float, method: int) -> MotionBench:
    """All switches fitted, the shaft at ``start`` turns, the drive ready for homing."""
    bench = MotionBench(Mode.PROFILE_POSITION)
    bench.profile(20.0, RATE, RATE)
    bench.target(start)
    bench.until_reached()
    # For 3 and 4 the switch reaches to the positive end of the axis, for 5 and 6 to the negative one.
    base = method if method <= 14 else method - 16
    bench.fit(
        0b111,
        negative=NEGATIVE_AT,
        positive=POSITIVE_AT,
        home_from=-9.0 if base in (5, 6) else HOME_FROM,
        home_to=9.0 if base in (3, 4) else HOME_TO,
    )
    bench.set(MACHINE, "I", round(PULSE_AT * COUNTS), INDEX)
    prepare(bench, method)
    return bench


def prepare(bench: MotionBench, method: int) -> None:
    bench.set(Object.HOMING_METHOD, "b", method)
    bench.set(Object.HOMING_SPEEDS, "I", round(FAST * RPM_PER_TURN_S * 1000), 1)
    bench.set(Object.HOMING_SPEEDS, "I", round(SLOW * RPM_PER_TURN_S * 1000), 2)
    bench.set(Object.HOMING_ACCELERATION, "I", round(RATE * RPM_PER_TURN_S))
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.HOMING)
    bench.wait_ms(60)


def home(bench: MotionBench, limit_ms: int = 4000) -> int:
    bench.control(ENABLED | START)
    return bench.wait_until(lambda: bench.statusword & MODE_BITS in (DONE, FAILED), limit_ms)


def zero_count(bench: MotionBench) -> int:
    """The encoder count of position 0."""
    return int(bench.servo.drive.firmware.inner.count) - bench.read(0x6064, "i")


@pytest.mark.parametrize("start", [-1.2, 0.05, 1.1])
@pytest.mark.parametrize("method", [*range(1, 15), *range(17, 31)])
def test_every_method_finds_its_home_from_everywhere(method: int, start: float) -> None:
    bench = bench_at(start, method)
    home(bench)
    assert bench.statusword & MODE_BITS == DONE
    assert zero_count(bench) == pytest.approx(home_of(method), abs=1)
    assert bench.turns * COUNTS == pytest.approx(0.0, abs=COUNTS * (SLOW**2 / (2 * RATE) + 0.01))
    bench.wait_ms(100)
    assert abs(bench.turns_s) < 0.05


@pytest.mark.parametrize(("method", "start"), [(1, -1.8), (17, -1.8), (2, 1.8), (18, 1.8)])
def test_a_start_on_the_limit_switch_leaves_it(method: int, start: float) -> None:
    bench = bench_at(start, method)
    home(bench)
    assert bench.statusword & MODE_BITS == DONE
    assert zero_count(bench) == pytest.approx(home_of(method), abs=1)


@pytest.mark.parametrize(("method", "side"), [(33, TO_THE_LEFT), (34, TO_THE_RIGHT)])
def test_the_next_index_pulse(method: int, side: int) -> None:
    bench = bench_at(0.05, method)
    before = bench.servo.drive.firmware.inner.count
    passed = home(bench)
    assert zero_count(bench) == pulse_beside(before, side)
    way = abs(pulse_beside(before, side) - before) / COUNTS
    # Up to speed, there, and to rest behind it.
    assert passed == pytest.approx(1000 * (way / SLOW + 1.5 * SLOW / RATE), abs=15)
    assert bench.turns == pytest.approx(side * SLOW**2 / (2 * RATE), abs=0.005)


@pytest.mark.parametrize("method", [35, 37])
def test_the_place_where_it_stands(method: int) -> None:
    bench = bench_at(0.7, method)
    bench.set(Object.HOME_OFFSET, "i", 1000)
    home(bench)
    assert bench.read(0x6064, "i") == pytest.approx(-1000, abs=3), "zero is the home plus 607Ch"
    assert bench.read(0x6063, "i") == pytest.approx(-1000, abs=3)


def test_a_home_offset_counts_in_user_units_and_with_their_sign() -> None:
    bench = bench_at(0.0, 35)
    for controlword in (0x07, 0x06):
        bench.control(controlword)
        bench.wait_ms(30)
    bench.set(Object.SI_UNIT_POSITION, "I", 0xFF41_0000)  # tenths of a degree
    bench.set(Object.POLARITY, "B", 0x80)
    bench.set(Object.HOME_OFFSET, "i", 900)
    bench.enable()
    home(bench)
    assert bench.read(0x6064, "i") == pytest.approx(-900, abs=1)
    before = bench.servo.drive.firmware.inner.count
    bench.control(ENABLED)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_POSITION)
    bench.wait_ms(20)
    bench.set(Object.TARGET_POSITION, "i", -2700)
    bench.control(ENABLED | START)
    bench.wait_ms(5)
    bench.until_reached()
    gone = bench.servo.drive.firmware.inner.count - before
    assert gone / COUNTS == pytest.approx(0.5, abs=0.003), "minus 180 degrees are half a turn forwards"


def test_the_bits_from_start_to_end() -> None:
    bench = bench_at(-1.2, 24)
    assert bench.statusword & MODE_BITS == NOT_STARTED
    bench.control(ENABLED | START)
    seen = [UNDER_WAY]
    for _ in range(2000):
        bits = bench.statusword & MODE_BITS
        if bits != seen[-1]:
            seen.append(bits)
        bench.wait_ms(1)
    assert seen == [UNDER_WAY, BIT_12, DONE], "found while it still turns, then at rest"
    bench.control(ENABLED)
    assert bench.statusword & MODE_BITS == DONE, "the end of bit 4 changes nothing any more"


def test_it_searches_fast_and_creeps_slowly() -> None:
    bench = bench_at(-1.2, 24)
    bench.control(ENABLED | START)
    speeds: list[float] = []
    while bench.statusword & MODE_BITS == UNDER_WAY:
        bench.wait_ms(1)
        speeds.append(bench.turns_s)
    assert max(speeds) == pytest.approx(FAST, rel=0.05)
    assert sum(speeds[-4:]) / 4 == pytest.approx(SLOW, rel=0.1)
    assert min(speeds) == pytest.approx(-SLOW, rel=0.2), "back over the edge, before it creeps"


def test_interrupted_by_bit_4_it_stops_and_can_start_anew() -> None:
    bench = bench_at(-1.2, 24)
    bench.control(ENABLED | START)
    bench.wait_ms(60)
    assert bench.turns_s > 5.0
    bench.control(ENABLED)
    bench.wait_ms(100)
    assert bench.statusword & MODE_BITS == NOT_STARTED
    assert abs(bench.turns_s) < 0.05
    home(bench)
    assert zero_count(bench) == pytest.approx(LEFT_EDGE, abs=1)


def test_halted_it_waits_and_goes_on() -> None:
    bench = bench_at(-1.2, 24)
    bench.control(ENABLED | START)
    bench.wait_ms(30)
    bench.control(ENABLED | START | HALT)
    bench.wait_ms(100)
    assert bench.statusword & MODE_BITS == NOT_STARTED
    assert abs(bench.turns_s) < 0.05
    bench.control(ENABLED | START)
    bench.wait_until(lambda: bench.statusword & MODE_BITS == DONE, 3000)
    assert zero_count(bench) == pytest.approx(LEFT_EDGE, abs=1)


@pytest.mark.parametrize("method", [4, 6, 20, 22])
def test_without_a_switch_in_reach_the_end_of_the_axis_is_a_failure(method: int) -> None:
    bench = bench_at(0.0, method)
    bench.set(MACHINE, "B", 0b011, 2)
    home(bench)
    assert bench.statusword & MODE_BITS == FAILED
    assert bench.state is State.OPERATION_ENABLED
    before = zero_count(bench)
    assert before == 0, "the zero stays where it was"


@pytest.mark.parametrize("method", [7, 11, 23, 30])
def test_both_ends_without_a_home_switch_are_a_failure_too(method: int) -> None:
    bench = bench_at(0.0, method)
    bench.set(MACHINE, "B", 0b011, 2)
    home(bench, 6000)
    assert bench.statusword & MODE_BITS == FAILED
    seen = bench.turns
    assert abs(seen) == pytest.approx(1.6, abs=0.3), "after one turn back, at the other end"


@pytest.mark.parametrize(("method", "place"), [(34, 0.15), (33, -0.65)])
def test_a_limit_switch_before_the_index_pulse_is_a_failure(method: int, place: float) -> None:
    bench = bench_at(0.0, method)
    bench.fit(0b011, positive=0.15, negative=-0.65)
    home(bench)
    assert bench.statusword & MODE_BITS == FAILED
    assert bench.turns == pytest.approx(place, abs=0.02)


def test_a_shaft_on_a_pulse_goes_to_the_next_one() -> None:
    machine = MotionBench(Mode.HOMING).servo.drive.machine
    assert [machine.next_index(count, +1) for count in (-1.0, 0.0, 1.0)] == [0.0, COUNTS, COUNTS]
    assert [machine.next_index(count, -1) for count in (-1.0, 0.0, 1.0)] == [-COUNTS, -COUNTS, 0.0]


def test_a_failed_homing_can_be_started_anew() -> None:
    bench = bench_at(0.0, 20)
    bench.set(MACHINE, "B", 0b011, 2)
    home(bench)
    bench.control(ENABLED)
    bench.set(Object.HOMING_METHOD, "b", 37)
    assert home(bench) <= 1
    assert bench.statusword & MODE_BITS == DONE


def test_a_switch_held_by_hand_is_taken_where_it_was_noticed() -> None:
    bench = MotionBench(Mode.HOMING)
    prepare(bench, 17)
    bench.control(ENABLED | START)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(-FAST, rel=0.05)
    bench.set(MACHINE, "I", 0b01, INPUTS_HELD)
    bench.wait_ms(100)
    assert bench.turns_s == pytest.approx(SLOW, rel=0.1), "off the switch again"
    bench.set(MACHINE, "I", 0, INPUTS_HELD)
    released = bench.servo.drive.firmware.inner.count
    bench.wait_until(lambda: bench.statusword & MODE_BITS == DONE, 100)
    assert 0 <= zero_count(bench) - released <= COUNTS * SLOW * 1.1e-3, "within a motion period"


def test_every_method_of_60e3_is_taken_and_no_other() -> None:
    bench = MotionBench(Mode.HOMING, enabled=False)
    count = bench.read(Object.SUPPORTED_HOMING_METHODS, "B")
    offered = [bench.read(Object.SUPPORTED_HOMING_METHODS, "b", sub) for sub in range(1, count + 1)]
    assert offered == list(HOMING_METHODS) == [*range(1, 15), *range(17, 31), 33, 34, 35, 37]
    for method in range(-128, 128):
        assert (bench.write(Object.HOMING_METHOD, "b", method) is None) == (method in offered)


def test_the_speed_limit_holds_for_a_search_too() -> None:
    bench = bench_at(-1.2, 24)
    bench.set(Object.MAX_MOTOR_SPEED, "I", 3 * RPM_PER_TURN_S)
    bench.control(ENABLED | START)
    fastest = max(bench.watch(200, lambda: bench.turns_s))
    assert fastest == pytest.approx(3.0, rel=0.1)


def test_nothing_moves_before_bit_4_rises_in_the_mode() -> None:
    bench = MotionBench(Mode.CYCLIC_SYNCHRONOUS_TORQUE)
    bench.control(ENABLED | START)
    prepare(bench, 34)
    bench.wait_ms(50)
    assert bench.turns == pytest.approx(0.0, abs=0.001)
    assert bench.statusword & MODE_BITS == NOT_STARTED
    bench.control(ENABLED)
    home(bench)
    assert bench.statusword & MODE_BITS == DONE
