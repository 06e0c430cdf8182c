"""Wrong units explained by the slips that make them."""

import math

import pytest

from servobench.drivers.cia402.unit_factors import MOTION_SLIPS, TORQUE_SLIPS, likely_slip

RPM = math.tau / 60.0


@pytest.mark.parametrize(
    ("factor", "telling"),
    [
        (60.0, "a minute taken for a second"),
        (1.0 / 60.0, "a minute taken for a second"),
        (0.25, "encoder lines taken for counts"),
        (RPM, "rev/min taken for rad/s"),
        (1e-3, "a power of ten, 0.001"),
        (5.0, "the gear 6091h"),
        (5.0 * 60.0, "a minute taken for a second, or the other way round, and the gear"),
        (1000.0 * 60.0, "a minute taken for a second, or the other way round, and a power of ten"),
    ],
)
def test_motion_slips(factor: float, telling: str) -> None:
    assert telling in likely_slip(factor * 1.001, gear_ratio=5.0)


@pytest.mark.parametrize("factor", [1.37, 0.3, 7.7])
def test_what_is_no_usual_factor_is_not_explained(factor: float) -> None:
    assert likely_slip(factor) == ""


@pytest.mark.parametrize(
    ("factor", "telling"),
    [(math.sqrt(2.0), "effective current"), (2.0, "a factor of two"), (1000.0, "a power of ten, 1000")],
)
def test_torque_slips(factor: float, telling: str) -> None:
    assert telling in likely_slip(factor * 0.97, TORQUE_SLIPS, tolerance=0.05)


def test_one_slip_goes_before_a_power_of_ten_and_two() -> None:
    for slip in MOTION_SLIPS:
        assert likely_slip(slip.factor) == slip.text
