"""The period of SYNCs that somebody else makes, from the instants at which they were heard.

SYNCs are lost and come late, at times by periods, from a process that stood still. A spacing alone then tells
neither how many periods it holds nor how long one is. So a period is sought by which they all have nearly the
same phase, as the strongest line of a periodogram (Schuster 1898), and a line is laid through their numbers.
"""

import cmath
import math
from collections.abc import Sequence
from itertools import pairwise
from statistics import linear_regression, median
from typing import Final

from servobench.drivers.timebase import Duration, Instant

RANGE: Final = 2.2
"""Periods are sought from the expected one divided by this to the expected one times this: half and twice it
are the slips of a setting, and the lines of both are free of each other."""
STEP: Final = 1e-3
"""From one period that is tried to the next, relative: over 32 periods the phase moves by 0.03 turns."""
LIKE: Final = 1.5
"""A median spacing that is longer than the period found by more than this, or shorter, says that the true one
lies outside of the range: a multiple of it, or a part."""


def period_of(heard_at: Sequence[Instant], expected: Duration) -> float:
    """The period, ns, of SYNCs that ended on the bus at ``heard_at``, three or more in order of time.

    ``expected``: near the true one, or far from it.
    """
    after = [at - heard_at[0] for at in heard_at]
    tries = round(math.log(RANGE) / STEP)
    tried = [expected * math.exp(number * STEP) for number in range(-tries, tries + 1)]
    period = max(tried, key=lambda each: abs(_phases(after, each)))
    typical = median(later - earlier for earlier, later in pairwise(after))
    if not 1.0 / LIKE < typical / period < LIKE:
        return typical
    phase = period / (2.0 * math.pi) * cmath.phase(_phases(after, period))
    return linear_regression([round((at - phase) / period) for at in after], after).slope


def _phases(after: Sequence[int], period: float) -> complex:
    """The sum of the unit vectors of the instants' phases: long where they are alike."""
    turn = 2j * math.pi / period
    return sum(cmath.exp(turn * at) for at in after)
