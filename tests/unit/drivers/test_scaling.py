"""Factors from the drive's objects, against worked examples."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import PeerFault
from drivers.objects402 import Unit, unit_word
from drivers.scaling import ScaleOverride, Scaling, scaling_from

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


def test_overrides_go_first() -> None:
    override = ScaleOverride(0.5, 0.25, 0.125, 3.0)
    scaling = scaling_from({**RATED, **ENCODER}, override)
    assert (scaling.position_rad, scaling.velocity_rad_s, scaling.acceleration_rad_s2) == (0.5, 0.25, 0.125)
    assert scaling.rated_torque_nm == 3.0
    assert set(scaling.sources.values()) == {"override"}


@pytest.mark.parametrize("factor", [0.0, -1.0, math.nan, math.inf])
def test_a_senseless_override_is_refused(factor: float) -> None:
    with pytest.raises(PeerFault):
        scaling_from({**RATED, **ENCODER}, ScaleOverride(position_rad=factor))


@settings(derandomize=True, deadline=None)
@given(st.floats(-60.0, 60.0), st.floats(0.1, 50.0))
def test_torque_is_rounded_to_the_nearest_unit(torque_nm: float, rated_nm: float) -> None:
    scaling = Scaling(1.0, 1.0, 1.0, rated_nm, rated_nm / 1000)
    assert abs(scaling.torque_raw(torque_nm) * scaling.torque_nm - torque_nm) <= 0.5001 * scaling.torque_nm
