"""The fit of a loss model: closed forms of its parts, and the maximum that it finds against others."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import expit, logit

from servobench.design.confidence import clopper_pearson
from servobench.hil.measuring.loss_model import (
    CAME,
    LOST,
    UNKNOWN,
    Outcomes,
    Parameters,
    Runs,
    _curvature,
    _likeliest,
    _markov_chain,
    fit,
    losses_of,
)
from tests.unit.hil.test_loss_model import chain

BURSTS = Parameters(0.02, 0.25)


def outcomes_of(text: str) -> Outcomes:
    """. came, x lost, ? unknown."""
    return np.array([".x?".index(letter) for letter in text], np.int8)


@pytest.mark.parametrize(
    ("parameters", "share_bad", "loss"),
    [
        (Parameters(0.1, 0.3), 0.25, 0.25),
        (Parameters(0.1, 0.3, 0.8, 0.04), 0.25, 0.23),
        (Parameters(0.0, 0.3, 1.0, 0.04), 0.0, 0.04),
        (Parameters(0.2, 0.0, 0.7, 0.1), 1.0, 0.7),
        (Parameters(0.0, 0.0, 1.0, 0.5), 0.0, 0.5),
    ],
)
def test_the_long_run_of_a_chain(parameters: Parameters, share_bad: float, loss: float) -> None:
    assert parameters.share_bad == pytest.approx(share_bad)
    assert parameters.loss == pytest.approx(loss)


@pytest.mark.parametrize(
    "parameters", [Parameters(0.1, 0.3), Parameters(0.05, 0.1, 0.6, 0.02), Parameters(0.9, 0.8, 0.9, 0.3)]
)
def test_the_inflation_is_the_sum_of_the_autocovariances(parameters: Parameters) -> None:
    """Of lag 0 once, of each other lag twice: by powers of the matrix of the moves."""
    up, down, bad, good = parameters
    moves = np.array([[1.0 - up, up], [down, 1.0 - down]])
    share = np.array([down, up]) / (up + down)
    lost = np.array([good, bad])
    mean = float(share @ lost)
    covariances = [
        float((share * lost) @ np.linalg.matrix_power(moves, lag) @ lost) - mean**2 for lag in range(1, 400)
    ]
    assert parameters.inflation == pytest.approx(1.0 + 2.0 * sum(covariances) / (mean * (1.0 - mean)))


@pytest.mark.parametrize(
    "parameters",
    [Parameters(0.0, 1.0, 1.0, 0.0), Parameters(0.3, 0.2, 1.0, 1.0), Parameters(0.0, 1.0, 1.0, 0.3)],
)
def test_nothing_all_and_chance_inflate_nothing(parameters: Parameters) -> None:
    assert parameters.inflation == 1.0


def test_a_visible_chain_counts_its_moves() -> None:
    # of 6 frames that came and have a follower of known fate 2 are followed by a loss, of 4 lost ones 2 end
    found = _markov_chain(outcomes_of("...xx..x.?x.x?"))
    assert (found.loss_bad, found.loss_good) == (1.0, 0.0)
    moved = [first + second for first, second in zip("...xx..x.?x.x?", "..xx..x.?x.x?", strict=False)]
    came, lost = moved.count("..") + moved.count(".x"), moved.count("x.") + moved.count("xx")
    assert found.p_good_to_bad == (moved.count(".x") + 0.5) / (came + 1.0)
    assert found.p_bad_to_good == (moved.count("x.") + 0.5) / (lost + 1.0)
    assert (came, moved.count(".x"), lost, moved.count("x.")) == (6, 3, 4, 3)


def test_second_derivatives_of_a_quadratic_are_its_matrix() -> None:
    matrix = np.array([[4.0, -1.0, 0.5], [-1.0, 3.0, 0.25], [0.5, 0.25, 2.0]])
    at = np.array([0.3, -2.0, 1.0])

    def cost(x: NDArray[np.float64]) -> float:
        return float(0.5 * x @ matrix @ x + x.sum() + 7.0)

    np.testing.assert_allclose(_curvature(cost, at), matrix, rtol=1e-6)


def hessian(function: Callable[[NDArray[np.float64]], float], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """By differences of differences, with another step than the product's."""
    step, size = 0.02, at.size

    def slope(x: NDArray[np.float64], place: int) -> float:
        ahead, behind = x.copy(), x.copy()
        ahead[place] += step
        behind[place] -= step
        return (function(ahead) - function(behind)) / (2.0 * step)

    found = np.empty((size, size))
    for row in range(size):
        ahead, behind = at.copy(), at.copy()
        ahead[row] += step
        behind[row] -= step
        found[row] = [(slope(ahead, column) - slope(behind, column)) / (2.0 * step) for column in range(size)]
    return found


@pytest.mark.parametrize(("truth", "free"), [(BURSTS, 2), (Parameters(0.02, 0.2, 0.7), 3)])
def test_the_fit_is_a_maximum_and_its_intervals_are_the_curvature_s(truth: Parameters, free: int) -> None:
    runs = Runs(chain(truth, 6000, 3))
    found = _likeliest(runs, Parameters(0.01, 0.3), free)
    assert found is not None
    parameters, intervals, log_likelihood = found
    assert log_likelihood == pytest.approx(runs.log_likelihood(parameters))
    assert parameters[free:] == (1.0, 0.0)[free - 2 :]
    at = logit(np.array(parameters[:free]))

    def cost(logits: NDArray[np.float64]) -> float:
        return -runs.log_likelihood(Parameters(*expit(logits).tolist()))

    for place in range(free):
        for step in (-0.1, 0.1):
            beside = at.copy()
            beside[place] += step
            assert cost(beside) > cost(at), "no other is likelier"
    half = 1.959964 * np.sqrt(np.diag(np.linalg.inv(hessian(cost, at))))
    assert list(intervals) == ["p_good_to_bad", "p_bad_to_good", "loss_bad", "loss_good"][:free]
    ends = np.array([logit(np.array(interval)) for interval in intervals.values()])
    np.testing.assert_allclose(ends, np.stack([at - half, at + half], axis=1), rtol=0.01)


def test_a_parameter_at_its_bound_is_no_model() -> None:
    """A thousand times all four are lost, or one alone: a model with fewer parameters says as much."""
    bursts, singles = (Runs(outcomes_of(("." * 20 + lost) * 1000)) for lost in ("xxxx", "x"))
    assert _likeliest(bursts, BURSTS, 2) is not None
    assert _likeliest(bursts, BURSTS, 3) is None
    assert _likeliest(bursts, BURSTS, 4) is None
    assert _likeliest(singles, BURSTS, 2) is None


def test_independent_losses_have_the_rate_and_its_bounds() -> None:
    outcomes = np.zeros(500, np.int8)
    outcomes[np.random.default_rng(4).choice(499, 20, replace=False)] = LOST
    outcomes[-1] = UNKNOWN
    model = fit(outcomes)
    assert model.independent
    assert model.parameters == Parameters(0.0, 1.0, 1.0, 20 / 499)
    assert model.intervals == {"probability": clopper_pearson(20, 499)}


@pytest.mark.parametrize(("length", "independent"), [(1, True), (2, False)])
def test_pairs_that_chance_would_not_make_are_bursts(length: int, independent: bool) -> None:
    outcomes = np.zeros(3000, np.int8)
    starts = 10 + 97 * np.arange(30) + np.random.default_rng(1).integers(0, 60, 30)
    for start in starts:
        outcomes[start : start + length] = LOST
    model = fit(outcomes)
    assert model.independent is independent
    if not independent:
        assert model.parameters.p_bad_to_good == pytest.approx(0.5, rel=0.15)
        assert model.parameters.loss == pytest.approx(60 / 3000, rel=0.1)


def singles(count: int) -> Outcomes:
    outcomes = np.zeros(1000, np.int8)
    outcomes[50 : 50 + 90 * count : 90] = LOST
    return outcomes


def test_from_ten_runs_on_there_is_a_model() -> None:
    nine = losses_of(singles(9))
    assert (nine.known, nine.lost, nine.runs) == (1000, 9, (9,))
    assert (nine.model, nine.why_none) == (None, "not identifiable: 9 runs of losses")
    assert nine.interval == clopper_pearson(9, 1000)
    ten = losses_of(singles(10))
    assert ten.model is not None
    assert ten.model.independent
    assert (ten.why_none, ten.interval) == ("", clopper_pearson(10, 1000))


@pytest.mark.parametrize(("text", "length"), [("xx", 2.0), ("xxxx..xx", 3.0)])
def test_few_bursts_widen_the_bounds_by_their_mean_length(text: str, length: float) -> None:
    outcomes = np.zeros(500, np.int8)
    outcomes[100 : 100 + len(text)] = outcomes_of(text)
    found = losses_of(outcomes)
    assert found.lost == text.count("x")
    # many bursts of a geometric length of mean m: variance over mean is 2 m - 1
    assert found.interval == clopper_pearson(found.lost, 500, 2.0 * length - 1.0)


def test_without_a_loss_the_bounds_are_those_of_chance() -> None:
    outcomes = np.full(300, CAME, np.int8)
    outcomes[200:] = UNKNOWN
    found = losses_of(outcomes)
    assert (found.known, found.lost, found.runs) == (200, 0, ())
    assert found.interval == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 200)))


def test_a_fitted_burst_widens_the_bounds_by_its_inflation() -> None:
    found = losses_of(chain(BURSTS, 4000, 8))
    assert found.model is not None
    assert not found.model.independent
    assert found.model.parameters.inflation > 2.0
    assert found.interval == clopper_pearson(found.lost, 4000, found.model.parameters.inflation)
