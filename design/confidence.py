"""Confidence intervals of figures from a sample: closed forms, at 95 % confidence by default.

Samples count as independent. Losses in bursts carry less information than their number: see ``inflation``.
"""

import math
from bisect import bisect_left
from typing import Final, NamedTuple

from scipy.special import bdtr, betaincinv

CONFIDENCE: Final = 0.95
"""Two standard deviations: customary in measurement, and familiar to the reader of a figure."""


class Interval(NamedTuple):
    """Interval in which a value lies."""

    low: float
    high: float


def clopper_pearson(
    events: float, trials: float, inflation: float = 1.0, confidence: float = CONFIDENCE
) -> Interval:
    """Bound the probability of an event of which ``events`` were seen in ``trials`` (Clopper and Pearson
    1934).

    It covers the true one at least as often as it says. ``inflation``: ratio of the count's variance to that
    of independent trials; the sample counts as that many times smaller. Error: ValueError for more events
    than trials, or no trials.
    """
    if not 0 <= events <= trials or trials <= 0:
        raise ValueError(f"{events} events in {trials} trials")
    half = (1.0 - confidence) / 2.0
    seen, missed = events / inflation, (trials - events) / inflation
    low = float(betaincinv(seen, missed + 1.0, half)) if seen > 0.0 else 0.0
    high = float(betaincinv(seen + 1.0, missed, 1.0 - half)) if missed > 0.0 else 1.0
    return Interval(low, high)


def share_within_largest(samples: int) -> float:
    """Return the share of all values, present or future, that the largest of ``samples`` is not exceeded by.

    All of n samples lie below the quantile q with probability q^n; so it is 0.05^(1/n), about 1 - 3/n.
    """
    return math.exp(math.log(1.0 - CONFIDENCE) / samples)


def rank_above(share: float, samples: int) -> int | None:
    """Return the rank, counted from 1, of the value among ``samples`` in rising order that the quantile
    ``share`` does not exceed.

    The r-th is below the quantile if at least r values are: a binomial tail. None: too few samples.
    """
    below = bisect_left(range(samples), CONFIDENCE, key=lambda count: bdtr(count, samples, share))
    return below + 1 if below < samples else None
