"""Matrices over a parameter: polynomials and what they leave out, beside the matrices themselves."""

import numpy as np
import pytest
from scipy.linalg import expm

from servobench.design.sampled.taylor_map import TaylorMap, control_points, exponential
from tests.draws import few_of

AT = np.linspace(-1.0, 1.0, 21)
SHARES = np.array([0.2, 1.0])


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    return draw.normal(size=(4, 4)), 0.2 * draw.normal(size=(4, 4))


def polynomial(each: TaylorMap, u: float) -> np.ndarray:
    return sum((u**i * C for i, C in enumerate(each.coefficients)), np.zeros(()))


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", few_of(range(5), 2))
def test_an_exponential_lies_within_what_is_left_out(seed: int, order: int) -> None:
    G, slope = drawn(seed)
    found = exponential(G, slope, SHARES, order)
    for u in AT:
        truth = expm(SHARES[:, None, None] * (G + u * slope))
        assert np.all(np.abs(truth - polynomial(found, u)) <= found.rest * abs(u) ** (order + 1) + 1e-12)
    # and not by a bound that says nothing: it falls with the order
    assert found.rest.max() < (40.0, 12.0, 3.0, 0.7)[order] * np.abs(found.coefficients).max()


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("seed", few_of(range(5), 2))
def test_so_does_a_product_behind_a_jump(seed: int, order: int) -> None:
    one, other = (exponential(*drawn(10 * seed + part), np.array([0.5]), order) for part in (1, 2))
    pairs = [drawn(10 * seed + part) for part in (1, 2)]
    J = np.random.default_rng(seed).normal(size=(4, 4))
    found = one.after(other).under(J)
    for u in AT:
        first, second = (expm(0.5 * (G + u * slope)) for G, slope in pairs)
        left = np.abs(J @ first @ second - polynomial(found, u)[0])
        assert np.all(left <= found.rest[0] * abs(u) ** (order + 1) + 1e-12)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_values_lie_between_the_control_points(order: int) -> None:
    for row in np.random.default_rng(3).normal(size=(50, order + 1)):
        points = control_points(order) @ row
        values = np.polynomial.polynomial.polyval(AT, row)
        assert points.min() - 1e-12 <= values.min() <= values.max() <= points.max() + 1e-12
        assert (points[0], points[-1]) == pytest.approx((values[0], values[-1]))
