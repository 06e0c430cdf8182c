"""Which of several homings show one turn of the motor, and not none or several."""

from types import SimpleNamespace
from typing import cast

import pytest

from servobench.hil.commissioning import turn
from servobench.hil.commissioning.session import Session

TURN = 6.25
"""What a turn is worth, in the wrong unit."""


def turn_by(
    monkeypatch: pytest.MonkeyPatch, *searches: tuple[float, float] | None
) -> tuple[float | None, int]:
    """What is taken for a turn after homings with these jumps and overshoots, and how many it took."""
    left = iter(searches)
    asked = []

    def search(_session: Session, limit_s: float) -> turn._Homing | None:
        asked.append(limit_s)
        each = next(left)
        return None if each is None else turn._Homing(*each)

    monkeypatch.setattr(turn, "_search", search)
    return turn._by_searches(cast(Session, None)), len(asked)


def test_the_second_homing_shows_a_turn_whichever_way_the_position_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for sign in (1.0, -1.0):
        assert turn_by(monkeypatch, (1.0, 0.1), (sign * TURN, 0.1)) == (TURN, 2)


def test_a_shaft_that_may_have_run_over_a_further_pulse_shows_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Behind half a turn it could be two: four tenths are allowed, of what would be the turn."""
    assert turn_by(monkeypatch, (1.0, 2.49), (TURN, 9.0)) == (TURN, 2)
    assert turn_by(monkeypatch, (1.0, 2.5), (TURN, 9.0), (TURN, 9.0), (TURN, 9.0)) == (None, 4)
    assert turn_by(monkeypatch, (1.0, 2.51), (2.0 * TURN, 1.0), (TURN, 1.0)) == (2.0 * TURN, 2)


def test_the_overshoot_of_the_homing_before_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    assert turn_by(monkeypatch, (1.0, 9.0), (TURN, 0.1), (TURN, 9.0)) == (TURN, 3)


def test_the_same_pulse_found_again_is_no_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    assert turn_by(monkeypatch, (1.0, -0.1), (0.0, -0.1), (TURN, 0.1)) == (TURN, 3)


def test_a_turn_may_be_worth_less_than_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the unit that the drive tells is ten times too small."""
    assert turn_by(monkeypatch, (1.0, 0.1), (0.628, 0.1)) == (0.628, 2)


def test_no_pulse_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    assert turn_by(monkeypatch, None) == (None, 1)
    assert turn_by(monkeypatch, (1.0, 0.1), None) == (None, 2)


def test_four_homings_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    assert turn_by(monkeypatch, *[(1.0, 9.0)] * 5) == (None, 4)


def turned_by_hand(before: int, after: int, reply: str = "") -> tuple[float | None, str]:
    """What a turn by hand is worth between two positions 6064h."""
    positions = iter((before, after))
    session = SimpleNamespace(
        dialog=SimpleNamespace(line=lambda _question, _idle: reply),
        objects=SimpleNamespace(read=lambda *_object: next(positions)),
        idle=lambda: None,
    )
    return turn.hand_turn(cast(Session, session))


@pytest.mark.parametrize(
    ("before", "after"),
    [(100, 4196), (4196, 100), (0x7FFF_FF00, -0x7FFF_F100), (-0x7FFF_F100, 0x7FFF_FF00)],
    ids=["up", "down", "up over the end of the counter", "down over it"],
)
def test_a_turn_by_hand_is_the_way_between_two_positions(before: int, after: int) -> None:
    assert turned_by_hand(before, after) == (4096.0, "by hand")


@pytest.mark.parametrize(("after", "reply"), [(100, ""), (4196, "s")])
def test_a_shaft_that_was_not_turned_by_hand_shows_nothing(after: int, reply: str) -> None:
    assert turned_by_hand(100, after, reply) == (None, "the shaft was not turned by hand")
