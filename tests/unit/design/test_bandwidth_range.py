"""The current bandwidths for which a certificate holds."""

import numpy as np
import pytest

from servobench.design.delay.delay_loop import SpeedModel, speed_model
from servobench.design.delay.delay_norm import hinf_norm
from servobench.design.sampled.analysis import analyse_sampled, regular_patterns
from servobench.design.sampled.bandwidth_range import (
    BandwidthRange,
    bandwidth_range,
    constant_bandwidth_range,
)
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import pattern_of, worst_gain
from servobench.hil.configuration.controller_files import CurrentLoop
from tests.motors import LING

NETWORK = SampledNetwork(Strategy.ARRIVAL, 0.001, 0, 0.001)
K = np.array([-0.2776, -1.1527])


def model_at(bandwidth_hz: float) -> SpeedModel:
    return speed_model(LING, current_bandwidth_hz=bandwidth_hz)


@pytest.mark.long
def test_what_is_certified_holds_between_the_slices() -> None:
    network = SampledNetwork(Strategy.ARRIVAL, 0.001, 0, 0.0002)
    analysis = analyse_sampled(model_at(800.0), K, network)
    assert analysis.gain_certified is not None
    assert analysis.decay_certified_per_s is not None
    nominal = BandwidthRange(800.0, 800.0, analysis.gain_certified, analysis.decay_certified_per_s)
    patterns = [analysis.worst.pattern, analysis.slowest]
    found = bandwidth_range(model_at, K, network, patterns, nominal)
    assert found.min_hz < 700.0
    assert found.max_hz > 900.0
    assert found.decay_per_s is not None
    for bandwidth_hz in np.linspace(found.min_hz, found.max_hz, 5):
        loop = HeldLoop(model_at(float(bandwidth_hz)), K, network)
        assert worst_gain(loop, regular_patterns(loop)).gain <= found.gain
        assert pattern_of(loop, analysis.slowest.steps).decay_per_s >= found.decay_per_s


def test_the_range_of_a_constant_delay_ends_where_the_gain_would_rise_too_far() -> None:
    gain = np.array([-0.486, -1.0367])
    norm = hinf_norm(model_at(800.0).loop(gain, 0.002))
    found = constant_bandwidth_range(model_at, gain, 0.002, BandwidthRange(800.0, 800.0, norm))
    assert found.decay_per_s is None
    assert found.gain <= 1.1 * norm
    assert found.max_hz > 1200.0
    assert 500.0 < found.min_hz < 600.0
    for bandwidth_hz in np.linspace(found.min_hz, found.max_hz, 9):
        assert hinf_norm(model_at(float(bandwidth_hz)).loop(gain, 0.002)) <= found.gain
    assert hinf_norm(model_at(found.min_hz / 1.08).loop(gain, 0.002)) > 1.05 * norm


def test_a_design_for_a_slow_current_loop_is_unstable_on_a_fast_one() -> None:
    """K1 below -1: the certificate for R/L says nothing about a drive of 800 Hz, where it limit-cycles."""
    eager = np.array([-1.881, -1.757])
    assert analyse_sampled(speed_model(LING), eager, NETWORK).certified
    assert analyse_sampled(model_at(800.0), eager, NETWORK).refuted


@pytest.mark.parametrize(
    ("bandwidth_hz", "covered"), [(499.0, False), (500.0, True), (1200.0, True), (1201.0, False)]
)
def test_the_file_says_what_it_covers(bandwidth_hz: float, covered: bool) -> None:
    loop = CurrentLoop(bandwidth_hz=800.0, bandwidth_min_hz=500.0, bandwidth_max_hz=1200.0)
    assert loop.covers(bandwidth_hz) is covered
