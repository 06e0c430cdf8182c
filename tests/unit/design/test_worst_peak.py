"""The largest error after a load step, over the network's sequences."""

import numpy as np
import pytest

from servobench.design.delay.delay_loop import speed_model
from servobench.design.delay.delay_response import step_peak
from servobench.design.sampled.analysis import worst_peak
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.speed.monte_carlo import Chance, run_many
from tests.motors import LING
from tests.unit.design.random_peaks import peaks_of

MODEL = speed_model(LING)
K = np.array([0.0, -0.0212])


def test_with_fast_sampling_it_is_the_peak_of_the_constant_delay() -> None:
    h = 0.002
    loop = HeldLoop(MODEL, K, SampledNetwork(Strategy.HISTORY, h, 0, 0.0, 0.062))
    assert worst_peak(loop) == pytest.approx(step_peak(MODEL.loop(K, 0.063)), rel=0.01)


def test_no_random_run_exceeds_it() -> None:
    network = SampledNetwork(Strategy.ARRIVAL, 0.01, 3, 0.004)
    eager = np.array([-0.151, -0.0433])
    found = worst_peak(HeldLoop(MODEL, eager, network))
    chance = Chance(runs=3000, seed=4, loss_probability=0.5)
    peaks = run_many(LING, eager, network, chance)
    assert float(peaks.max()) * (1.0 - 1e-6) <= found < 1.2 * float(peaks.max())


def test_it_cannot_be_less_than_what_inertia_alone_makes_of_the_load() -> None:
    """Until the first sample under load acts, 50 ms at worst, nothing meets it."""
    network = SampledNetwork(Strategy.ARRIVAL, 0.01, 3, 0.004)
    found = worst_peak(HeldLoop(MODEL, K, network))
    assert found > 0.044 / LING.inertia_kg_m2 * 0.9


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_certified_is_never_below_brute_force_nor_far_above(seed: int) -> None:
    """All sequences of a few periods; more seeds in ``bench_design peaks``."""
    certified, found, brute = peaks_of(seed)
    assert brute <= certified
    assert found <= certified
    assert certified < 1.2 * found
