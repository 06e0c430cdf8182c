"""What nameplate and drive say against each other."""

import math

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS, scaling_from
from servobench.drivers.errors import PeerFault
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.nameplate import confirm_pole_pairs, nameplate_wins
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_static import _plausible
from tests.unit.hil.simulated_shaft import Answering, Shaft, request_of, session_of, shaft_of


def asking(answer: str | None, trusted: bool = False) -> Session:
    """A session in which somebody answers, or nobody is there."""
    request = request_of({"motor": {"pole_pairs": 5}}, trust_nameplate=trusted)
    return session_of(Shaft(shaft_of(1e-3)), request=request, dialog=Answering(answer))


@pytest.mark.parametrize(("answer", "wins"), [("n", True), ("D", False)])
def test_who_is_right_is_asked(answer: str, wins: bool) -> None:
    assert nameplate_wins(asking(answer), "rated torque", "2 N m", "20 N m (6076h)") is wins


def test_with_nobody_there_it_is_refused_unless_the_plate_is_to_be_trusted() -> None:
    with pytest.raises(StepFailed, match="the nameplate says 2 N m, the drive 20 N m") as caught:
        nameplate_wins(asking(None), "rated torque", "2 N m", "20 N m")
    assert "--trust-nameplate" in str(caught.value)
    assert nameplate_wins(asking(None, trusted=True), "rated torque", "2 N m", "20 N m")


def test_no_answer_is_no_consent() -> None:
    with pytest.raises(StepFailed, match="no answer"):
        nameplate_wins(asking(""), "rated torque", "2 N m", "20 N m")


@pytest.mark.parametrize(("increments", "taken"), [(1, False), (4, False), (6, True), (4096, True)])
def test_a_position_unit_of_half_a_turn_is_no_resolution(increments: int, taken: bool) -> None:
    """608Fh of a drive that nobody has set up is 1/1: one unit would be 6.28 rad."""
    values: dict[tuple[int, int], int | None] = dict.fromkeys(FACTOR_OBJECTS)
    values[Object.POSITION_ENCODER_RESOLUTION, 1] = increments
    values[Object.POSITION_ENCODER_RESOLUTION, 2] = 1
    values[Object.MOTOR_RATED_TORQUE, 0] = 1000
    told = scaling_from(values)
    assert told.position_rad == pytest.approx(math.tau / increments)
    if taken:
        assert _plausible(told) is told
    else:
        with pytest.raises(PeerFault, match="one position unit would be"):
            _plausible(told)


@pytest.mark.parametrize(("answer", "found"), [("5", 5), ("2", 2)])
def test_pole_pairs_are_said_at_the_motor(answer: str, found: int) -> None:
    """The file says 5; a slip of the file shows only if somebody looks."""
    session, outcome = asking(answer), StepOutcome()
    confirm_pole_pairs(session, outcome)
    assert session.found.value("pole_pairs") == found
    assert "not measurable over CiA 402" in outcome.lines[0]
    assert [("5 is not believed" in fault) for fault in outcome.faults] == ([True] if found != 5 else [])


@pytest.mark.parametrize("answer", ["", "yes", "0", "-2", "500", "2.5"])
def test_pole_pairs_are_a_number_or_the_step_fails(answer: str) -> None:
    with pytest.raises(StepFailed, match="the nameplate file says 5"):
        confirm_pole_pairs(asking(answer), StepOutcome())


def test_with_nobody_there_pole_pairs_are_said_to_be_unmeasured() -> None:
    session, outcome = asking(None), StepOutcome()
    confirm_pole_pairs(session, outcome)
    assert session.found.value("pole_pairs") == 5
    assert outcome.lines == ["pole pairs: not measurable over CiA 402; 5, by the nameplate file alone"]
    assert outcome.figures == {"pole_pairs_confirmed": False}
