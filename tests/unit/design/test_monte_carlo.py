"""Random runs of the sampled loop: against closed forms, small steps, and what chance must give."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from servobench.design.delay.delay_loop import speed_model
from servobench.design.errors import UnsuitableNetwork
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.speed.monte_carlo import Chance, diverged, quantile, run_many, share
from tests.motors import LING

pytestmark = pytest.mark.long
MODEL = speed_model(LING)
K = np.array([0.0, -0.0212])


def network(strategy: Strategy, losses: int = 5, delay: float = 0.004) -> SampledNetwork:
    """The paper's: 10 ms, at most five lost in a row, up to 4 ms, 64 ms agreed."""
    return SampledNetwork(strategy, 0.01, losses, delay, 0.0 if strategy is Strategy.ARRIVAL else 0.064)


def simulated_with_load(x: np.ndarray, u: float, time_s: float) -> np.ndarray:
    """x after ``time_s`` with the input held, under a load of 1 N m."""
    M = np.zeros((4, 4))
    M[:2, :2], M[:2, 2], M[:2, 3] = MODEL.A, MODEL.B1, MODEL.B2
    return np.asarray((expm(M * time_s) @ np.append(x, [u, 1.0]))[:2])


def test_without_chance_it_is_the_transition() -> None:
    """No loss, no delay, no uncertainty: the error comes to rest at load over stiffness."""
    chance = Chance(runs=50, seed=1, duration_s=20.0, loss_probability=0.0, load_nm=0.6)
    slow = 0.1 * K  # too slow to overshoot: the error is largest where it ends
    peaks = run_many(LING, slow, network(Strategy.ARRIVAL, 0, 0.0), chance)
    static = 0.6 / (LING.viscous_friction_nm_s - LING.torque_constant_nm_a * slow[1])
    assert peaks == pytest.approx(np.full(50, static), rel=1e-6)
    assert diverged(peaks).value == 0.0


@pytest.mark.parametrize("strategy", list(Strategy))
@pytest.mark.parametrize("friction_nm_s", [0.0, 1e-6, 0.05, 0.5])
def test_without_control_the_load_is_borne_by_inertia_and_friction(
    friction_nm_s: float, strategy: Strategy
) -> None:
    """The speed of J e' = d - B e, for a time in the last period, as the load came in the first."""
    motor = replace(LING, viscous_friction_nm_s=friction_nm_s)
    J, B, load_nm, period_s = LING.inertia_kg_m2, friction_nm_s, 0.6, 0.004
    chance = Chance(runs=20, seed=1, duration_s=0.1, loss_probability=0.0, load_nm=load_nm)
    net = SampledNetwork(strategy, period_s, 0, 0.8 * period_s, agreed_delay_s=period_s)
    peaks = run_many(motor, 0.0 * K, net, chance)

    def speed(time_s: float) -> float:
        return load_nm * (-np.expm1(-B / J * time_s) / B if B else time_s / J)

    assert peaks.min() >= speed(0.1) * (1.0 - 1e-9)
    assert peaks.max() <= speed(0.1 + period_s) * (1.0 + 1e-9)


def test_the_peak_between_two_samples_is_not_missed() -> None:
    """At a long period the error turns inside it: against a simulation in small steps."""
    slow, late = 0.03, []
    net = SampledNetwork(Strategy.ARRIVAL, slow, 0, 0.0)
    chance = Chance(runs=400, seed=4, duration_s=0.3, loss_probability=0.0)
    for phase in np.linspace(0.0, slow, 25):
        x, held, peak = np.zeros(2), 0.0, 0.0
        for k in range(11):
            for _ in range(60):
                x = simulated_with_load(x, held, slow / 60 if k else (slow - phase) / 60)
                peak = max(peak, abs(x[1]))
            held = float(K @ x)
        late.append(peak)
    peaks = run_many(LING, K, net, chance)
    assert peaks.min() == pytest.approx(min(late), rel=2e-3)
    assert peaks.max() == pytest.approx(max(late), rel=2e-3)


@pytest.mark.parametrize("strategy", list(Strategy))
def test_same_seed_same_runs(strategy: Strategy) -> None:
    chance = Chance(runs=300, seed=5, loss_probability=0.3, uncertainty=0.3)
    first, second = (run_many(LING, K, network(strategy), chance) for _ in range(2))
    assert np.array_equal(first, second)
    more = replace(chance, runs=600)
    assert np.array_equal(run_many(LING, K, network(strategy), more)[:300], first)
    other = run_many(LING, K, network(strategy), Chance(300, 6, loss_probability=0.3, uncertainty=0.3))
    assert not np.array_equal(first, other)


def test_more_loss_is_worse_and_what_is_refuted_diverges() -> None:
    def peak(loss: float, gain: float = 1.0) -> float:
        chance = Chance(runs=2000, seed=8, loss_probability=loss)
        return quantile(run_many(LING, gain * K, network(Strategy.STAMP), chance), 0.9).value

    assert peak(0.0) < peak(0.3) < peak(0.6)
    chance = Chance(runs=200, seed=8, duration_s=20.0, loss_probability=1.0)
    assert diverged(run_many(LING, 3.4 * K, network(Strategy.STAMP), chance)).low > 0.9


def test_interval_of_a_share_is_clopper_and_pearsons() -> None:
    """Textbook: 0 of 10 gives at most 0.3085, 5 of 10 gives 0.1871 to 0.8129."""
    assert share(0, 10).high == pytest.approx(0.3085, abs=1e-4)
    assert (share(5, 10).low, share(5, 10).high) == pytest.approx((0.1871, 0.8129), abs=1e-4)


def test_samples_that_overtake_one_another_are_refused() -> None:
    with pytest.raises(UnsuitableNetwork, match="arrive in order"):
        run_many(LING, K, network(Strategy.ARRIVAL, 1, 0.02), Chance(runs=1, seed=0))
