"""Intervals hold the truth as often as they say: enumerated, on known distributions, and while one looks."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.special import beta as beta_function
from scipy.stats import binom

from servobench.hil.campaign.statistics import (
    ConfidenceInterval,
    anytime,
    clopper_pearson,
    mean,
    paired,
    quantile,
    sensitivity,
)

RUNS = 60
RATES = np.linspace(0.01, 0.99, 99)


def coverage(interval: Callable[[int, int, float], ConfidenceInterval], rate: float) -> float:
    """How often the interval holds ``rate`` after RUNS runs, by enumeration of all that can happen."""
    held = [found.low <= rate <= found.high for found in (interval(k, RUNS, 0.95) for k in range(RUNS + 1))]
    return float(binom.pmf(np.arange(RUNS + 1), RUNS, rate)[held].sum())


def test_the_exact_interval_holds_at_every_rate() -> None:
    exact = cache(clopper_pearson)
    assert min(coverage(exact, rate) for rate in RATES) >= 0.95


@pytest.mark.parametrize(("passed", "runs"), [(0, 1), (0, 40), (40, 40), (3, 40), (999, 1000), (1, 100_000)])
def test_the_sequence_is_where_the_mixture_is_small(passed: int, runs: int) -> None:
    found = anytime(passed, runs, 0.95)
    for p in np.concatenate([np.linspace(1e-4, 1 - 1e-4, 9999), found[1:]]):
        if min(abs(p - found.low), abs(p - found.high)) < 1e-9:
            continue
        log_power = passed * math.log(p) + (runs - passed) * math.log1p(-p)
        log_beta = _log_beta(passed + 0.5, runs - passed + 0.5) - math.log(beta_function(0.5, 0.5))
        assert (log_beta - log_power < math.log(20.0)) == (found.low < p < found.high), p


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@pytest.mark.long
def test_only_the_sequence_holds_for_one_who_looks_until_it_does_not() -> None:
    """The most unlucky of all rules: to end at the first run after which the interval is wrong."""
    rate, longest = 0.8, 60
    passed = np.cumsum(np.random.default_rng(5).random((300, longest)) < rate, axis=1)

    def held(interval: Callable[[int, int, float], ConfidenceInterval]) -> float:
        @cache
        def inside(k: int, n: int) -> bool:
            found = interval(k, n, 0.95)
            return found.low <= rate <= found.high

        return float(
            np.mean([all(inside(int(k), n) for n, k in enumerate(each, start=1)) for each in passed])
        )

    assert held(anytime) >= 0.95
    assert held(clopper_pearson) < 0.92


def test_the_price_of_looking_is_as_the_docs_say() -> None:
    ratios = [
        anytime(round(rate * runs), runs, 0.95).width / clopper_pearson(round(rate * runs), runs, 0.95).width
        for rate in (0.5, 0.9, 0.99)
        for runs in (100, 1000, 10_000)
    ]
    assert min(ratios) > 1.3
    assert max(ratios) < 2.1


@pytest.mark.long
def test_a_quantile_is_held() -> None:
    stream = np.random.default_rng(7)
    truth = math.log(2.0)  # median of the exponential distribution
    held = sum(found.low <= truth <= found.high for found in _medians(stream, 100))
    assert 88 <= held <= 100, "95 of 100 with a standard deviation of 2.2"


def _medians(stream: np.random.Generator, count: int) -> list[ConfidenceInterval]:
    return [quantile(stream.exponential(size=150), 0.5, 0.95) for _ in range(count)]


def test_a_figure_that_never_changes_is_known() -> None:
    assert quantile(np.full(9, 3.0), 0.95, 0.95) == (3.0, 3.0, 3.0)
    assert mean(np.full(9, 3.0), 0.95) == (3.0, 3.0, 3.0)
    assert quantile(np.array([3.0]), 0.5, 0.95) == (3.0, -math.inf, math.inf)


def test_pairs_see_what_two_rates_do_not() -> None:
    stream = np.random.default_rng(3)
    hardness = stream.normal(0.0, 10.0, 300)
    first, second = hardness, hardness + 0.5 + stream.normal(0.0, 1.0, 300)
    found = paired((first < 5.0, second < 5.0), (first, second), 0.95)
    assert found.difference.low > 0.3
    assert found.difference.high < 0.7
    apart = found.passed_first_alone + found.passed_second_alone
    tail = sum(math.comb(apart, k) for k in range(found.passed_second_alone + 1)) / 2**apart
    assert found.p_value == pytest.approx(min(1.0, 2.0 * tail))


def test_what_explains_a_figure_is_told_from_what_does_not() -> None:
    stream = np.random.default_rng(4)
    cause, other = stream.random(400), stream.random(400)
    figure = 3.0 * cause + stream.normal(0.0, 0.1, 400)
    strong, weak = sensitivity(cause, figure), sensitivity(other, figure)
    assert strong.share_of_variance == pytest.approx(0.98, abs=0.03)
    assert strong.rank_correlation > 0.95
    assert weak.share_of_variance < 0.08
    kind = np.where(cause > 0.5, "a", "b")
    assert sensitivity(kind, figure).share_of_variance == pytest.approx(0.75, abs=0.05)
    assert math.isnan(sensitivity(kind, figure).rank_correlation)
