"""Frequency response, delays and the verification run, on a shaft that is known, and all that they say."""

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.commissioning.excitation import FrequencyResponse
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import ReadingsLost, StatedFigure, StepFailed, StepOutcome
from servobench.hil.commissioning.identify import Array, Mechanics
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_design import Verify, rounded
from servobench.hil.commissioning.steps_dynamics import (
    Delays,
    Response,
    _judge_response,
    _keep_readings,
    _roomy,
    total_delay_s,
)
from servobench.hil.loop.scenario import Quantity
from tests.unit.hil.simulated_shaft import LIMITS, VELOCITY_RAD_S, Shaft, session_of, shaft_of

TRUTH = shaft_of(2e-3, 2e-3, 0.05)


def known(mechanics: Mechanics = TRUTH, **shaft: Any) -> Session:
    """A session whose shaft was identified as ``mechanics``."""
    made = session_of(Shaft(TRUTH, **shaft), mechanics=mechanics)
    made.found.mechanics = mechanics
    return made


# ---- frequency response ----------------------------------------------------------------------------------


def test_the_response_of_a_rigid_shaft_is_that_of_its_inertia() -> None:
    session, outcome = known(), StepOutcome()
    Response().run(session, outcome)
    figures = outcome.figures
    assert figures["inertia_ratio"] == pytest.approx(1.0, abs=0.03)
    assert figures["coherence_min"] > 0.9
    assert figures["frequency_hz"][0] == 2.0
    assert figures["coherent_to_hz"] == figures["frequency_hz"][-1] == 400.0
    assert cast(Any, session).pictures == ["response"]
    assert outcome.lines[0] == "coherence above 0.8 from 2 to 400 Hz"


def test_a_response_that_contradicts_the_ramps_fails() -> None:
    outcome = StepOutcome()
    with pytest.raises(StepFailed) as caught:
        Response().run(known(shaft_of(3e-3, 2e-3, 0.05)), outcome)
    ratio = outcome.figures["inertia_ratio"]
    assert ratio == pytest.approx(2.0 / 3.0, rel=0.05)
    assert caught.value.summary == "response and ramps disagree on the inertia"
    assert caught.value.evidence == f"ratio {ratio:.3f}"


def test_readings_that_are_lost_end_the_response() -> None:
    with pytest.raises(ReadingsLost):
        Response().run(known(lost=10**6), StepOutcome())


def test_the_response_may_spend_four_times_the_work() -> None:
    assert _roomy(LIMITS).energy_j == 4.0 * LIMITS.energy_j
    assert _roomy(LIMITS).power_w == LIMITS.power_w


def test_the_response_is_of_a_drive_with_torques_and_its_plan_tells_the_speed() -> None:
    assert Response().left_out(known()) is None
    assert Response().left_out(known(quantity=Quantity.SPEED)) == "the drive has no torque mode"
    told = "turn at 600 r/min with 28 sines of torque on top, from 2 Hz on, for 6 s"
    assert Response().plan(known()) == told


LINES: Array = np.array([2.0, 4.0, 20.0, 60.0, 100.0, 200.0])
MODEL = 1.0 / (2e-3 * 1j * math.tau * LINES)


def judged(factor: Array, coherence: Array) -> StepOutcome:
    outcome = StepOutcome()
    _judge_response(FrequencyResponse(LINES, factor * MODEL, coherence), MODEL, outcome)
    return outcome


def test_all_that_is_said_of_a_response() -> None:
    """The median of 4 to 60 Hz, both included; the largest rise where it is coherent."""
    factor: Array = np.array([9.0, 1.0 / 0.9, 1.0 / 1.1, 1.0 / 1.2, 3.5, 7.0])
    coherence: Array = np.array([0.79, 0.81, 0.95, 0.9, 0.85, 0.8])
    outcome = judged(factor, coherence)
    assert outcome.lines == [
        "coherence above 0.8 from 4 to 100 Hz",
        "between 4 and 60 Hz the inertia is 1.100 of the identified one",
        "largest rise above the rigid shaft: 3.50 at 100 Hz",
    ]
    assert outcome.headline == outcome.lines[1]
    ratio = outcome.figures["inertia_ratio"]
    assert outcome.quantities == [StatedFigure("inertia over that of the ramps", ratio, "")]
    assert outcome.figures == {
        "inertia_ratio": pytest.approx(1.1),
        "coherence_min": 0.79,
        "coherent_to_hz": 100.0,
        "resonance_ratio": pytest.approx(3.5),
        "frequency_hz": LINES.tolist(),
        "magnitude": pytest.approx((factor * np.abs(MODEL)).tolist()),
        "phase_deg": pytest.approx([-90.0] * 6),
        "coherence": coherence.tolist(),
    }


@pytest.mark.parametrize(
    ("notch_hz", "told"),
    [(12.0, "between 2 and 4 Hz"), (90.0, "between 4 and 25 Hz"), (300.0, "4 and 60 Hz")],
)
def test_a_coupled_shaft_is_held_against_its_inertia_below_its_notch(notch_hz: float, told: str) -> None:
    """Up to 60 Hz a soft one seems to have another inertia than its ramps."""
    lines: Array = np.geomspace(2.0, 400.0, 28)
    model = 1.0 / (2e-3 * 1j * math.tau * lines)
    factor = (1.0 - (lines / notch_hz) ** 2) / (1.0 + 0.01j - (lines / notch_hz) ** 2 / 1.5)
    outcome = StepOutcome()
    _judge_response(FrequencyResponse(lines, factor * model, np.ones(28)), model, outcome)
    assert outcome.figures["inertia_ratio"] == pytest.approx(1.0, abs=0.04)
    assert told in outcome.lines[1]


def test_a_speed_that_does_not_follow_in_the_middle_fails() -> None:
    coherence: Array = np.array([1.0, 0.8, 0.8, 0.8, 1.0, 1.0])
    with pytest.raises(StepFailed) as caught:
        judged(np.ones(6), coherence)
    assert caught.value.summary == "the speed does not follow the torque"
    assert caught.value.evidence == "best coherence 1.00"


# ---- delays ----------------------------------------------------------------------------------------------


def test_without_losses_none_are_in_a_row() -> None:
    session, outcome = known(), StepOutcome()
    session.found.period = Duration(4 * NS_PER_MS)
    _keep_readings(session, outcome, np.array([300.0]), (), 0, 0)
    network = session.found.network
    assert network is not None
    assert (network.losses_in_a_row_max, network.command_losses_in_a_row_max) == (0, 0)
    assert (network.period_us, network.delay_max_us, network.loss_percent) == (4000, 300, 0.0)


def test_the_whole_delay_ends_in_the_middle_of_a_period() -> None:
    session = known()
    found = session.found
    found.reading_delay_us, found.effect_delay_us = 250.0, 700.0
    assert total_delay_s(session) == pytest.approx(950e-6 + 500e-6)
    found.reading_delay_us = found.effect_delay_us = None
    found.period = Duration(4 * NS_PER_MS)
    assert total_delay_s(session) == pytest.approx(2e-3)


class AtRest(Shaft):
    """Tells so many readings while it rests."""

    readings = 1000

    def rest(self, duration: float) -> Recording:
        assert duration == 1.0
        delays: Array = np.linspace(200.0, 300.0, self.readings)
        nothing = np.zeros(self.readings)
        return Recording(nothing, nothing, nothing, nothing, delays, 1000, self.lost, (self.lost,))


def timed(
    readings: int = 1000, lost: int = 0, by_motion_s: float | None = None
) -> tuple[Session, StepOutcome]:
    """Delays of a drive of speeds."""
    shaft = AtRest(TRUTH, quantity=Quantity.SPEED, lost=lost)
    shaft.readings = readings
    session, outcome = session_of(shaft), StepOutcome()
    cast(Any, session).port = SimpleNamespace(whole_only=True)
    session.found.command_to_torque_s = by_motion_s
    session.found.effect_delay_us = None
    Delays().run(session, outcome)
    assert session.port.whole_only is True, "as it was"
    return session, outcome


def test_a_drive_that_tells_no_torque_has_its_readings_timed() -> None:
    session, outcome = timed(lost=100)
    assert outcome.figures == {"reading_delay_us": 250.0, "readings_lost": 100}
    assert outcome.lines == [
        "readings arrive 250 us after the SYNC, 99 % within 299 us; 100 of 1000 were lost"
    ]
    assert session.found.effect_delay_us is None
    told = "time 1 s of readings; what a command does cannot be timed without torque"
    assert Delays().plan(session) == told


@pytest.mark.parametrize(("by_motion_s", "effect_us"), [(900e-6, 650.0), (200e-6, 0.0)])
def test_by_the_motion_the_effect_of_a_command_is_known(by_motion_s: float, effect_us: float) -> None:
    session, outcome = timed(by_motion_s=by_motion_s)
    assert session.found.effect_delay_us == pytest.approx(effect_us)
    assert outcome.figures["effect_delay_us"] == session.found.effect_delay_us
    assert outcome.lines[-1] == f"by the motion a command acts {effect_us:.0f} us after it was sent"


def test_too_few_readings_tell_nothing() -> None:
    timed(readings=100)
    with pytest.raises(StepFailed) as caught:
        timed(readings=99)
    assert (caught.value.summary, caught.value.evidence) == ("too few readings came", "99 of 1000")
    with pytest.raises(ReadingsLost):
        timed(lost=101)


@pytest.mark.parametrize(("period_ms", "count"), [(1, 500), (2, 500), (4, 250), (20, 150)])
def test_the_plan_tells_how_often_the_torque_is_switched(period_ms: int, count: int) -> None:
    """Within 4 s, four cycles each, but 150 to 500 times."""
    session = known()
    session.found.period = Duration(period_ms * NS_PER_MS)
    assert Delays().plan(session) == (
        f"switch the torque {count} times by a little, at shifting instants of the cycle, and see in the "
        "readings when it arrives"
    )


# ---- verification ----------------------------------------------------------------------------------------


def verified(proportional: float, integral: float) -> StepOutcome:
    session, outcome = known(), StepOutcome()
    session.found.controller = {
        "kind": "pid",
        "proportional_nm_s_rad": proportional,
        "integral_nm_rad": integral,
        "feedforward_nm_s_rad": 2e-3,
    }
    try:
        Verify().run(session, outcome)
    finally:
        assert cast(Any, session).pictures == ["verify"]
    return outcome


def test_a_controller_that_holds_the_speed_is_verified() -> None:
    outcome = verified(0.4, 10.0)
    rms, most = outcome.figures["plateau_rms_rad_s"], outcome.figures["error_max_rad_s"]
    speed = 0.5 * LIMITS.speed_rad_s
    assert rms < 0.01 * speed
    assert rms < most < 0.2 * speed
    assert outcome.lines == [
        f"on the plateaus the speed is off by {rms:.3g} rad/s rms ({100.0 * rms / speed:.2f} %), "
        f"on the way by at most {most:.3g} rad/s"
    ]
    assert outcome.quantities == [StatedFigure("speed error on the plateaus, rms", rms, "rad/s")]
    assert Verify().plan(known()) == "follow ramps to +-750 r/min with the suggested controller"


def test_one_that_leaves_more_than_2_percent_fails() -> None:
    """Without an integral friction is made up for by an error of the speed, 0.05 N m here."""
    borne = 0.02 * 0.5 * LIMITS.speed_rad_s + 3.0 * VELOCITY_RAD_S
    assert verified(0.05 / (0.9 * borne), 0.0).figures["plateau_rms_rad_s"] < borne
    with pytest.raises(StepFailed) as caught:
        verified(0.05 / (1.1 * borne), 0.0)
    assert caught.value.summary == "the suggested controller does not hold the speed"
    assert caught.value.evidence.startswith("on the plateaus the speed is off by ")


@pytest.mark.parametrize(
    ("value", "four"), [(0.123456, 0.1235), (123456.0, 123500.0), (-1.00004, -1.0), (0.0, 0.0)]
)
def test_figures_are_written_with_four_digits(value: float, four: float) -> None:
    assert rounded(value) == four
