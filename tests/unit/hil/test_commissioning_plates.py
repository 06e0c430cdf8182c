"""What nameplate and drive say against each other."""

import math
from types import SimpleNamespace
from typing import cast

import pytest

from drivers.cia402.objects402 import Object
from drivers.cia402.scaling import FACTOR_OBJECTS, scaling_from
from drivers.errors import PeerFault
from hil.commissioning.outcome import StepFailed
from hil.commissioning.session import Session, nameplate_wins
from hil.commissioning.steps_static import _plausible


def asking(answer: str | None, trusted: bool = False) -> Session:
    """A session in which somebody answers, or nobody is there."""
    dialog = SimpleNamespace(attended=answer is not None, line=lambda _question, _idle: answer or "")
    request = SimpleNamespace(trust_nameplate=trusted)
    return cast(Session, SimpleNamespace(dialog=dialog, request=request, idle=lambda: None))


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
