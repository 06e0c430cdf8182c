"""What a speed loop bears beyond its design, each figure seen another way."""

import math

import numpy as np
import pytest

from servobench.design.delay.delay_loop import SpeedModel, speed_model
from servobench.design.delay.delay_norm import is_stable
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.admissible_steps import Delivery
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import repeated
from servobench.design.speed.speed_robustness import (
    SpeedRobustness,
    loop_margins,
    noise_gain,
    speed_robustness,
)
from tests.motors import LING

MODEL = speed_model(LING, current_bandwidth_hz=800.0)
K = np.array([0.0, -0.6])
DELAY_S = 0.002
NETWORK = SampledNetwork(Strategy.ARRIVAL, 0.001, 0, 0.0008)


def plant(motor: PmsmParameters, rate: float) -> SpeedModel:
    return speed_model(motor, current_bandwidth_hz=800.0 * rate)


@pytest.fixture(scope="module")
def found() -> SpeedRobustness:
    """Of the loop above."""
    held = HeldLoop(MODEL, K, NETWORK)
    patterns = [repeated(held, (Delivery(1, 0.0008),))]
    return speed_robustness(plant, LING, MODEL.loop(K, DELAY_S), held, patterns)


def test_margins_are_the_limits_of_stability(found: SpeedRobustness) -> None:
    factor = 10.0 ** (found.margins.gain_margin_db / 20.0)
    for share, stable in ((0.999, True), (1.001, False)):
        assert is_stable(MODEL.loop(share * factor * K, DELAY_S)) is stable
        assert is_stable(MODEL.loop(K, DELAY_S + share * found.delay_margin_s)) is stable
    margins = loop_margins(MODEL.loop(K, DELAY_S))
    turned_s = math.radians(margins.phase_margin_deg) / margins.phase_margin_rad_s
    assert turned_s == pytest.approx(found.delay_margin_s, rel=1e-6)


def test_another_plant_has_other_gains(found: SpeedRobustness) -> None:
    less, more, slower = found.changed.values()
    assert less.gain_found is not None
    assert more.gain_found is not None
    assert less.gain_found > more.gain_found
    assert slower.gain >= more.gain
    assert found.peak_over_floor > 1.0


def test_noise_is_that_of_a_simulation() -> None:
    held = HeldLoop(MODEL, K, NETWORK)
    draw = np.random.default_rng(2)
    chain = held.chain(repeated(held, (Delivery(1, 0.0008),)).steps[0])
    after = held.transition(chain[1:])
    xi, torques = np.zeros(held.size), []
    for noise in draw.normal(size=40_000):
        xi = held.sampling @ xi
        xi[3] += K[1] * noise
        torques.append(LING.torque_constant_nm_a * xi[3])
        xi = after @ xi
    assert noise_gain(LING, MODEL.loop(K, DELAY_S), held) == pytest.approx(float(np.std(torques)), rel=0.02)
