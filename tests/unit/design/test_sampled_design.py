"""The best feedback for the loop that really runs."""

import numpy as np
import pytest

from design.errors import NoSolution
from design.held_loop import HeldLoop, SampledNetwork, Strategy
from design.lifting import sampled_gain
from design.loss_patterns import chain_of, worst_pattern
from design.papers.ling2012 import MODEL
from design.sampled import analyse_sampled, regular_patterns
from design.sampled_design import least_sampled_gain
from design.speed_design import least_gain
from design.speed_loop import Feedback

NETWORK = SampledNetwork(Strategy.ARRIVAL, 0.002, 1, 0.001)


def largest_gain(K: object, network: SampledNetwork) -> float:
    loop = HeldLoop(MODEL, np.asarray(K), network)
    return max(sampled_gain(loop, chain_of(loop, pattern)) for pattern in regular_patterns(loop))


def test_it_beats_the_design_for_the_constant_delay() -> None:
    constant = least_gain(MODEL, NETWORK.age_max_s, Feedback.SPEED)
    found = least_sampled_gain(MODEL, NETWORK, Feedback.SPEED)
    assert found.gain == pytest.approx(largest_gain(found.K, NETWORK), rel=1e-9)
    assert found.gain < 0.92 * largest_gain(constant.K, NETWORK)
    assert found.K[0] == 0.0


def test_no_neighbour_is_better() -> None:
    found = least_sampled_gain(MODEL, NETWORK, Feedback.SPEED)
    for factor in (0.97, 1.03):
        assert largest_gain(factor * found.K, NETWORK) > found.gain


def test_every_pattern_decays_and_it_can_be_certified() -> None:
    found = least_sampled_gain(MODEL, NETWORK)
    assert worst_pattern(HeldLoop(MODEL, found.K, NETWORK)).decay_per_s >= 0.2 / NETWORK.age_max_s
    assert analyse_sampled(MODEL, found.K, NETWORK).certified
    assert found.gain < least_sampled_gain(MODEL, NETWORK, Feedback.SPEED).gain


def test_history_waits_and_so_reaches_less() -> None:
    waits = SampledNetwork(Strategy.HISTORY, 0.002, 1, 0.001, 0.003)
    arrival, history = (least_sampled_gain(MODEL, each, Feedback.SPEED) for each in (NETWORK, waits))
    assert arrival.gain < history.gain


def test_what_no_pattern_lets_be_stable_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("design.sampled_design._DECAY", 1e4)
    monkeypatch.setattr("design.sampled_design._EXCHANGES", 1)
    with pytest.raises(NoSolution, match="no gain was found"):
        least_sampled_gain(MODEL, NETWORK, Feedback.SPEED)
