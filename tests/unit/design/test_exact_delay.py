"""The largest delay for a wanted gain, where the ordinary search has no start."""

import pytest

from design.delay_norm import hinf_norm
from design.errors import NoSolution
from design.exact_delay import largest_exact_delay
from design.papers.ling2012 import MODEL
from design.speed_design import largest_delay, least_gain
from design.speed_loop import Feedback

SMALL = 5.235987755982989
"""2 per cent of 1500 r/min under 0.6 N m, in SI."""


def test_where_there_is_a_start_it_is_the_ordinary_search() -> None:
    assert largest_exact_delay(MODEL, 125.0, Feedback.SPEED).delay_s == pytest.approx(0.0653718, abs=1e-6)


@pytest.mark.parametrize(("gamma", "delay_s"), [(SMALL, 2.04e-4), (6.283185307179586, 4.87e-4)])
def test_small_gains_by_the_least_gain(gamma: float, delay_s: float) -> None:
    found = largest_exact_delay(MODEL, gamma, Feedback.SPEED)
    assert found.delay_s == pytest.approx(delay_s, abs=2e-6)
    assert hinf_norm(MODEL.loop(found.K, found.delay_s)) <= gamma * (1.0 + 1e-6)
    # at a delay that is a little longer nothing keeps it
    assert least_gain(MODEL, found.delay_s * 1.001, Feedback.SPEED).gain > gamma


def test_both_ways_agree_where_both_go(monkeypatch: pytest.MonkeyPatch) -> None:
    ordinary = largest_delay(MODEL, 8.0, Feedback.SPEED)

    def no_start(*_: object) -> None:
        raise NoSolution("feedback", "no start")

    monkeypatch.setattr("design.exact_delay.largest_delay", no_start)
    assert largest_exact_delay(MODEL, 8.0, Feedback.SPEED).delay_s == pytest.approx(
        ordinary.delay_s, rel=1e-5
    )
    with pytest.raises(NoSolution, match="no delay was found"):
        largest_exact_delay(MODEL, 3.0, Feedback.SPEED)
