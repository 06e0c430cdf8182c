"""Factors from the drive's objects, against worked examples."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.cia402.objects402 import Unit, unit_word
from servobench.drivers.cia402.scaling import ScaleOverride, Scaling, scaling_from
from servobench.drivers.errors import PeerFault
from tests.draws import examples_of

RATED = {(0x6076, 0): 2000}
ENCODER = {(0x608F, 1): 65536, (0x608F, 2): 1}
RPM = 2 * math.pi / 60


def test_counts_and_milli_rpm() -> None:
    word = unit_word(-3, Unit.REVOLUTION, Unit.MINUTE)
    scaling = scaling_from({**RATED, **ENCODER, (0x60A9, 0): word})
    assert scaling.position_rad == pytest.approx(2 * math.pi / 65536)
    assert scaling.velocity_rad_s == pytest.approx(RPM / 1000)
    assert scaling.acceleration_rad_s2 == pytest.approx(RPM / 1000)
    assert scaling.torque_nm == pytest.approx(0.002)
    assert scaling.sources["velocity"] == "60A9h"


def test_without_unit_words_velocity_is_in_position_units_per_second() -> None:
    scaling = scaling_from({**RATED, **ENCODER})
    assert scaling.velocity_rad_s == scaling.position_rad
    assert scaling.sources["velocity"].startswith("position unit per second")


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        (unit_word(0, Unit.DEGREE), math.pi / 180),
        (unit_word(-3, Unit.RADIAN), 1e-3),
        (unit_word(-6, Unit.REVOLUTION), 2e-6 * math.pi),
        (unit_word(0, Unit.INCREMENT), 2 * math.pi / 65536),
        (unit_word(0, Unit.DIMENSIONLESS), 2 * math.pi / 65536),
        (0x00_77_00_00, 2 * math.pi / 65536),
    ],
)
def test_position_unit_words(word: int, expected: float) -> None:
    scaling = scaling_from({**RATED, **ENCODER, (0x60A8, 0): word})
    assert scaling.position_rad == pytest.approx(expected)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        (unit_word(0, Unit.REVOLUTION_PER_MINUTE), RPM),
        (unit_word(-1, Unit.REVOLUTION, Unit.SECOND), 0.2 * math.pi),
        (unit_word(0, Unit.INCREMENT, Unit.SECOND), 2 * math.pi / 65536),
        (unit_word(0, Unit.RADIAN, Unit.SECOND), 1.0),
    ],
)
def test_velocity_unit_words(word: int, expected: float) -> None:
    scaling = scaling_from({**RATED, **ENCODER, (0x60A9, 0): word})
    assert scaling.velocity_rad_s == pytest.approx(expected)


def test_acceleration_unit_word() -> None:
    word = unit_word(0, Unit.RADIAN, Unit.SECOND)
    assert scaling_from({**RATED, **ENCODER, (0x60AA, 0): word}).acceleration_rad_s2 == pytest.approx(1.0)


def test_feed_constant_behind_a_gear() -> None:
    values = {**RATED, **ENCODER, (0x6092, 1): 360, (0x6092, 2): 1, (0x6091, 1): 5, (0x6091, 2): 1}
    # One load turn is 360 units and five motor turns.
    assert scaling_from(values).position_rad == pytest.approx(5 * 2 * math.pi / 360)


def test_a_feed_constant_of_one_is_nobodys_setting() -> None:
    values = {**RATED, **ENCODER, (0x6092, 1): 1, (0x6092, 2): 1}
    assert scaling_from(values).position_rad == pytest.approx(2 * math.pi / 65536)


def test_velocity_factor() -> None:
    # 60 / 65536: counts per second to revolutions per minute.
    values = {**RATED, **ENCODER, (0x6096, 1): 60, (0x6096, 2): 65536}
    assert scaling_from(values).velocity_rad_s == pytest.approx(RPM)


@pytest.mark.parametrize("missing", ["torque", "position"])
def test_what_the_drive_does_not_tell_is_named(missing: str) -> None:
    values = ENCODER if missing == "torque" else RATED
    with pytest.raises(PeerFault, match=missing):
        scaling_from(values)


def test_turns_in_unit_words_are_those_behind_the_gear() -> None:
    gear = {(0x6091, 1): 5, (0x6091, 2): 1}
    words = {
        (0x60A8, 0): unit_word(-1, Unit.DEGREE),
        (0x60A9, 0): unit_word(0, Unit.REVOLUTION, Unit.MINUTE),
        (0x60AA, 0): unit_word(0, Unit.REVOLUTION, Unit.SQUARE_SECOND),
    }
    scaling = scaling_from({**RATED, **ENCODER, **gear, **words})
    assert scaling.position_rad == pytest.approx(5 * 0.1 * math.pi / 180)
    assert scaling.velocity_rad_s == pytest.approx(5 * RPM)
    assert scaling.acceleration_rad_s2 == pytest.approx(5 * 2 * math.pi)
    assert scaling.sources["velocity"] == "60A9h, 6091h"


def test_increments_are_those_of_the_motors_encoder_in_spite_of_the_gear() -> None:
    gear = {(0x6091, 1): 5, (0x6091, 2): 1, (0x60A8, 0): unit_word(0, Unit.INCREMENT)}
    assert scaling_from({**RATED, **ENCODER, **gear}).position_rad == pytest.approx(2 * math.pi / 65536)


def test_metres_by_the_feed() -> None:
    # 5 mm a turn, told in um: a feed of 5000 units; velocity in mm/s.
    values = {
        (0x6092, 1): 5000,
        (0x6092, 2): 1,
        (0x60A8, 0): unit_word(-6, Unit.METRE),
        (0x60A9, 0): unit_word(-3, Unit.METRE, Unit.SECOND),
    }
    scaling = scaling_from({**RATED, **ENCODER, **values})
    assert scaling.position_rad == pytest.approx(2 * math.pi / 5000)
    assert scaling.velocity_rad_s == pytest.approx(2 * math.pi / 5)


def test_the_factors_of_dsp_402() -> None:
    # 10 increments, 100 increments/s and 1000 increments/s^2 a unit.
    values = {
        (0x6093, 1): 10,
        (0x6093, 2): 1,
        (0x6094, 1): 100,
        (0x6094, 2): 1,
        (0x6097, 1): 1000,
        (0x6097, 2): 1,
    }
    scaling = scaling_from({**RATED, **ENCODER, **values})
    increment = 2 * math.pi / 65536
    assert scaling.position_rad == pytest.approx(10 * increment)
    assert scaling.velocity_rad_s == pytest.approx(100 * increment)
    assert scaling.acceleration_rad_s2 == pytest.approx(1000 * increment)


def test_an_encoder_that_is_disbelieved_is_disbelieved_in_every_unit_that_rests_on_it() -> None:
    unset = {(0x608F, 1): 1, (0x608F, 2): 1}
    factors = {(0x6094, 1): 100, (0x6094, 2): 1, (0x6097, 1): 1000, (0x6097, 2): 1}
    increment = 2 * math.pi / 65536
    scaling = scaling_from({**RATED, **unset, **factors}, ScaleOverride(position_rad=increment))
    assert scaling.velocity_rad_s == pytest.approx(100 * increment)
    assert scaling.acceleration_rad_s2 == pytest.approx(1000 * increment)
    in_tens = {(0x6093, 1): 10, (0x6093, 2): 1}
    scaling = scaling_from(
        {**RATED, **unset, **factors, **in_tens}, ScaleOverride(position_rad=10 * increment)
    )
    assert scaling.velocity_rad_s == pytest.approx(100 * increment)
    degrees = {(0x60A8, 0): unit_word(0, Unit.DEGREE)}
    scaling = scaling_from({**RATED, **ENCODER, **factors, **degrees}, ScaleOverride(position_rad=1e-3))
    assert scaling.velocity_rad_s == pytest.approx(100 * increment), "that unit does not rest on it"


@pytest.mark.parametrize(("resolution", "source"), [(1, "6090h (608Fh is 1)"), (4, "608Fh")])
def test_the_velocity_encoder_is_asked_where_nobody_set_608fh(resolution: int, source: str) -> None:
    values = {(0x608F, 1): resolution, (0x608F, 2): 1, (0x6090, 1): 4096, (0x6090, 2): 1}
    scaling = scaling_from({**RATED, **values})
    assert scaling.sources["position"] == source
    assert scaling.position_rad == pytest.approx(2 * math.pi / (resolution if source == "608Fh" else 4096))


def test_the_acceleration_factor_of_cia_402() -> None:
    # 100 acceleration units are one position unit per second squared.
    values = {**RATED, **ENCODER, (0x6097, 1): 100, (0x6097, 2): 1}
    assert scaling_from(values).acceleration_rad_s2 == pytest.approx(2 * math.pi / 65536 / 100)


def test_the_velocity_encoder_stands_in_for_the_position_encoder() -> None:
    scaling = scaling_from({**RATED, (0x6090, 1): 4096, (0x6090, 2): 1})
    assert scaling.position_rad == pytest.approx(2 * math.pi / 4096)
    assert "6090h" in scaling.sources["position"]


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        (unit_word(0, Unit.REVOLUTION_PER_MINUTE, Unit.SQUARE_SECOND), RPM),
        (unit_word(0, Unit.RADIAN, Unit.CUBIC_SECOND), 1.0),
        (unit_word(3, Unit.INCREMENT, Unit.CUBIC_SECOND), 1000 * 2 * math.pi / 65536),
    ],
)
def test_jerk_unit_words(word: int, expected: float) -> None:
    assert scaling_from({**RATED, **ENCODER, (0x60AB, 0): word}).jerk_rad_s3 == pytest.approx(expected)


def test_jerk_without_a_word_and_rated_current() -> None:
    scaling = scaling_from({**RATED, **ENCODER, (0x6075, 0): 4500})
    assert scaling.jerk_rad_s3 == scaling.acceleration_rad_s2
    assert scaling.rated_current_a == 4.5
    assert scaling_from({**RATED, **ENCODER}).rated_current_a is None


def test_overrides_go_first() -> None:
    override = ScaleOverride(0.5, 0.25, 0.125, 3.0)
    scaling = scaling_from({**RATED, **ENCODER}, override)
    assert (scaling.position_rad, scaling.velocity_rad_s, scaling.acceleration_rad_s2) == (0.5, 0.25, 0.125)
    assert scaling.rated_torque_nm == 3.0
    told_by = {name: source for name, source in scaling.sources.items() if name != "jerk"}
    assert set(told_by.values()) == {"override"}


@pytest.mark.parametrize("factor", [0.0, -1.0, math.nan, math.inf])
def test_a_senseless_override_is_refused(factor: float) -> None:
    with pytest.raises(PeerFault):
        scaling_from({**RATED, **ENCODER}, ScaleOverride(position_rad=factor))


@examples_of(100)
@given(st.floats(-60.0, 60.0), st.floats(0.1, 50.0))
def test_torque_is_rounded_to_the_nearest_unit(torque_nm: float, rated_nm: float) -> None:
    scaling = Scaling(1.0, 1.0, 1.0, rated_nm, rated_nm / 1000)
    assert abs(scaling.torque_raw(torque_nm) * scaling.torque_nm - torque_nm) <= 0.5001 * scaling.torque_nm
