"""Certified peaks after a load step: of loops that never switch exact, of others never below an attack."""

import numpy as np
import pytest

from servobench.design.delay.delay_loop import speed_model
from servobench.design.sampled.analysis import SampledAnalysis, analyse_loop, with_peak
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from tests.benchmarks.attack_peaks import attack, drawn_loop
from tests.draws import few_of
from tests.motors import LING

HISTORY = SampledNetwork(Strategy.HISTORY, 0.001, 2, 0.001, 0.003)


def analysed(seed: int) -> SampledAnalysis:
    return with_peak(analyse_loop(drawn_loop(np.random.default_rng([40, seed])).loop()))


def test_a_loop_that_never_switches_is_certified_by_what_one_simulation_shows() -> None:
    """Certified was 912.7 for 23.91: the input held before counted, which is replaced at once."""
    loop = HeldLoop(speed_model(LING, current_bandwidth_hz=53.8321), np.array([0.0, -0.1]), HISTORY)
    analysis = with_peak(analyse_loop(loop))
    rest = 1.0 / (0.1 * LING.torque_constant_nm_a + LING.viscous_friction_nm_s)
    assert analysis.peak_found == pytest.approx(rest, rel=1e-6)
    assert analysis.peak_certified is not None
    assert analysis.peak_found <= analysis.peak_certified < 1.001 * analysis.peak_found


@pytest.mark.long
@pytest.mark.parametrize("seed", few_of([1, 34], 1))
def test_a_peak_between_two_samples_is_certified_as_closely_as_it_is_attacked(seed: int) -> None:
    """Two loops that never switch, whose error overshoots; the attack knows their closed form alone."""
    analysis = analysed(seed)
    attacked = attack(drawn_loop(np.random.default_rng([40, seed])), np.random.default_rng([41, seed]))
    assert analysis.peak_certified is not None
    assert attacked <= analysis.peak_certified < 1.0005 * attacked


@pytest.mark.long
@pytest.mark.parametrize(("seed", "ratio_max"), few_of([(47, 1.12), (0, 1.12), (33, 1.001)], 1))
def test_no_attack_exceeds_the_bound_of_a_switched_loop(seed: int, ratio_max: float) -> None:
    """More by ``python -m tests.benchmarks.attack_peaks``; these were at 1.16 and 2.3; the error of the last,
    slow and with an integral, still grows after the 40 periods of the search."""
    analysis = analysed(seed)
    attacked = attack(drawn_loop(np.random.default_rng([40, seed])), np.random.default_rng([41, seed]))
    assert analysis.peak_certified is not None
    assert attacked <= analysis.peak_certified < ratio_max * max(attacked, analysis.peak_found)
