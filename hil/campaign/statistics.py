"""Statistics of random runs: rates, quantiles and differences, with valid intervals.

A rate after a planned number of runs has the interval of Clopper and Pearson: it covers the true rate at
least as often as stated. A campaign that ends when it has seen enough must not use it: repeated looks, and an
end at a lucky moment, make any interval for a fixed number of runs cover less often. There the interval comes
from a confidence sequence: by Ville's inequality the mixture

    M(p) = B(k + 1/2, n - k + 1/2) / (B(1/2, 1/2) p^k (1 - p)^(n - k))      (Robbins 1970, Jeffreys' prior)

is above 1/alpha, at any time at all, with a probability of at most alpha where p is the true rate. The p with
M(p) < 1/alpha are an interval that holds whenever one ends; it is one and a half times as wide after 100
runs, twice after 10 000.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import betaln
from scipy.stats import binomtest, bootstrap, spearmanr
from scipy.stats import t as student

from servobench.design.confidence import clopper_pearson as confidence_limits

Floats = NDArray[np.float64]

RESAMPLES: Final = 2000
"""Resamples of a bootstrap: the ends of a 95 % interval rest on 50 of them each."""
_PRIOR: Final = 0.5
"""Jeffreys' prior of a rate, Beta(1/2, 1/2): the bound holds for any, and is narrow for this at rates near
0 and 1."""
_EDGE: Final = 1e-15
"""Nearest to 0 and 1 at which the logarithms of the likelihood still differ."""


class ConfidenceInterval(NamedTuple):
    """An estimate and its interval at the requested confidence."""

    estimate: float
    low: float
    high: float

    @property
    def width(self) -> float:
        return self.high - self.low

    @property
    def complement(self) -> "ConfidenceInterval":
        """The interval of the complementary rate."""
        return ConfidenceInterval(1.0 - self.estimate, 1.0 - self.high, 1.0 - self.low)


def clopper_pearson(passed: int, runs: int, confidence: float) -> ConfidenceInterval:
    """Return the interval of a rate after a planned number of runs; exact, never below ``confidence``."""
    if not runs:
        return ConfidenceInterval(math.nan, 0.0, 1.0)
    return ConfidenceInterval(passed / runs, *confidence_limits(passed, runs, confidence=confidence))


def anytime(passed: int, runs: int, confidence: float) -> ConfidenceInterval:
    """Return the interval of a rate after runs that ended when enough was seen, by any rule (see above)."""
    if not runs:
        return ConfidenceInterval(math.nan, 0.0, 1.0)
    rate, failed = passed / runs, runs - passed
    mixture = betaln(passed + _PRIOR, failed + _PRIOR) - betaln(_PRIOR, _PRIOR) + math.log(1.0 - confidence)

    def excess(p: float) -> float:
        return float(mixture - passed * math.log(p) - failed * math.log1p(-p))

    low = 0.0 if not passed else _root(excess, _EDGE, min(rate, 1.0 - _EDGE))
    high = 1.0 if not failed else _root(excess, max(rate, _EDGE), 1.0 - _EDGE)
    return ConfidenceInterval(rate, low, high)


def weighted_rate(weights: Floats, happened: NDArray[np.bool_], confidence: float) -> ConfidenceInterval:
    """Return how often something happens, from independent draws with weights, (n,), of mean 1.

    Normal in the logarithm, as a rate that is known to a factor is not known evenly to both sides. It sees
    what was drawn: a way to fail that no draw has met is in no interval. Where it never happened, its upper
    end is Clopper and Pearson's, times the largest weight.
    """
    if not weights.size:
        return ConfidenceInterval(math.nan, 0.0, 1.0)
    counted = weights * happened
    estimate = float(counted.mean())
    if estimate == 0.0:
        high = clopper_pearson(0, weights.size, confidence).high
        return ConfidenceInterval(0.0, 0.0, min(1.0, float(weights.max()) * high))
    error = float(counted.std(ddof=1)) / math.sqrt(weights.size) if weights.size > 1 else math.inf
    hits = np.count_nonzero(counted)
    factor = math.exp(float(student.ppf(0.5 + 0.5 * confidence, max(1, hits - 1))) * error / estimate)
    return ConfidenceInterval(estimate, estimate / factor, min(1.0, estimate * factor))


def _root(excess: Any, low: float, high: float) -> float:
    """Return where ``excess`` changes its sign; without a change, the end at which it is positive or
    nearest."""
    if excess(low) * excess(high) > 0.0:
        return low if abs(excess(low)) < abs(excess(high)) else high
    return float(brentq(excess, low, high, xtol=1e-12))


def quantile(values: Floats, share: float, confidence: float) -> ConfidenceInterval:
    """Return the quantile of a figure, (n,); by bootstrap, so that nothing is assumed about its distribution.

    It is limited by the values: a share beyond 1 - 10/n rests on the few largest.
    """
    return _resampled(values, partial(np.quantile, q=share), confidence, "percentile")


def mean(values: Floats, confidence: float) -> ConfidenceInterval:
    """Return the mean of a figure, (n,); by bootstrap, bias-corrected and accelerated."""
    return _resampled(values, np.mean, confidence, "BCa")


def _resampled(values: Floats, of: Callable[..., Any], confidence: float, method: str) -> ConfidenceInterval:
    """Bootstrap; ``of`` estimates from a sample along ``axis``."""
    if values.size < 2:
        return ConfidenceInterval(float(values[0]) if values.size else math.nan, -math.inf, math.inf)
    estimate = float(of(values))
    if np.ptp(values) <= 1e-12 * abs(estimate):
        return ConfidenceInterval(estimate, estimate, estimate)
    resampled = bootstrap(
        (values,),
        of,
        confidence_level=confidence,
        n_resamples=RESAMPLES,
        method=method,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return ConfidenceInterval(estimate, float(resampled.low), float(resampled.high))


class Paired(NamedTuple):
    """Two points of a grid on the same draws and seeds: the second minus the first."""

    pairs: int
    passed_first_alone: int
    passed_second_alone: int
    p_value: float
    """P-value of equal pass rates, exact (McNemar): pairs with the same outcome do not matter."""
    difference: ConfidenceInterval
    """Mean difference of the figure over the pairs that have it in both, by bootstrap."""


def paired(
    passed: tuple[NDArray[np.bool_], NDArray[np.bool_]], figure: tuple[Floats, Floats], confidence: float
) -> Paired:
    """Compare two points. ``passed``, ``figure``: (n,) of each, in the same order of draws and seeds."""
    first, second = passed
    first_alone, second_alone = int((first & ~second).sum()), int((second & ~first).sum())
    apart = first_alone + second_alone
    p_value = float(binomtest(second_alone, apart).pvalue) if apart else 1.0
    change = figure[1] - figure[0]
    return Paired(
        first.size, first_alone, second_alone, p_value, mean(change[np.isfinite(change)], confidence)
    )


class Sensitivity(NamedTuple):
    """Dependence of a figure on a key."""

    share_of_variance: float
    """Share of the figure's variance explained by the key alone (correlation ratio), 0 to 1."""
    rank_correlation: float
    """Spearman's, -1 to 1; NaN for a key that is no number."""


_BINS: Final = 10
"""For a key whose values are drawn: each bin should hold some ten runs of a small campaign."""


def sensitivity(key: NDArray[Any], figure: Floats) -> Sensitivity:
    """Compute it. ``key``: (n,) numbers or texts. ``figure``: (n,), NaN if missing."""
    there = np.isfinite(figure)
    key, figure = key[there], figure[there]
    if figure.size < 3 or np.ptp(figure) == 0.0 or np.unique(key).size < 2:
        return Sensitivity(0.0, math.nan)
    number = key.dtype.kind == "f"
    classes = np.unique(key, return_inverse=True)[1]
    if number and classes.max() >= _BINS:
        edges = np.quantile(key, np.linspace(0.0, 1.0, _BINS + 1)[1:-1])
        classes = np.digitize(key, edges)
    counts = np.bincount(classes)
    means = np.bincount(classes, figure)[counts > 0] / counts[counts > 0]
    between = float((counts[counts > 0] * (means - figure.mean()) ** 2).sum())
    total = float(((figure - figure.mean()) ** 2).sum())
    return Sensitivity(between / total, float(spearmanr(key, figure).statistic) if number else math.nan)
