"""Commands that begin to act anywhere in an interval: what lies between two instants of a grid."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from servobench.design.delay.delay_loop import SpeedModel, model_of
from servobench.design.errors import NoSolution
from servobench.design.sampled.peak_steps import covered
from servobench.design.sampled.varying_delay import DelayRange, begins
from tests.draws import few_of

PERIOD_S = 1e-3


def model(inertia: float) -> SpeedModel:
    return model_of(3000.0, 1.0, inertia, 0.002, integral=False)


def response(own: SpeedModel, begin_s: float, until_s: float) -> np.ndarray:
    """The state at ``until_s`` after an input of 1 from ``begin_s`` on."""
    n = len(own.A)
    rates = np.zeros((n + 1, n + 1))
    rates[:n, :n], rates[:n, n] = own.A, own.B1
    return np.asarray(expm(rates * max(0.0, until_s - begin_s))[:n, n])


@pytest.mark.parametrize("close", [1e-1, 1e-2, 1e-3])
@pytest.mark.parametrize("inertia", [8e-4, 1e-3, 1.25e-3])
def test_between_two_begins_no_response_is_farther_from_its_chord_than_told(
    close: float, inertia: float
) -> None:
    light, heavy, own = model(8e-4), model(1.25e-3), model(inertia)
    grid = begins(DelayRange(0.2e-3, 1e-3), PERIOD_S, light, heavy, close)
    assert (grid[0].at_s, grid[-1].at_s) == pytest.approx((0.2e-3, 1e-3))
    nearest = 0.0
    for one, other in itertools.pairwise(grid):
        bound, error = np.maximum(one.state, other.state), max(one.error, other.error)
        for part in np.linspace(0.1, 0.9, 9):
            at_s = one.at_s + part * (other.at_s - one.at_s)
            for until_s in (0.5e-3, 0.8e-3, PERIOD_S):
                chord = (1.0 - part) * response(own, one.at_s, until_s) + part * response(
                    own, other.at_s, until_s
                )
                apart = np.abs(response(own, at_s, until_s) - chord)
                assert abs(float(own.C @ apart)) <= error * (1.0 + 1e-9)
            assert np.all(apart <= bound * (1.0 + 1e-9))
            nearest = max(nearest, float((apart / bound).max()))
    assert nearest > 0.5


def test_a_delay_that_does_not_vary_leaves_nothing_open() -> None:
    only = begins(DelayRange(1.4e-3, 1.4e-3), PERIOD_S, model(1e-3), model(1e-3), 1e-2)
    assert [(each.whole, each.error) for each in only] == [(1, 0.0)]
    assert only[0].at_s == pytest.approx(0.4e-3)


def test_delays_on_both_sides_of_a_sample_are_refused() -> None:
    with pytest.raises(NoSolution, match=r"0\.7 to 1\.2 ms: expected no sample between the two"):
        begins(DelayRange(0.7e-3, 1.2e-3), PERIOD_S, model(1e-3), model(1e-3), 1e-2)


def test_an_input_that_acts_on_the_error_at_once_is_refused() -> None:
    own = model(1e-3)
    direct = replace(own, C=np.eye(len(own.A))[0])
    with pytest.raises(NoSolution, match="at once"):
        begins(DelayRange(0.2e-3, 0.4e-3), PERIOD_S, direct, direct, 1e-2)


@pytest.mark.parametrize("seed", few_of(range(5), 2))
def test_few_balls_cover_many(seed: int) -> None:
    draw = np.random.default_rng(seed)
    points, radii = draw.normal(size=(300, 2, 3)), draw.uniform(0.0, 0.3, size=300)
    chosen, widened = covered(points, radii, 1.5)
    assert len(chosen) < 250
    assert np.all(widened <= np.maximum(1.5, radii[chosen]) + 1e-12)
    apart = np.linalg.norm(points[:, None] - points[None, chosen], axis=3).max(axis=2)
    assert np.all((apart + radii[:, None] <= widened + 1e-12).any(axis=1))


def test_balls_that_may_not_grow_stay_apart() -> None:
    points, radii = np.arange(4.0).reshape(4, 1, 1), np.zeros(4)
    chosen, widened = covered(points, radii, 0.5)
    assert sorted(chosen) == [0, 1, 2, 3]
    assert math.isclose(widened.max(), 0.0)
