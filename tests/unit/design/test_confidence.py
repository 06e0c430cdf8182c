"""Bounds of a sample against binomial sums."""

import numpy as np
import pytest
from scipy.stats import binom

from servobench.design.confidence import CONFIDENCE, clopper_pearson, rank_above, share_within_largest


@pytest.mark.parametrize(("events", "trials"), [(1, 20), (7, 20), (19, 20), (3, 10_000)])
def test_at_its_ends_what_was_seen_has_a_chance_of_one_in_forty(events: int, trials: int) -> None:
    low, high = clopper_pearson(events, trials)
    assert binom.sf(events - 1, trials, low) == pytest.approx(0.025)
    assert binom.cdf(events, trials, high) == pytest.approx(0.025)


def test_without_an_event_the_rate_is_below_three_of_a_hundred_samples_and_some() -> None:
    assert clopper_pearson(0, 100) == pytest.approx((0.0, 1.0 - 0.025**0.01))
    assert clopper_pearson(100, 100) == pytest.approx((0.025**0.01, 1.0))


@pytest.mark.parametrize("probability", [0.001, 0.02, 0.1, 0.5, 0.93])
def test_it_covers_the_truth_at_least_as_often_as_it_says(probability: float) -> None:
    trials = 60
    covered = 0.0
    for events in range(trials + 1):
        low, high = clopper_pearson(events, trials)
        if low <= probability <= high:
            covered += binom.pmf(events, trials, probability)
    assert CONFIDENCE <= covered <= 1.0


def test_samples_that_tell_less_count_as_fewer() -> None:
    assert clopper_pearson(40, 400, inflation=4.0) == clopper_pearson(10, 100)


@pytest.mark.parametrize(("events", "trials"), [(-1, 10), (11, 10), (0, 0)])
def test_what_cannot_be_counted_is_refused(events: int, trials: int) -> None:
    with pytest.raises(ValueError, match="trials"):
        clopper_pearson(events, trials)


@pytest.mark.parametrize("samples", [1, 30, 10_000])
def test_all_samples_lie_below_that_quantile_once_in_twenty(samples: int) -> None:
    share = share_within_largest(samples)
    assert share**samples == pytest.approx(1.0 - CONFIDENCE)
    if samples > 10:
        assert 1.0 - share == pytest.approx(3.0 / samples, rel=0.06)


@pytest.mark.parametrize(("share", "samples"), [(0.5, 9), (0.99, 299), (0.99, 1000), (0.999, 10_000)])
def test_the_rank_is_the_first_that_is_sure_enough(share: float, samples: int) -> None:
    rank = rank_above(share, samples)
    assert rank is not None
    sure = binom.cdf(np.arange(rank + 1) - 1, samples, share)
    assert sure[rank] >= CONFIDENCE > sure[rank - 1]


def test_too_few_samples_bound_no_quantile() -> None:
    assert rank_above(0.99, 298) is None
    assert rank_above(0.99, 0) is None
