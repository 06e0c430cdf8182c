"""Wrong units found by motion, on made motions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.scaling import Scaling
from drivers.unit_check import Known, MotionSamples, UnitCheck, check_units, plain_factor

COUNTS, RPM = 65536, 2 * math.pi / 60
TRUE = Scaling(
    2 * math.pi / COUNTS,
    RPM,
    RPM,
    2.0,
    0.002,
    {"position": "608Fh", "velocity": "60A9h", "torque": "6076h"},
)
RATED_A, KT = 4.0, 0.5
FACTS = Known(rated_current_a=RATED_A, torque_constant_nm_a=KT)
FAULTS = [
    2.0,
    0.5,
    4.0,
    0.25,
    60.0,
    1 / 60,
    2 * math.pi,
    1 / (2 * math.pi),
    2 * math.pi / 60,
    360.0,
    10.0,
    1e-3,
    1e6,
]


def motion(seed: int = 1, seconds: float = 1.0) -> MotionSamples:
    """Up to 60 rad/s and back, with friction; quantised and noisy as a drive tells it, in true units."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1e-3)
    acceleration = np.where(time < 0.3, 200.0, np.where(time < 0.6, 0.0, -200.0))
    speed = np.cumsum(acceleration) * 1e-3
    position = np.cumsum(speed) * 1e-3
    torque = 2e-3 * acceleration + 0.05 * np.sign(speed)
    return MotionSamples(
        time,
        np.round(position / TRUE.position_rad),
        np.round(speed / TRUE.velocity_rad_s + rng.normal(0.0, 1.0, time.size)),
        np.round(torque / TRUE.torque_nm),
        np.round(torque / KT / RATED_A * 1000.0),
    )


def turns(samples: MotionSamples) -> float:
    return float(samples.position[-1] - samples.position[0]) / COUNTS


def check(scaling: Scaling, known: Known = FACTS) -> UnitCheck:
    return check_units(motion(), scaling, known)


def test_right_units_are_found_right() -> None:
    samples = motion()
    found = check_units(samples, TRUE, replace(FACTS, turns=turns(samples)))
    assert found.findings == ()
    assert found.velocity_ratio == pytest.approx(1.0, abs=0.01)
    assert found.position_ratio == pytest.approx(1.0)
    assert found.torque_ratio == pytest.approx(1.0, abs=0.01)
    assert found.direction == 1


@pytest.mark.parametrize("factor", FAULTS)
def test_a_wrong_velocity_unit_is_found_with_its_factor(factor: float) -> None:
    wrong = replace(TRUE, velocity_rad_s=TRUE.velocity_rad_s / factor)
    samples = motion()
    (finding,) = check_units(samples, wrong, replace(FACTS, turns=turns(samples))).findings
    assert finding.quantity == "velocity"
    assert finding.factor == pytest.approx(factor, rel=1e-9)
    assert finding.objects[0] == "60A9h"


@pytest.mark.parametrize("factor", FAULTS)
def test_a_wrong_position_unit_is_found_by_turns_and_the_velocity_is_not_blamed(factor: float) -> None:
    wrong = replace(TRUE, position_rad=TRUE.position_rad / factor)
    samples = motion()
    (finding,) = check_units(samples, wrong, replace(FACTS, turns=turns(samples))).findings
    assert finding.quantity == "position"
    assert finding.factor == pytest.approx(factor, rel=1e-9)
    assert finding.objects[0] == "608Fh"


def test_both_units_wrong_are_found_apart() -> None:
    wrong = replace(TRUE, position_rad=TRUE.position_rad / 4, velocity_rad_s=TRUE.velocity_rad_s / 60)
    samples = motion()
    found = check_units(samples, wrong, replace(FACTS, turns=turns(samples))).findings
    assert {finding.quantity: round(finding.factor, 3) for finding in found} == {
        "position": 4.0,
        "velocity": 60.0,
    }


@pytest.mark.parametrize(
    ("factor", "first", "telling"),
    [
        (60.0, "60A9h", "a minute taken for a second"),
        (0.25, "608Fh", "encoder lines taken for counts"),
        (2 * math.pi / 60, "60A9h", "rev/min taken for rad/s"),
        (-1.0, "607Eh", "the sign is turned"),
        (-60.0, "60A9h", "and the sign is turned"),
        (1e-3, "60A9h", "a power of ten, 0.001"),
        (5.0, "6091h", "the gear 6091h"),
        (0.3, "60A9h", "no usual one"),
        (1000 * 60.0, "60A9h", "a minute taken for a second, or the other way round, and a power of ten"),
    ],
)
def test_without_turns_the_cause_names_the_object(factor: float, first: str, telling: str) -> None:
    wrong = replace(TRUE, velocity_rad_s=TRUE.velocity_rad_s / factor)
    (finding,) = check(wrong, replace(FACTS, gear_ratio=5.0)).findings
    assert finding.factor == pytest.approx(factor, rel=0.03)
    assert finding.objects[0] == first
    assert telling in str(finding)


@pytest.mark.parametrize(
    ("factor", "telling"),
    [(1e-3, "a power of ten"), (math.sqrt(2), "effective current"), (2.0, "factor of two")],
)
def test_a_wrong_rating_is_found_by_the_current(factor: float, telling: str) -> None:
    wrong = replace(TRUE, rated_torque_nm=2.0 / factor, torque_nm=0.002 / factor)
    (finding,) = check(wrong).findings
    assert finding.quantity == "torque"
    assert finding.factor == pytest.approx(factor, rel=1e-9)
    assert finding.objects == ("6076h", "6075h")
    assert telling in finding.cause


def test_a_torque_that_pushes_the_wrong_way_is_found() -> None:
    samples = motion()
    backwards = replace(samples, position=-samples.position, velocity=-samples.velocity)
    found = check_units(backwards, TRUE, FACTS)
    assert found.direction == -1
    (finding,) = found.findings
    assert finding.objects[0] == "607Eh"
    assert "position and velocity fall" in finding.cause


def test_what_is_not_the_same_quantity_has_no_factor() -> None:
    samples = motion()
    rng = np.random.default_rng(3)
    noise = replace(samples, velocity=rng.normal(0.0, 100.0, samples.velocity.size))
    found = check_units(noise, TRUE, Known())
    assert found.velocity_ratio is None
    assert math.isnan(found.findings[0].factor)
    assert "606Ch does not follow" in found.findings[0].cause


def test_a_shaft_that_stands_still_is_no_evidence() -> None:
    still = np.zeros(100)
    found = check_units(MotionSamples(np.linspace(0.0, 0.1, 100), still, still, still), TRUE)
    assert found == (None, None, None, None, ())


def test_a_position_that_stands_still_while_the_shaft_turns() -> None:
    still = np.zeros(100)
    found = check_units(
        MotionSamples(np.linspace(0.0, 0.1, 100), still, still, still), TRUE, Known(turns=2.0)
    )
    assert any("6064h stands still" in finding.cause for finding in found.findings)


def test_samples_that_do_not_fit_are_refused() -> None:
    samples = motion()
    with pytest.raises(ValueError, match="at least 20"):
        check_units(replace(samples, velocity=samples.velocity[:-1]), TRUE)
    with pytest.raises(ValueError, match="order of time"):
        check_units(replace(samples, time_s=samples.time_s[::-1]), TRUE)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.sampled_from(FAULTS), st.sampled_from([1.0, -1.0]), st.floats(-0.012, 0.012))
def test_factors_are_plain_in_spite_of_what_a_measurement_adds(
    factor: float, sign: float, error: float
) -> None:
    found, _, _ = plain_factor(factor * sign * (1.0 + error))
    assert found == pytest.approx(factor * sign, rel=1e-9)
