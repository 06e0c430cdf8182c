"""Certificates of a sampled loop: what they count, what they refuse, and when they stop asking."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from servobench.design.delay.delay_loop import speed_model
from servobench.design.delay.lmi import LmiProblem, MatrixInequality, Unknowns
from servobench.design.sampled import sequence_certificate
from servobench.design.sampled.analysis import analyse_sampled, regular_patterns
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.sequence_certificate import SequenceCertificate, certify_gain
from servobench.design.sampled.sequence_inequalities import Inequalities, exchanged
from tests.motors import LING


@pytest.mark.long
def test_what_is_held_for_a_moment_under_the_worst_pattern_still_counts() -> None:
    """At a delay of 1.017 periods the worst pattern holds the oldest sample for 0.017 of one only, another
    for the whole: a certificate in units of the worst alone found nothing."""
    model = speed_model(LING, current_bandwidth_hz=51.74)
    h = 0.0029314489
    loop = SampledNetwork(Strategy.ARRIVAL, h, 0, 1.01681 * h)
    analysis = analyse_sampled(model, np.array([-0.17577192, -0.01372602]), loop)
    assert analysis.gain_certified is not None
    assert analysis.gain_found <= analysis.gain_certified <= 1.005 * analysis.gain_found


def test_losses_alone_do_not_make_stamps_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """From delivery to delivery there is one node, however many are lost: 40 states are not refused."""
    loop = HeldLoop(
        speed_model(LING),
        np.array([0.0, -0.0212]),
        SampledNetwork(Strategy.STAMP, 0.002, 5, 0.02, 37 * 0.002),
    )
    assert loop.kept == 40
    monkeypatch.setattr(sequence_certificate, "least_gain", lambda *_: SequenceCertificate([], 0.0, 1.0))
    assert certify_gain(loop, regular_patterns(loop)[:1], 1e3) is not None


def test_corners_that_cannot_be_met_are_not_asked_for_again() -> None:
    """A solver that stops short of one that it was given gets the same problem no second time."""

    class OneBroken:
        """One edge of three corners, the first of which never holds."""

        nodes = 1
        edges = (SimpleNamespace(corners=SimpleNamespace(times_s=np.zeros((3, 1)))),)

        def slack(self, *given: Any) -> np.ndarray:
            return np.asarray(np.array([-1.0, 1.0, 1.0])[given[-1]])

    unknowns = Unknowns()
    unknowns.symmetric("P0", 1)
    unknowns.symmetric("objective", 1)
    own = MatrixInequality(np.zeros((1, 1)), np.array([[[1.0]], [[0.0]]]))
    level = MatrixInequality(-np.ones((1, 1)), np.array([[[0.0]], [[1.0]]]))
    bound = MatrixInequality(np.ones((1, 1)), np.array([[[-1.0]], [[0.0]]]))
    problem = LmiProblem("three corners", unknowns, [own, level, bound], np.array([0.0, 1.0]))
    asked = []

    def build(chosen: Sequence[Sequence[int]]) -> LmiProblem:
        asked.append(chosen)
        return problem

    assert exchanged(cast(Inequalities, OneBroken()), build, 1.0) is not None
    assert len(asked) == 1
