"""The step that identifies inertia and friction, on a shaft that is known, and all that it says."""

import math
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import ReadingsLost, StatedFigure, StepFailed, StepOutcome
from servobench.hil.commissioning.identify import Array, Mechanics, NotIdentifiable, identify_mechanics
from servobench.hil.commissioning.steps_mechanics import (
    MechanicsStep,
    _by_command,
    _held_s,
    _judge,
    _ramps,
    _speed_noise,
    guide_mechanics,
    tells_torque,
    top_speed,
)
from servobench.hil.loop.scenario import Quantity
from tests.unit.hil.simulated_shaft import LIMITS, Objects, Shaft, session_of, shaft_of

TRUTH = shaft_of(8e-4, 2e-3, 0.05, 0.01)
ROUGH = shaft_of(1e-3, 0.0, 0.06)
FOUND = Mechanics(8.1234567e-4, 2.12345e-3, 0.0512345, 0.0101234, 1.234e-5, 4.567e-5, 7.89e-4, 321, 0.002)


class Run:
    """The step, done."""

    def __init__(self, shaft: Shaft, **found: Any) -> None:
        self.session = session_of(shaft)
        self.outcome = StepOutcome()
        self.session.found.rough = ROUGH
        for name, value in found.items():
            setattr(self.session.found, name, value)
        MechanicsStep().run(self.session, self.outcome)

    @property
    def found(self) -> Mechanics:
        mechanics = self.session.found.mechanics
        assert mechanics is not None
        return mechanics


def close(found: Mechanics, truth: Mechanics, rel: float) -> None:
    assert found.inertia_kg_m2 == pytest.approx(truth.inertia_kg_m2, rel=rel)
    assert found.viscous_friction_nm_s == pytest.approx(truth.viscous_friction_nm_s, rel=3.0 * rel)
    assert found.coulomb_friction_nm == pytest.approx(truth.coulomb_friction_nm, rel=3.0 * rel)
    assert found.offset_nm == pytest.approx(truth.offset_nm, rel=0.1)


@pytest.fixture(scope="module")
def by_torques() -> Run:
    return Run(Shaft(TRUTH))


@pytest.fixture(scope="module")
def by_speeds() -> Run:
    shaft = Shaft(TRUTH, quantity=Quantity.SPEED, mode=Mode.CYCLIC_SYNCHRONOUS_VELOCITY, torque_factor=-1.0)
    return Run(shaft)


def test_by_torques_the_shaft_is_found(by_torques: Run) -> None:
    close(by_torques.found, TRUTH, 5e-3)
    assert by_torques.found.torque_shift_s == pytest.approx(0.0, abs=2e-6)
    assert cast(Any, by_torques.session).pictures == ["mechanics", "angle"]
    assert by_torques.outcome.faults == []
    assert by_torques.outcome.figures["by_command"] is False


def test_what_it_finds_is_told_with_its_noise_of_speed(by_torques: Run) -> None:
    found, outcome = by_torques.found, by_torques.outcome
    noise = by_torques.session.found.speed_noise_rad_s
    fit = "(k = 2, of the fit)"
    viscous = found.viscous_friction_nm_s
    assert outcome.lines[:6] == [
        f"inertia {found.inertia_kg_m2:.5g} kg m^2 +- {found.inertia_error:.2g} {fit}",
        f"viscous friction {viscous:.4g} N m s/rad +- {found.viscous_error:.2g} {fit}",
        f"Coulomb friction {found.coulomb_friction_nm:.4g} N m +- {found.coulomb_error:.2g} {fit}",
        f"torque offset {found.offset_nm:.3g} N m; {found.equations} equations",
        "each of them rests on the rated torque of 6076h, 1.6 N m, which nothing measured",
        f"the velocity 606Ch scatters by {noise:.3g} rad/s rms",
    ]
    ripple_nm = outcome.figures["torque_ripple_nm"]
    assert outcome.lines[6].startswith(f"over a turn the torque varies by +-{ripple_nm:.3g} N m; a point")
    assert [(each.name, each.unit) for each in outcome.quantities[3:]] == [
        ("torque over the angle, half of peak to peak", "N m")
    ]
    assert outcome.quantities[3].value == ripple_nm
    assert outcome.figures["speed_noise_rad_s"] == noise
    assert {name: outcome.figures[name] for name in asdict(found)} == asdict(found)
    assert outcome.figures["coverage_factor"] == 2.0


def test_a_torque_that_counts_against_the_position_is_turned_round(by_speeds: Run) -> None:
    close(by_speeds.found, TRUTH, 0.03)
    assert by_speeds.session.found.override.torque_sign == -1.0
    assert len(cast(Any, by_speeds.session).configured) == 1
    told = "polarity: torque 6077h counts against the position; the bench turns its sign"
    assert by_speeds.outcome.faults == [told]


def test_a_torque_that_counts_with_the_position_is_left(by_torques: Run) -> None:
    assert by_torques.session.found.override.torque_sign == 1.0
    assert cast(Any, by_torques.session).configured == []


def test_a_drive_that_tells_no_torque_is_believed_its_command() -> None:
    """Twice the standard uncertainty of 5 % of the torque constant."""
    run = Run(Shaft(TRUTH), plan=cast(Any, SimpleNamespace(tpdo_with=lambda _index: None)))
    close(run.found, TRUTH, 5e-3)
    assert run.found.inertia_error == pytest.approx(0.1 * run.found.inertia_kg_m2, rel=0.01)
    assert run.outcome.figures["by_command"] is True
    assert run.session.found.command_to_torque_s == pytest.approx(0.0, abs=2e-6)


def test_an_instant_of_acting_that_is_taken_for_another_is_found_by_the_motion() -> None:
    """Readings and commands seem to take 0.3 ms; the torque of a cycle acts at once."""
    run = Run(Shaft(TRUTH), reading_delay_us=100.0, effect_delay_us=200.0)
    assert run.found.torque_shift_s == pytest.approx(-300e-6, abs=5e-6)
    close(run.found, TRUTH, 5e-3)


def test_readings_that_are_lost_end_it() -> None:
    with pytest.raises(ReadingsLost):
        Run(Shaft(TRUTH, lost=10**6))


def test_a_speed_of_less_than_20_rpm_shows_nothing() -> None:
    """[limits] of the nameplate allow too little."""
    for travel_rad, fails in ((1.0, True), (20.0, False)):
        session = session_of(Shaft(TRUTH), limits=replace(LIMITS, travel_rad=travel_rad))
        session.found.rough = ROUGH
        speed = 0.8 * travel_rad / (0.25 + 0.65 * 1.95)
        assert top_speed(session) == pytest.approx(speed)
        if not fails:
            assert speed > 20.0 * math.pi / 30.0
            continue
        with pytest.raises(StepFailed) as caught:
            MechanicsStep().run(session, StepOutcome())
        assert caught.value.summary == "too little travel or speed is allowed"
        assert caught.value.evidence == f"{speed:.3g} rad/s could be reached"


@pytest.mark.parametrize(
    ("quantity", "told", "reason"),
    [
        (Quantity.TORQUE, False, None),
        (Quantity.SPEED, True, None),
        (
            Quantity.SPEED,
            False,
            "the drive tells no torque, and has no torque mode in which it is given one",
        ),
    ],
)
def test_it_needs_a_torque_that_is_told_or_given(quantity: Quantity, told: bool, reason: str | None) -> None:
    session = session_of(Shaft(TRUTH, quantity=quantity))
    if not told:
        session.found.plan = cast(Any, SimpleNamespace(tpdo_with=lambda _index: None))
    assert MechanicsStep().left_out(session) == reason


@pytest.mark.parametrize("quantity", [Quantity.TORQUE, Quantity.SPEED])
def test_the_plan_tells_the_speed_and_whether_the_shaft_coasts(quantity: Quantity) -> None:
    """0.9 of the limit of 1500 r/min."""
    coast = ", and let the shaft coast" if quantity is Quantity.TORQUE else ""
    told = f"ramp to 1350 r/min and back, both ways, with stops on the way{coast}"
    assert MechanicsStep().plan(session_of(Shaft(TRUTH, quantity=quantity))) == told


@pytest.mark.parametrize("index", [Object.TORQUE_ACTUAL_VALUE, Object.CURRENT_ACTUAL_VALUE])
def test_torque_or_current_is_told(index: int) -> None:
    session = session_of(Shaft(TRUTH))
    assert tells_torque(session), "before there is a plan"
    plan = SimpleNamespace(tpdo_with=lambda asked: object() if asked == index else None)
    session.found.plan = cast(Any, plan)
    assert tells_torque(session)
    session.found.plan = cast(Any, SimpleNamespace(tpdo_with=lambda _asked: None))
    assert not tells_torque(session)


def test_from_a_sync_until_its_torque_acts() -> None:
    """Measured, else 5.8 frames of a command."""
    session = session_of(Shaft(TRUTH))
    found = session.found
    found.reading_delay_us, found.effect_delay_us = 250.0, 730.0
    assert _held_s(session) == pytest.approx(980e-6)
    for reading_us, effect_us in ((None, 730.0), (250.0, None)):
        found.reading_delay_us, found.effect_delay_us = reading_us, effect_us
        assert _held_s(session) == pytest.approx(5.8e-9 * session.timing().command_latency)
    assert _held_s(session_of(Shaft(TRUTH, quantity=Quantity.SPEED))) is None


def test_the_noise_of_the_speed_is_that_of_white_noise_on_ramps() -> None:
    random = np.random.default_rng(4)
    time: Array = np.linspace(0.0, 3.999, 4000)
    empty = np.zeros(4000)

    def recording(velocity: Any) -> Recording:
        return Recording(time, empty, velocity, empty, empty, 4000, 0, ())

    ramp = 30.0 * time
    assert _speed_noise([recording(ramp)]) == pytest.approx(0.0, abs=1e-9)
    noisy = [recording(ramp + 0.4 * random.normal(size=4000)) for _ in range(2)]
    assert _speed_noise(noisy) == pytest.approx(0.4, rel=0.02)


# ---- what is said --------------------------------------------------------------------------------------


def test_all_that_is_said_of_a_shaft() -> None:
    outcome = StepOutcome()
    _judge(FOUND, outcome)
    assert outcome.lines == [
        "inertia 0.00081235 kg m^2 +- 1.2e-05 (k = 2, of the fit)",
        "viscous friction 0.002123 N m s/rad +- 4.6e-05 (k = 2, of the fit)",
        "Coulomb friction 0.05123 N m +- 0.00079 (k = 2, of the fit)",
        "torque offset 0.0101 N m; 321 equations",
    ]
    assert outcome.quantities == [
        StatedFigure("inertia", 8.1234567e-4, "kg m^2", 1.234e-5),
        StatedFigure("viscous friction", 2.12345e-3, "N m s/rad", 4.567e-5),
        StatedFigure("Coulomb friction", 0.0512345, "N m", 7.89e-4),
    ]
    assert outcome.figures == {**asdict(FOUND), "coverage_factor": 2.0, "by_command": False}


@pytest.mark.parametrize(
    ("by_command", "inertia", "relative", "trusted"),
    [
        (False, 1e-3, 0.0499, True),
        (False, 1e-3, 0.0501, False),
        (True, 1e-3, 0.1499, True),
        (True, 1e-3, 0.1501, False),
        (False, 0.0, 0.0, False),
        (False, -1e-3, 0.01, False),
    ],
)
def test_an_inertia_is_trusted_to_5_percent_and_15_by_the_commanded_torque(
    by_command: bool, inertia: float, relative: float, trusted: bool
) -> None:
    outcome = StepOutcome(figures={"by_command": by_command})
    mechanics = replace(FOUND, inertia_kg_m2=inertia, inertia_error=relative * abs(inertia))
    if trusted:
        _judge(mechanics, outcome)
        assert outcome.figures["by_command"] is by_command
        return
    with pytest.raises(StepFailed) as caught:
        _judge(mechanics, outcome)
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "the inertia is not to be trusted",
        "; ".join(outcome.lines),
        "is the load coupled softly?",
    )


def test_a_commanded_torque_widens_what_is_stated() -> None:
    """By a tenth of each figure, squares added."""
    session, outcome = session_of(Shaft(TRUTH)), StepOutcome()
    session.found.reading_delay_us, session.found.effect_delay_us = 200.0, 300.0
    known = Mechanics(4e-3, 5e-3, 0.06, 0.01, 3e-4, 12e-4, 8e-3, 99, 0.001, torque_shift_s=40e-6)
    found = _by_command(session, known, outcome)
    widened = [found.inertia_error, found.viscous_error, found.coulomb_error]
    assert widened == pytest.approx([5e-4, 1.3e-3, 0.01])
    same = replace(found, inertia_error=3e-4, viscous_error=12e-4, coulomb_error=8e-3)
    assert same == known
    assert session.found.command_to_torque_s == pytest.approx(540e-6)
    assert outcome.figures == {"by_command": True}
    assert outcome.lines == [
        "the drive tells no torque (6077h, 6078h): the commanded one is taken, in units of 6076h, with "
        "10 % (k = 2) for what the drive makes of it"
    ]


# ---- the motion ------------------------------------------------------------------------------------------


def test_a_drive_with_ramps_of_its_own_is_given_their_steepness() -> None:
    """To the top speed in 2.5 times a quarter of a second."""
    ramps = (Object.PROFILE_ACCELERATION, Object.PROFILE_DECELERATION)
    objects = Objects({(index, 0): 1 for index in ramps})
    shaft = Shaft(TRUTH, objects, Quantity.SPEED, Mode.PROFILE_VELOCITY)
    session = session_of(shaft)
    forward, backward = _ramps(session, 100.0)
    raw = round(100.0 / 0.625 / session.told.acceleration_rad_s2)
    assert objects.written == [(index, 0, "I", raw) for index in ramps]
    steps = {round(float(speed), 6) for speed in np.abs(forward.velocity)}
    assert steps == {0.0, 30.0, 65.0, 100.0}, "each at once"
    assert np.all(backward.velocity == -forward.velocity)
    assert forward.velocity[-1] == 0.0


def test_a_ramp_takes_a_quarter_of_a_second_or_what_six_tenths_of_the_torque_take() -> None:
    """Three plateaus and a stop; a tenfold inertia needs longer ramps for the same torque."""
    for inertia, first_s in ((1e-4, 0.25), (1e-2, 1e-2 * 30.0 / (0.6 * LIMITS.torque_nm))):
        session = session_of(Shaft(TRUTH, quantity=Quantity.SPEED))
        session.found.mechanics = shaft_of(inertia)
        forward, _ = _ramps(session, 100.0)
        reached = float(forward.time[np.argmax(forward.velocity >= 30.0 - 1e-9)])
        assert reached == pytest.approx(0.05 + 2.5 * first_s, abs=2e-3)


def test_what_is_known_of_the_shaft_guides_an_exercise() -> None:
    session = session_of(Shaft(TRUTH))
    session.found.rough = ROUGH
    assert guide_mechanics(session) is ROUGH
    session.found.mechanics = TRUTH
    assert guide_mechanics(session) is TRUTH
    session.found.rough = session.found.mechanics = None
    with pytest.raises(AssertionError, match="the pulses come first"):
        guide_mechanics(session)


# ---- what the fit refuses --------------------------------------------------------------------------------


def still(count: int) -> tuple[Any, Any, Any]:
    time = 1e-3 * np.arange(count)
    return time, 30.0 * time + 2.0 * time**2, np.full(count, 0.1)


@pytest.mark.parametrize(
    ("records", "why"),
    [
        ([], "0 usable windows of 0.1 s"),
        ([still(11)], "0 usable windows of 0.1 s"),
        ([still(100)], "0 usable windows of 0.1 s"),
        ([still(101)], "1 usable windows of 0.1 s"),
        ([still(251), still(11)], "7 usable windows of 0.1 s"),
        ([(*still(1000)[:2], np.zeros(1000))], "friction and inertia cannot be told apart in this motion"),
    ],
)
def test_the_fit_tells_why_it_cannot(records: list[Any], why: str) -> None:
    """A window each quarter of 0.1 s, and two equations for each of four figures."""
    with pytest.raises(NotIdentifiable) as caught:
        identify_mechanics(records, 0.1)
    assert str(caught.value) == why
