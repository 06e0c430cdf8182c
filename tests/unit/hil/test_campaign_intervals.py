"""Intervals and shares of campaigns against closed forms: rates, bootstraps, pairs, what explains."""

import math

import numpy as np
import pytest
from scipy.stats import beta, bootstrap, rankdata
from scipy.stats import t as student

from servobench.hil.campaign.statistics import (
    RESAMPLES,
    ConfidenceInterval,
    anytime,
    clopper_pearson,
    mean,
    paired,
    quantile,
    sensitivity,
    weighted_rate,
)

VALUES = np.random.default_rng(11).exponential(size=80)


def test_an_interval_has_a_width_and_a_complement() -> None:
    found = ConfidenceInterval(0.5, 0.25, 0.875)
    assert found.width == 0.625
    assert found.complement == (0.5, 0.125, 0.75)


@pytest.mark.parametrize("interval", [clopper_pearson, anytime])
def test_no_runs_tell_nothing(interval: type) -> None:
    found = interval(0, 0, 0.95)
    assert math.isnan(found[0])
    assert found[1:] == (0.0, 1.0)


@pytest.mark.parametrize(("passed", "runs"), [(0, 1), (1, 1), (3, 20), (20, 20)])
def test_the_exact_interval_is_that_of_two_beta_quantiles(passed: int, runs: int) -> None:
    low = beta.ppf(0.05, passed, runs - passed + 1) if passed else 0.0
    high = beta.ppf(0.95, passed + 1, runs - passed) if passed < runs else 1.0
    assert clopper_pearson(passed, runs, 0.9) == pytest.approx((passed / runs, low, high))


@pytest.mark.parametrize(("passed", "runs"), [(0, 5), (5, 5), (1, 5), (2, 5), (1, 1), (0, 1)])
def test_few_runs_have_a_sequence_too(passed: int, runs: int) -> None:
    """At its ends the mixture of the head of the module is 1/alpha."""
    found = anytime(passed, runs, 0.9)
    assert found.estimate == passed / runs
    log_beta = math.lgamma(passed + 0.5) + math.lgamma(runs - passed + 0.5) - math.lgamma(runs + 1)
    log_beta -= math.log(math.pi)
    for end in [found.low] * (passed > 0) + [found.high] * (passed < runs):
        log_power = passed * math.log(end) + (runs - passed) * math.log1p(-end)
        assert log_beta - log_power == pytest.approx(math.log(10.0))
    assert (found.low == 0.0) == (passed == 0)
    assert (found.high == 1.0) == (passed == runs)


def test_a_weighted_rate_is_known_to_a_factor_by_student() -> None:
    weights = np.array([2.0, 0.5, 1.0, 1.5, 0.25, 1.0, 0.75, 1.0])
    happened = np.array([True, False, True, True, False, False, False, False])
    counted = weights * happened
    estimate = (2.0 + 1.0 + 1.5) / 8
    deviation = math.sqrt(sum((value - estimate) ** 2 for value in counted) / 7)
    factor = math.exp(student.ppf(0.95, 2) * deviation / math.sqrt(8) / estimate)
    found = weighted_rate(weights, happened, 0.9)
    assert found == pytest.approx((estimate, estimate / factor, min(1.0, estimate * factor)))
    wide = weighted_rate(weights / 100, happened, 0.9)
    assert wide == pytest.approx((estimate / 100, estimate / factor / 100, estimate * factor / 100))


def test_one_hit_alone_has_one_degree_of_freedom() -> None:
    weights, happened = np.full(4, 0.1), np.array([False, False, True, False])
    found = weighted_rate(weights, happened, 0.5)
    factor = math.exp(math.tan(0.25 * math.pi) * 0.05 / 2 / 0.025)  # Student's with one degree: Cauchy's
    assert found == pytest.approx((0.025, 0.025 / factor, 0.025 * factor))


def test_a_single_run_that_failed_may_stand_for_anything() -> None:
    assert weighted_rate(np.array([0.5]), np.array([True]), 0.9) == (0.5, 0.0, 1.0)


def test_where_nothing_happened_the_heaviest_weight_counts() -> None:
    found = weighted_rate(np.array([0.5, 3.0, 0.25, 0.25]), np.zeros(4, bool), 0.9)
    assert found == pytest.approx((0.0, 0.0, min(1.0, 3.0 * (1.0 - 0.05**0.25))))
    light = weighted_rate(np.full(4, 0.5), np.zeros(4, bool), 0.9)
    assert light == pytest.approx((0.0, 0.0, 0.5 * (1.0 - 0.05**0.25)))
    none = weighted_rate(np.empty(0), np.empty(0, bool), 0.9)
    assert math.isnan(none.estimate)
    assert none[1:] == (0.0, 1.0)


@pytest.mark.parametrize(("share", "confidence"), [(0.5, 0.9), (0.9, 0.95)])
def test_a_quantile_has_the_percentile_bootstrap(share: float, confidence: float) -> None:
    def of(sample: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(np.quantile(sample, share, axis=axis))

    known = bootstrap(
        (VALUES,),
        of,
        confidence_level=confidence,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    found = quantile(VALUES, share, confidence)
    assert found == pytest.approx((np.quantile(VALUES, share), known.low, known.high))
    assert RESAMPLES == 2000


def test_a_mean_has_about_the_interval_of_student() -> None:
    found = mean(VALUES, 0.95)
    half = student.ppf(0.975, 79) * VALUES.std(ddof=1) / math.sqrt(80)
    assert found.estimate == pytest.approx(VALUES.mean())
    assert found.low == pytest.approx(VALUES.mean() - half, abs=0.2 * half)
    assert found.high == pytest.approx(VALUES.mean() + half, abs=0.35 * half)
    assert found.high - found.estimate > found.estimate - found.low, "it is skewed, as the values are"


@pytest.mark.parametrize("of", [mean, lambda values, confidence: quantile(values, 0.5, confidence)])
def test_too_few_values_have_no_interval(of: type) -> None:
    assert tuple(of(np.array([2.5]), 0.9)) == (2.5, -math.inf, math.inf)
    none = of(np.empty(0), 0.9)
    assert math.isnan(none[0])
    assert none[1:] == (-math.inf, math.inf)
    assert tuple(of(np.array([2.5, 2.5]), 0.9)) == (2.5, 2.5, 2.5)
    assert (
        tuple(of(np.array([1.0, 1.0 + 0.5e-12]), 0.9))[1:]
        == (of(np.array([1.0, 1.0 + 0.5e-12]), 0.9)[0],) * 2
    )
    low, high = of(np.array([1.0, 1.0 + 1e-9]), 0.9)[1:]
    assert low < high


def test_pairs_are_counted_both_ways() -> None:
    first = np.array([True, True, True, False, False, True, True])
    second = np.array([True, False, False, True, False, False, False])
    figure = (
        np.array([1.0, 2.0, 3.0, 4.0, 5.0, math.nan, 7.0]),
        np.array([2.0, 3.0, 4.0, 5.0, 6.0, 1.0, 8.0]),
    )
    found = paired((first, second), figure, 0.9)
    assert (found.pairs, found.passed_first_alone, found.passed_second_alone) == (7, 4, 1)
    assert found.p_value == pytest.approx(2 * (1 + 5) / 2**5)
    assert found.difference == (1.0, 1.0, 1.0), "over the six pairs that have it in both"


def test_pairs_that_all_agree_say_nothing_of_a_difference() -> None:
    same = np.array([True, False, True])
    found = paired((same, same), (np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0])), 0.9)
    assert found[:4] == (3, 0, 0, 1.0)
    assert found.difference.estimate == -2.0


def test_classes_of_a_text_explain_their_share() -> None:
    key = np.array(["a", "a", "b", "b", "b"])
    figure = np.array([1.0, 3.0, 5.0, 6.0, 10.0])
    between = 2 * (2.0 - 5.0) ** 2 + 3 * (7.0 - 5.0) ** 2
    total = 16.0 + 4.0 + 0.0 + 1.0 + 25.0
    found = sensitivity(key, figure)
    assert found.share_of_variance == pytest.approx(between / total)
    assert math.isnan(found.rank_correlation)


def test_runs_without_the_figure_are_left_out() -> None:
    key, figure = np.array([1.0, 1.0, 2.0, 2.0, 3.0]), np.array([1.0, 2.0, 4.0, math.nan, math.inf])
    found = sensitivity(key, figure)
    mean_ = 7.0 / 3.0
    between = 2 * (1.5 - mean_) ** 2 + (4.0 - mean_) ** 2
    total = sum((value - mean_) ** 2 for value in (1.0, 2.0, 4.0))
    ranks = np.corrcoef([1.5, 1.5, 3.0], [1.0, 2.0, 3.0])[0, 1]
    assert found == pytest.approx((between / total, ranks))


@pytest.mark.parametrize("values", [10, 11, 200])
def test_up_to_ten_values_are_classes_and_more_are_put_into_ten_bins(values: int) -> None:
    random = np.random.default_rng(values)
    key = np.repeat(np.arange(float(values)), 3) ** 2
    figure = random.normal(size=key.size) + key / key.max()
    order = rankdata(key, "dense") - 1
    if values > 10:
        edges = [np.quantile(key, share) for share in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)]
        order = sum((key >= edge).astype(int) for edge in edges)
    within = sum(
        float(((figure[order == each] - figure[order == each].mean()) ** 2).sum()) for each in set(order)
    )
    total = float(((figure - figure.mean()) ** 2).sum())
    found = sensitivity(key, figure)
    assert found.share_of_variance == pytest.approx(1.0 - within / total)
    ranks = np.corrcoef(rankdata(key), rankdata(figure))[0, 1]
    assert found.rank_correlation == pytest.approx(ranks)


@pytest.mark.parametrize(
    ("key", "figure"),
    [
        ([1.0, 2.0], [1.0, 2.0]),
        ([1.0, 2.0, 3.0], [4.0, 4.0, 4.0]),
        ([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]),
        ([1.0, 2.0, 3.0], [1.0, math.nan, 3.0]),
    ],
)
def test_what_tells_nothing_explains_nothing(key: list[float], figure: list[float]) -> None:
    found = sensitivity(np.array(key), np.array(figure))
    assert found.share_of_variance == 0.0
    assert math.isnan(found.rank_correlation)
    enough = sensitivity(np.array([1.0, 2.0, 3.0]), np.array([1.0, 5.0, 3.0]))
    assert enough == pytest.approx((1.0, 0.5))
