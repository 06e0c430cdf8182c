"""The suggested controller, period and limits, against the loop's own frequency response."""

import math
import re
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.commissioning.excitation import Resonance
from servobench.hil.commissioning.findings import StepOutcome
from servobench.hil.commissioning.identify import Mechanics
from servobench.hil.commissioning.request import Nameplate, PlateRating
from servobench.hil.commissioning.steps_design import Suggest
from tests.unit.hil.simulated_shaft import LIMITS, Shaft, request_of, session_of

J, B, RATED_NM = 2e-3, 4e-3, 2.0
LAG_US, READING_US, EFFECT_US = 800.0, 400.0, 700.0


def suggested(
    noise_rad_s: float = 0.0,
    rating: PlateRating | None = None,
    reading_us: float = READING_US,
    resonance: Resonance | None = None,
) -> tuple[StepOutcome, dict[str, Any]]:
    """What the step finds, and the controller."""
    mechanics = Mechanics(J, B, 0.05, 0.0, 0.0, 0.0, 0.0, 10, 0.0)
    session = session_of(
        Shaft(mechanics),
        mechanics=mechanics,
        limits=replace(LIMITS, speed_rad_s=100.0),
        request=replace(request_of(), nameplate=Nameplate(rating=rating or PlateRating())),
        configured=True,
    )
    found, drive = cast(Any, session.found), cast(Any, session.drive)
    drive.rated_torque_nm = RATED_NM
    found.torque_lag_us, found.speed_noise_rad_s = LAG_US, noise_rad_s
    found.reading_delay_us, found.effect_delay_us = reading_us, EFFECT_US
    found.period, found.plan = Duration(NS_PER_MS), mode_plan(1, PlanWish())
    found.resonance = resonance
    outcome = StepOutcome()
    Suggest().run(session, outcome)
    return outcome, found.controller


def load_response(controller: dict[str, Any], delay_s: float) -> float:
    """Largest |speed / load torque| over the frequency, rad/s per N m."""
    s = 1j * np.logspace(0.0, 4.0, 40_000)
    pi = controller["proportional_nm_s_rad"] + controller["integral_nm_rad"] / s
    plant = 1.0 / (J * s + B)
    loop = pi * plant * np.exp(-s * delay_s) / (1.0 + s * 1e-6 * LAG_US)
    return float(np.abs(plant / (1.0 + loop)).max())


def test_the_load_moves_the_speed_as_far_as_is_said() -> None:
    outcome, controller = suggested()
    delay_s = 1.6e-6 * (READING_US + EFFECT_US + 500.0)  # and half a period, as it is held
    assert outcome.figures["designed_for_delay_us"] == pytest.approx(1e6 * delay_s)
    (told,) = re.findall(r"by at most (\S+) rad/s as a sine", " ".join(outcome.lines))
    assert float(told) == pytest.approx(load_response(controller, delay_s), rel=0.01)
    assert controller["kind"] == "pid"
    assert controller["feedforward_nm_s_rad"] == B
    assert outcome.figures["proportional_nm_s_rad"] == controller["proportional_nm_s_rad"]
    assert outcome.figures["integral_nm_rad"] == controller["integral_nm_rad"]
    assert outcome.figures["crossing_rad_s"] == pytest.approx(controller["proportional_nm_s_rad"] / J)


@pytest.mark.long
def test_a_resonance_is_left_with_half_of_the_gain_that_shakes() -> None:
    _, gains = suggested()
    peak = 2.0 / gains["proportional_nm_s_rad"]
    outcome, less = suggested(resonance=Resonance(84.9, 0.02, peak))
    assert less["proportional_nm_s_rad"] * peak == pytest.approx(0.5, rel=0.25)
    assert outcome.lines[0].startswith(f"the resonance at 84.9 Hz allows {0.5 / peak:.3g} N m s/rad")


@pytest.mark.long
def test_noise_of_the_speed_makes_at_most_a_twentieth_of_the_rated_torque() -> None:
    quiet, gains = suggested()
    assert not any("noise" in line for line in quiet.lines)
    noise = 2.0 * 0.05 * RATED_NM / gains["proportional_nm_s_rad"]
    noisy, less = suggested(noise)
    assert noisy.figures["designed_for_delay_us"] > 1.5 * quiet.figures["designed_for_delay_us"]
    assert less["proportional_nm_s_rad"] * noise == pytest.approx(0.05 * RATED_NM, rel=0.25)
    assert f"the velocity's noise allows {0.05 * RATED_NM / noise:.3g} N m s/rad" in noisy.lines[0]


@pytest.mark.long
@pytest.mark.parametrize(
    ("rating", "speed_rpm", "share"),
    [
        (PlateRating(), 2.0 * 100.0 * 30.0 / math.pi, 2.0),
        (PlateRating(speed_rpm=3000.0, current_a=4.0, current_max_a=6.0), 3000.0, 1.5),
        (PlateRating(current_a=4.0, current_max_a=16.0), 2.0 * 100.0 * 30.0 / math.pi, 2.0),
    ],
)
def test_limits_are_those_of_the_nameplate_or_twice_what_was_tried(
    rating: PlateRating, speed_rpm: float, share: float
) -> None:
    figures = suggested(rating=rating)[0].figures
    assert figures["speed_max_rpm"] == pytest.approx(speed_rpm, rel=1e-3)
    assert figures["torque_max_nm"] == pytest.approx(share * RATED_NM)
    assert figures["torque_slew_max_nm_s"] == pytest.approx(200.0 * RATED_NM), "the rated torque in 5 ms"
