"""The best feedback for the loop that really runs."""

import numpy as np
import pytest

from servobench.design.delay.delay_loop import Feedback
from servobench.design.errors import NoSolution
from servobench.design.papers.ling2012 import MODEL
from servobench.design.sampled.analysis import analyse_sampled, regular_patterns
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import slowest_pattern, worst_gain
from servobench.design.speed.sampled_design import least_sampled_gain
from servobench.design.speed.speed_design import SpeedDesign, least_gain

pytestmark = pytest.mark.long

NETWORK = SampledNetwork(Strategy.ARRIVAL, 0.002, 1, 0.001)


@pytest.fixture(scope="module")
def by_speed() -> SpeedDesign:
    """With speed feedback only."""
    return least_sampled_gain(MODEL, NETWORK, Feedback.SPEED)


def largest_gain(K: np.ndarray) -> float:
    loop = HeldLoop(MODEL, K, NETWORK)
    return worst_gain(loop, [*regular_patterns(loop), slowest_pattern(loop)]).gain


def test_it_beats_the_design_for_the_constant_delay(by_speed: SpeedDesign) -> None:
    constant = least_gain(MODEL, NETWORK.age_max_s, Feedback.SPEED)
    assert by_speed.gain == pytest.approx(largest_gain(by_speed.K), rel=2e-3)
    assert by_speed.gain < 0.95 * largest_gain(constant.K)
    assert by_speed.K[0] == 0.0


def test_no_neighbour_is_better(by_speed: SpeedDesign) -> None:
    """The gain is that of the worst pattern, so that what made the old figure small does not pass."""
    for factor in (0.93, 1.07):
        assert largest_gain(factor * by_speed.K) > by_speed.gain


def test_every_pattern_decays_and_it_is_certified(by_speed: SpeedDesign) -> None:
    net = SampledNetwork(Strategy.ARRIVAL, 0.002, 0, 0.001)
    found = least_sampled_gain(MODEL, net)
    assert slowest_pattern(HeldLoop(MODEL, found.K, net)).decay_per_s >= 0.2 / net.age_max_s
    analysis = analyse_sampled(MODEL, found.K, net)
    assert analysis.certified
    assert analysis.gain_certified is not None
    assert found.gain * 0.999 <= analysis.gain_certified < 1.1 * found.gain
    assert found.gain < by_speed.gain


def test_history_waits_and_so_reaches_less(by_speed: SpeedDesign) -> None:
    waits = SampledNetwork(Strategy.HISTORY, 0.002, 1, 0.001, 0.003)
    assert by_speed.gain < least_sampled_gain(MODEL, waits, Feedback.SPEED).gain


def test_what_no_pattern_lets_be_stable_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servobench.design.speed.sampled_design._DECAY", 1e4)
    monkeypatch.setattr("servobench.design.speed.sampled_design._EXCHANGES", 1)
    with pytest.raises(NoSolution, match="no gain was found"):
        least_sampled_gain(MODEL, NETWORK, Feedback.SPEED)
