"""Whose word is taken for pole pairs, winding and torque constant: the drive's or the nameplate's."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.cia402.told_motor import ToldFigure, ToldMotor
from servobench.hil.commissioning.files import _by_word
from servobench.hil.commissioning.findings import Findings, StepFailed, StepOutcome
from servobench.hil.commissioning.nameplate import (
    compare_constant,
    compare_ratings,
    rated_current,
    settle_winding,
)
from servobench.hil.commissioning.session import Session
from tests.unit.hil.simulated_shaft import Answering, Shaft, request_of, session_of, shaft_of

PLATE = {
    "motor": {"resistance_ohm": 0.5, "inductance_d_h": 1e-3, "inductance_q_h": 1e-3, "pole_pairs": 5},
    "rating": {"torque_nm": 2.0, "current_a": 4.0},
}


def told(convention: str = "", **values: float) -> ToldMotor:
    """What a drive tells."""
    figures = {
        name: ToldFigure(name, value, 7, "2000h:01", "x.toml", convention) for name, value in values.items()
    }
    return ToldMotor(figures)


def settled(tells: ToldMotor, answer: str | None = None, **plate: Any) -> tuple[Findings, StepOutcome]:
    """With somebody who gives ``answer`` to each question, or nobody."""

    dialog = Answering(answer)
    session = session_of(Shaft(shaft_of(1e-3)), request=request_of(plate or PLATE), dialog=dialog)
    session.found.motor = tells
    outcome = StepOutcome()
    settle_winding(session, outcome)
    assert answer or not dialog.asked
    return session.found, outcome


def test_where_both_agree_nobody_is_asked() -> None:
    found, outcome = settled(told(pole_pairs=5, resistance_ohm=0.505, torque_constant_nm_a=0.52), answer="")
    assert found.value("pole_pairs") == 5
    assert found.value("resistance_ohm") == 0.5
    assert outcome.figures["pole_pairs_confirmed"] is True
    assert not outcome.faults
    assert outcome.lines[0].endswith("and by the nameplate")
    assert outcome.lines[1].endswith("the nameplate's 0.5 is taken")


@pytest.mark.parametrize(("answer", "taken"), [("n", 5), ("d", 2)])
def test_two_pole_pairs_for_five_are_asked_about(answer: str, taken: int) -> None:
    found, outcome = settled(told(pole_pairs=2), answer)
    assert found.value("pole_pairs") == taken
    assert len(outcome.faults) == 1
    assert outcome.figures["pole_pairs_confirmed"] is False
    with pytest.raises(StepFailed, match=r"pole pairs: the nameplate says 5, the drive 2 \(2000h:01\)"):
        settled(told(pole_pairs=2))


@pytest.mark.parametrize(("answer", "taken"), [("n", 0.5), ("d", 1.0)])
def test_twice_the_resistance_is_asked_about(answer: str, taken: float) -> None:
    found, outcome = settled(told("lines", pole_pairs=5, resistance_ohm=1.0), answer)
    assert found.value("resistance_ohm") == taken
    assert found.stated["resistance_ohm"].told is (answer == "d")
    assert len(outcome.faults) == 1
    with pytest.raises(StepFailed, match="between two lines taken for a phase"):
        settled(told("lines", resistance_ohm=1.0))


def test_what_the_drive_alone_tells_is_said_to_be_told() -> None:
    motor = told("own", pole_pairs=4, resistance_ohm=0.3, inductance_q_h=2e-3, torque_constant_nm_a=0.1)
    found, outcome = settled(motor, motor={"inductance_q_h": 2e-3})
    assert found.value("torque_constant_nm_a") == 0.1
    assert sum("and by nobody else" in line for line in outcome.lines) == 3
    assert (
        "0.1 N m/A of the drive, told by the drive: object 2000h:01 = 7 in the drive's own"
        in outcome.lines[-2]
    )
    notes = _by_word(found)
    assert notes[0] == "Not measurable over CiA 402, by the nameplate: inductance."
    assert len(notes) == 4
    assert notes[-1].startswith("Not measured: torque constant, told by the drive")


def test_a_measured_torque_constant_that_contradicts_the_told_one_is_a_fault() -> None:
    outcome = StepOutcome()
    compare_constant(told("rms", torque_constant_nm_a=0.5), 0.53, outcome)
    assert not outcome.faults
    compare_constant(told("rms", torque_constant_nm_a=0.5), 1.0, outcome)
    assert "by 2: 6076h, the rated current or 2000h:01 is wrong" in outcome.faults[0]
    assert outcome.figures["told_nm_a"] == 0.5


@pytest.mark.parametrize(
    ("motor", "faults"),
    [
        (told("peak", rated_current_a=4.0), 0),
        (told("rms", rated_current_a=5.657), 1),
        (told("own", rated_current_a=5.657), 0),
        (told("own", rated_current_a=5.0), 1),
        (told(), 1),
    ],
)
def test_the_makers_rated_current_goes_before_6075h(motor: ToldMotor, faults: int) -> None:
    """6075h holds 5657 mA: the peak of 4 A, which the standard would have as rms."""
    session = SimpleNamespace(
        request=request_of(PLATE),
        objects=SimpleNamespace(read_if_there=lambda _index: 5657),
        found=Findings(motor=motor),
    )
    outcome = StepOutcome()
    compare_ratings(cast(Session, session), outcome, 2.0)
    assert len(outcome.faults) == faults
    source = rated_current(cast(Session, session))[1]
    assert source == ("2000h:01" if motor.figures else "6075h")
