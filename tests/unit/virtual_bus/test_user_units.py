"""The factor group of the drive: what a master writes as units is what moves the shaft."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.cia402.objects402 import Object, Unit, unit_word
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.device.object_dictionary import Access, ObjectDictionary
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.user_units import UserUnits, wrapped
from tests.draws import examples_of
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import ENABLED, MotionBench

COUNTS = 65_536
REVOLUTION_PER_SECOND = unit_word(0, Unit.REVOLUTION, Unit.SECOND)


def shaft_turns(bench: MotionBench) -> float:
    """Of the encoder itself."""
    return bench.servo.drive.firmware.inner.count / COUNTS


def off_bench(mode: Mode = Mode.PROFILE_POSITION) -> MotionBench:
    return MotionBench(mode, DriveParameters(brake_torque_nm=0.0), enabled=False)


def move(bench: MotionBench, raw: int) -> None:
    bench.set(Object.TARGET_POSITION, "i", raw)
    bench.control(ENABLED | 0x10)
    bench.control(ENABLED)
    bench.wait_ms(5)
    bench.until_reached()


@pytest.mark.parametrize(
    ("writes", "raw", "turns"),
    [
        ([(Object.SI_UNIT_POSITION, 0, unit_word(-1, Unit.DEGREE))], 900, 0.25),
        ([(Object.SI_UNIT_POSITION, 0, unit_word(-3, Unit.REVOLUTION))], -400, -0.4),
        ([(Object.SI_UNIT_POSITION, 0, unit_word(-3, Unit.RADIAN))], 1000, 1 / math.tau),
        ([(Object.FEED_CONSTANT, 1, 3600)], 1800, 0.5),
        ([(Object.FEED_CONSTANT, 1, 3600), (Object.GEAR_RATIO, 1, 5)], 360, 0.5),
        ([(Object.FEED_CONSTANT, 1, 7200), (Object.FEED_CONSTANT, 2, 2)], 1800, 0.5),
        ([(Object.FEED_CONSTANT, 1, 1000), (Object.GEAR_RATIO, 1, 3), (Object.GEAR_RATIO, 2, 2)], 500, 0.75),
        ([(Object.SI_UNIT_POSITION, 0, unit_word(0, Unit.DEGREE)), (Object.FEED_CONSTANT, 1, 100)], 50, 0.5),
    ],
)
def test_a_target_in_user_units_turns_the_shaft_so_far(
    writes: list[tuple[Object, int, int]], raw: int, turns: float
) -> None:
    bench = off_bench()
    for index, sub, value in writes:
        bench.set(index, "I", value, sub)
    bench.enable()
    move(bench, raw)
    assert shaft_turns(bench) == pytest.approx(turns, abs=0.003)
    assert bench.read(0x6064, "i") == pytest.approx(raw, abs=max(1, abs(raw) * 0.01))


@pytest.mark.parametrize(
    ("writes", "raw", "turns_s"),
    [
        ([(Object.SI_UNIT_VELOCITY, 0, unit_word(0, Unit.REVOLUTION, Unit.MINUTE))], 300, 5.0),
        ([(Object.SI_UNIT_VELOCITY, 0, unit_word(-2, Unit.REVOLUTION, Unit.SECOND))], -500, -5.0),
        ([(Object.SI_UNIT_VELOCITY, 0, unit_word(0, Unit.DEGREE, Unit.SECOND))], 1800, 5.0),
        ([(Object.SI_UNIT_VELOCITY, 0, unit_word(0, Unit.INCREMENT, Unit.SECOND))], 5 * COUNTS, 5.0),
        # 6096h: user velocity = counts per second times numerator over divisor
        ([(Object.VELOCITY_FACTOR, 1, 60), (Object.VELOCITY_FACTOR, 2, COUNTS)], 300, 5.0),
        ([(Object.VELOCITY_FACTOR, 1, 1), (Object.VELOCITY_FACTOR, 2, 1)], 5 * COUNTS, 5.0),
    ],
)
def test_a_velocity_in_user_units_is_that_speed(
    writes: list[tuple[Object, int, int]], raw: int, turns_s: float
) -> None:
    bench = off_bench(Mode.PROFILE_VELOCITY)
    for index, sub, value in writes:
        bench.set(index, "I", value, sub)
    bench.set(Object.SI_UNIT_ACCELERATION, "I", unit_word(0, Unit.REVOLUTION, Unit.SQUARE_SECOND))
    bench.set(Object.PROFILE_ACCELERATION, "I", 100)
    bench.set(Object.MAX_PROFILE_VELOCITY, "I", abs(raw) * 2)
    bench.enable()
    bench.set(Object.TARGET_VELOCITY, "i", raw)
    bench.wait_ms(25)
    assert bench.speed_rad_s / math.tau == pytest.approx(math.copysign(2.5, turns_s), abs=0.25), "60AAh"
    bench.wait_ms(200)
    assert bench.speed_rad_s / math.tau == pytest.approx(turns_s, rel=0.01)
    assert bench.read(0x606C, "i") == pytest.approx(raw, rel=0.02)
    assert bench.read(Object.VELOCITY_DEMAND_VALUE, "i") == pytest.approx(raw, abs=1)


def test_polarity_turns_positions_and_velocities_round() -> None:
    bench = off_bench()
    bench.set(Object.POLARITY, "B", 0x80)
    bench.enable()
    move(bench, COUNTS)
    assert shaft_turns(bench) == pytest.approx(-1.0, abs=0.003)
    bench = off_bench(Mode.PROFILE_VELOCITY)
    bench.set(Object.POLARITY, "B", 0x40)
    bench.enable()
    bench.set(Object.TARGET_VELOCITY, "i", 120_000)
    bench.wait_ms(200)
    assert bench.speed_rad_s == pytest.approx(-2 * math.tau, rel=0.02)
    assert bench.read(0x606C, "i") == pytest.approx(120_000, rel=0.02)
    assert bench.read(0x6064, "i") < 0, "positions keep their own sign"


@pytest.mark.parametrize("polarity", [0x00, 0x80, 0x40, 0xC0])
def test_cyclic_modes_obey_polarity_with_their_offsets(polarity: int) -> None:
    bench = off_bench(Mode.CYCLIC_SYNCHRONOUS_VELOCITY)
    bench.set(Object.POLARITY, "B", polarity)
    bench.enable()
    bench.set(Object.TARGET_VELOCITY, "i", 60_000)
    bench.set(Object.VELOCITY_OFFSET, "i", 60_000)
    bench.wait_ms(150)
    sign = -1 if polarity & 0x40 else 1
    assert bench.speed_rad_s == pytest.approx(sign * 2 * math.tau, rel=0.02)
    bench = off_bench(Mode.CYCLIC_SYNCHRONOUS_POSITION)
    bench.set(Object.POLARITY, "B", polarity)
    bench.enable()
    for cycle in range(200):
        bench.set(Object.TARGET_POSITION, "i", cycle * 100)
        bench.set(Object.POSITION_OFFSET, "i", 500)
        bench.wait_ms(1)
    bench.wait_ms(50)
    sign = -1 if polarity & 0x80 else 1
    assert shaft_turns(bench) * COUNTS == pytest.approx(sign * (199 * 100 + 500), abs=60)
    assert bench.read(0x6064, "i") == pytest.approx(199 * 100 + 500, abs=60)


def test_software_limits_are_user_positions() -> None:
    bench = off_bench()
    bench.set(Object.POLARITY, "B", 0x80)
    bench.set(Object.SI_UNIT_POSITION, "I", unit_word(0, Unit.DEGREE))
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -90, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 180, 2)
    bench.enable()
    move(bench, 720)
    assert shaft_turns(bench) == pytest.approx(-0.5, abs=0.003)
    move(bench, -720)
    assert shaft_turns(bench) == pytest.approx(0.25, abs=0.003)


@pytest.mark.parametrize(("polarity", "turns"), [(0x00, 2.0), (0xC0, -2.0)])
def test_software_limits_end_a_velocity_at_the_user_position(polarity: int, turns: float) -> None:
    bench = off_bench(Mode.PROFILE_VELOCITY)
    bench.set(Object.POLARITY, "B", polarity)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", -COUNTS, 1)
    bench.set(Object.SOFTWARE_POSITION_LIMIT, "i", 2 * COUNTS, 2)
    bench.enable()
    bench.set(Object.TARGET_VELOCITY, "i", 300_000)
    bench.wait_ms(800)
    assert shaft_turns(bench) == pytest.approx(turns, abs=0.05)


@pytest.mark.parametrize(
    ("index", "code", "value", "sub"),
    [
        (Object.POLARITY, "B", 0x80, 0),
        (Object.GEAR_RATIO, "I", 2, 1),
        (Object.FEED_CONSTANT, "I", 2, 2),
        (Object.VELOCITY_FACTOR, "I", 2, 1),
        (Object.SI_UNIT_POSITION, "I", unit_word(0, Unit.DEGREE), 0),
        (Object.SI_UNIT_VELOCITY, "I", REVOLUTION_PER_SECOND, 0),
        (Object.SI_UNIT_ACCELERATION, "I", unit_word(0, Unit.REVOLUTION, Unit.SQUARE_SECOND), 0),
    ],
)
def test_units_of_an_enabled_drive_stay(index: Object, code: str, value: int, sub: int) -> None:
    bench = MotionBench(Mode.PROFILE_POSITION)
    assert bench.write(index, code, value, sub) == AbortCode.DEVICE_STATE
    bench.control(0x06)
    bench.wait_ms(30)
    assert bench.write(index, code, value, sub) is None
    assert bench.read(index, code, sub) == value


@pytest.mark.parametrize(
    ("index", "word"),
    [
        (Object.SI_UNIT_POSITION, unit_word(0, Unit.SECOND)),
        (Object.SI_UNIT_POSITION, unit_word(0, Unit.REVOLUTION, Unit.SECOND)),
        (Object.SI_UNIT_POSITION, unit_word(-3, Unit.INCREMENT)),
        (Object.SI_UNIT_VELOCITY, unit_word(0, Unit.REVOLUTION)),
        (Object.SI_UNIT_VELOCITY, REVOLUTION_PER_SECOND | 1),
        (Object.SI_UNIT_VELOCITY, unit_word(20, Unit.REVOLUTION, Unit.SECOND)),
        (Object.SI_UNIT_ACCELERATION, unit_word(0, Unit.METRE, Unit.SQUARE_SECOND)),
        (Object.SI_UNIT_ACCELERATION, unit_word(0, Unit.REVOLUTION_PER_MINUTE, Unit.SQUARE_SECOND)),
        (Object.SI_UNIT_JERK, unit_word(0, Unit.REVOLUTION, Unit.SECOND)),
    ],
)
def test_units_that_mean_nothing_here_are_refused(index: Object, word: int) -> None:
    assert off_bench().write(index, "I", word) == AbortCode.INVALID_VALUE


def test_every_unit_object_is_there() -> None:
    bench = off_bench()
    assert bench.read(Object.VELOCITY_ENCODER_RESOLUTION, "I", 1) == COUNTS
    assert bench.read(Object.VELOCITY_ENCODER_RESOLUTION, "I", 2) == 1
    assert bench.read(Object.SI_UNIT_ACCELERATION, "I") == 0x00C0_0300
    assert bench.read(Object.SI_UNIT_JERK, "I") == 0x00C0_5700
    bench.set(Object.SI_UNIT_JERK, "I", unit_word(-3, Unit.REVOLUTION, Unit.CUBIC_SECOND))
    # By the defaults 6096h says the same as 60A9h.
    numerator, divisor = (bench.read(Object.VELOCITY_FACTOR, "I", sub) for sub in (1, 2))
    assert numerator / divisor == pytest.approx(60_000 / COUNTS)


def test_reset_node_brings_units_and_origin_back() -> None:
    bench = off_bench()
    bench.set(Object.POLARITY, "B", 0xC0)
    bench.set(Object.SI_UNIT_POSITION, "I", unit_word(0, Unit.DEGREE))
    bench.nmt(129)
    bench.wait_ms(DriveParameters().boot_after_reset_ms)
    bench.nmt(1)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_POSITION)
    bench.enable()
    move(bench, COUNTS)
    assert shaft_turns(bench) == pytest.approx(1.0, abs=0.003)


# ---- under a vendor's dictionary --------------------------------------------------------------------------


def vendor_bench(change: Callable[[ObjectDictionary], None], mode: Mode) -> MotionBench:
    """As with an EDS laid over the drive's own dictionary."""
    bench = MotionBench(mode, DriveParameters(brake_torque_nm=0.0), enabled=False)
    bench.power_on(vendor=change)
    bench.set(Object.MODES_OF_OPERATION, "b", mode)
    bench.enable()
    return bench


def test_units_are_those_that_a_vendors_dictionary_tells() -> None:
    """Without 6076h, which says nothing of positions; 60A8h and 60A9h by default."""

    def change(dictionary: ObjectDictionary) -> None:
        dictionary.conceal(Object.MOTOR_RATED_TORQUE)
        dictionary.variable(Object.SI_UNIT_POSITION).default = unit_word(0, Unit.DEGREE)
        dictionary.variable(Object.SI_UNIT_VELOCITY).default = unit_word(0, Unit.REVOLUTION, Unit.MINUTE)
        dictionary.variable(Object.PROFILE_VELOCITY).default = 600
        dictionary.variable(Object.MAX_PROFILE_VELOCITY).default = 6000

    bench = vendor_bench(change, Mode.PROFILE_POSITION)
    move(bench, 90)
    assert shaft_turns(bench) == pytest.approx(0.25, abs=0.003)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.PROFILE_VELOCITY)
    bench.set(Object.TARGET_VELOCITY, "i", 300)
    bench.wait_ms(300)
    assert bench.speed_rad_s == pytest.approx(5 * math.tau, rel=0.02)


def test_without_any_word_of_positions_they_are_encoder_counts() -> None:
    def change(dictionary: ObjectDictionary) -> None:
        for index in (0x608F, 0x6091, 0x6092, 0x60A8):
            dictionary.conceal(index)
        dictionary.variable(Object.SI_UNIT_VELOCITY).default = unit_word(0, Unit.REVOLUTION, Unit.MINUTE)
        dictionary.variable(Object.PROFILE_VELOCITY).default = 600
        dictionary.variable(Object.MAX_PROFILE_VELOCITY).default = 6000

    bench = vendor_bench(change, Mode.PROFILE_POSITION)
    move(bench, COUNTS // 2)
    assert shaft_turns(bench) == pytest.approx(0.5, abs=0.003)


def test_limits_that_a_vendors_dictionary_leaves_at_0_are_the_drives_own() -> None:
    needed = (Object.MAX_TORQUE, Object.MAX_CURRENT, Object.FOLLOWING_ERROR_WINDOW)

    def change(dictionary: ObjectDictionary) -> None:
        for index in needed:
            dictionary.variable(index).default = 0

    bench = vendor_bench(change, Mode.PROFILE_POSITION)
    move(bench, COUNTS)
    assert shaft_turns(bench) == pytest.approx(1.0, abs=0.003)
    assert all(bench.read(index, code) for index, code in zip(needed, "HHI", strict=True))


def torque_of(bench: MotionBench) -> float:
    """N m, from what the shaft gains in 10 ms."""
    before = bench.speed_rad_s
    bench.wait_ms(10)
    gained = bench.speed_rad_s - before
    return LING.inertia_kg_m2 * gained / 0.010 + LING.viscous_friction_nm_s * (before + gained / 2)


def test_torques_are_thousandths_of_the_6076h_that_the_dictionary_has() -> None:
    def change(dictionary: ObjectDictionary) -> None:
        rated = dictionary.variable(Object.MOTOR_RATED_TORQUE)
        rated.default, rated.access = 1000, Access.READ_WRITE

    bench = vendor_bench(change, Mode.CYCLIC_SYNCHRONOUS_TORQUE)
    bench.set(Object.TARGET_TORQUE, "h", 500)
    bench.wait_ms(10)
    assert bench.read(Object.TORQUE_ACTUAL_VALUE, "h") == pytest.approx(500, abs=3)
    assert torque_of(bench) == pytest.approx(0.5, rel=0.02)
    assert bench.write(Object.MOTOR_RATED_TORQUE, "I", 4000) == AbortCode.DEVICE_STATE
    bench.set(Object.TARGET_TORQUE, "h", 0)
    bench.control(0x00)
    bench.set(Object.MOTOR_RATED_TORQUE, "I", 4000)
    bench.enable()
    bench.set(Object.TARGET_TORQUE, "h", 100)
    bench.wait_ms(10)
    assert torque_of(bench) == pytest.approx(0.4, rel=0.02)


def units_with(counts_per_position: float, origin: float) -> UserUnits:
    units = UserUnits(ObjectDictionary(), COUNTS, lambda: True)
    units.counts_per_position = counts_per_position
    units.origin = origin
    return units


FACTORS = st.sampled_from([1.0, -1.0, 182.04444, -0.5, 65_536.0])
ORIGINS = st.integers(-(1 << 33), 1 << 33).map(float)


@examples_of(300)
@given(FACTORS, ORIGINS, st.integers(-0x8000_0000, 0x7FFF_FFFF), st.floats(-1e12, 1e12))
def test_a_position_names_the_count_in_the_turn_of_where_the_shaft_is(
    factor: float, origin: float, position: int, near: float
) -> None:
    units = units_with(factor, origin)
    count = units.count_of(position, near)
    assert abs(wrapped(units.position_of(count) - position)) <= 1
    assert abs(count - near) <= abs(factor) * (1 << 32)
    nearest = units.nearest_count_of(position, near)
    assert abs(nearest - near) <= abs(factor) * ((1 << 31) + 1)


@examples_of(100)
@given(st.integers(-(1 << 40), 1 << 40))
def test_wrapped_is_integer32(value: int) -> None:
    assert -(1 << 31) <= wrapped(value) < 1 << 31
    assert (wrapped(value) - value) % (1 << 32) == 0
