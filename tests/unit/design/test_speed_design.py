"""The best gains, exact, certified and by the paper's algorithm, and what they must never break."""

import numpy as np
import pytest

from servobench.design.delay.certificate import certified_gain
from servobench.design.delay.delay_loop import Feedback, speed_model
from servobench.design.delay.delay_norm import hinf_norm, is_stable
from servobench.design.errors import NoSolution
from servobench.design.motor import PmsmParameters
from servobench.design.speed.cone_complementarity import largest_ccl_delay
from servobench.design.speed.lmi_design import (
    certified_delay_within,
    largest_certified_delay,
    least_certified_gain,
)
from servobench.design.speed.speed_design import delay_within, largest_delay, least_gain
from tests.draws import few_of
from tests.motors import AZAIZ, LING

pytestmark = pytest.mark.long

MODEL = speed_model(LING)


def test_exact_optima_of_the_published_motor() -> None:
    """Found beforehand by a search over a grid, with another program."""
    speed = largest_delay(MODEL, 125.0, Feedback.SPEED)
    assert speed.delay_s == pytest.approx(0.0653718, abs=1e-6)
    full = largest_delay(MODEL, 125.0)
    assert full.delay_s == pytest.approx(0.0884693, abs=1e-6)
    assert hinf_norm(MODEL.loop(full.K, full.delay_s)) == pytest.approx(125.0, rel=1e-6)
    assert least_gain(MODEL, 0.064).gain == pytest.approx(95.7968, rel=1e-5)
    assert least_gain(MODEL, 0.064, Feedback.SPEED).gain == pytest.approx(122.9396, rel=1e-5)


@pytest.mark.parametrize(
    ("gamma", "feedback", "delay_s"),
    [
        (2.0, Feedback.FULL, 6.7048e-4),
        (5.235987756, Feedback.FULL, 1.99435e-3),
        (5.235987756, Feedback.SPEED, 2.0441e-4),
    ],
)
def test_gains_that_only_a_fast_loop_keeps(gamma: float, feedback: Feedback, delay_s: float) -> None:
    """2 % of 1500 r/min under 0.6 N m, in SI, and less; the least gain says the same the other way round."""
    found = largest_delay(MODEL, gamma, feedback)
    assert found.delay_s == pytest.approx(delay_s, rel=1e-4)
    assert least_gain(MODEL, found.delay_s, feedback).gain == pytest.approx(gamma, rel=1e-5)


def test_what_speed_alone_cannot_keep_is_refused() -> None:
    """However fast, the current loop's lag leaves about 1/(J R/L) = 3.7 rad/s per N m."""
    with pytest.raises(NoSolution, match="speed feedback for a gain"):
        largest_delay(MODEL, 3.6, Feedback.SPEED)


def test_delay_of_a_given_gain() -> None:
    assert delay_within(MODEL, np.array([0.0, -0.0212]), 125.0) == pytest.approx(0.0638482, abs=1e-6)
    assert delay_within(MODEL, np.array([0.0, -0.0212]), 10.0) == 0.0


@pytest.mark.parametrize("motor", few_of([AZAIZ, LING], 1))
@pytest.mark.parametrize("feedback", list(Feedback))
def test_no_neighbour_is_better(motor: PmsmParameters, feedback: Feedback) -> None:
    """No random gain, near or far, keeps the bound at a delay a hair longer."""
    model = speed_model(motor)
    best = largest_delay(model, 60.0, feedback)
    draw = np.random.default_rng(7)
    for spread in (1e-3, 1e-2, 0.1, 0.5):
        for _ in range(12):
            K = best.K * (1.0 + spread * draw.normal(size=2))
            if feedback is Feedback.SPEED:
                K[0] = 0.0
            assert hinf_norm(model.loop(K, best.delay_s * (1.0 + 1e-6))) > 60.0


def test_integral_action_has_no_error_at_rest_and_costs_delay() -> None:
    model = speed_model(LING, integral=True)
    with_integral = least_gain(model, 0.02)
    loop = model.loop(with_integral.K, 0.02)
    assert is_stable(loop)
    assert with_integral.K[1] / with_integral.K[2] == pytest.approx(model.integral_time_s(0.02))
    assert with_integral.gain > least_gain(MODEL, 0.02).gain
    speed = largest_delay(model, 125.0, Feedback.SPEED)
    assert speed.delay_s < largest_delay(MODEL, 125.0, Feedback.SPEED).delay_s


def test_largest_certified_delay_is_a_maximum() -> None:
    best = largest_certified_delay(MODEL, 125.0)
    assert best.delay_s == pytest.approx(0.0589815, rel=1e-5)
    assert best.gain <= 125.0 * (1.0 + 1e-6)
    for change in ([1.01, 1.0], [0.9, 1.0], [1.0, 1.005], [1.0, 0.995], [2.0, 1.03]):
        assert certified_delay_within(MODEL, best.K * change, 125.0) <= best.delay_s * (1.0 + 1e-7)


def test_certified_designs_obey_the_feedback_asked_for() -> None:
    speed = largest_certified_delay(MODEL, 125.0, Feedback.SPEED)
    assert speed.K[0] == 0.0
    assert speed.delay_s == pytest.approx(0.0580289, rel=1e-5)
    gain = least_certified_gain(MODEL, 0.064)
    assert gain.gain == pytest.approx(133.543, rel=1e-4)
    assert gain.gain >= hinf_norm(MODEL.loop(gain.K, 0.064))


@pytest.mark.parametrize(("motor", "gamma"), few_of([(AZAIZ, 20.0), (LING, 125.0)], 1))
def test_ccl_comes_within_two_percent_of_what_its_theorem_allows(motor: PmsmParameters, gamma: float) -> None:
    model = speed_model(motor)
    found = largest_ccl_delay(model, gamma)
    most = largest_certified_delay(model, gamma, starts=[found.K])
    assert 0.98 <= found.delay_s / most.delay_s <= 1.0 + 1e-6
    assert certified_gain(model, model.loop(found.K, found.delay_s), 0).gain <= gamma * (1.0 + 1e-6)
