"""A parametric bootstrap: the twin is recorded as the drive was, by an encoder with steps, and fitted.

Each draw places the inner ticks of the drive anew, once for all windows as a drive has them, and the shaft
in each window. The fit of a draw is one step of Gauss-Newton from the solution, with its slopes: it is near.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from servobench.design.windowed_fit import WindowedFit, WindowedProblem
from servobench.hil.twin.plant import Array, RecordedWindow, Rigid, TwinPlant

_SEED: Final = 45
"""The same fit has the same bootstrap."""


class Bootstrap(NamedTuple):
    """What the fits of a recorded twin show."""

    bias: Array
    """(p,): what they are off by on the mean."""
    covariance: Array
    """(p, p): of what they are off by, about the solution: what repeats in all windows is in it."""
    spread: Array
    """(o,): root mean square of what is left of each output."""


def bootstrapped(
    problem: WindowedProblem,
    windows: Sequence[RecordedWindow],
    recorder: TwinPlant,
    tick_s: float,
    found: WindowedFit,
    draws: int,
) -> Bootstrap:
    """Record the twin ``draws`` times by ``recorder``, and fit each."""
    random = np.random.default_rng(_SEED)
    rigid = Rigid(*found.parameters.tolist())
    smooth = [problem.model(number, found.parameters, state) for number, state in enumerate(found.initial)]
    unit = float(problem.floors[2]) * math.sqrt(12.0)
    free = np.flatnonzero(np.any(found.solving != 0.0, axis=1))
    off, squares = np.zeros((draws, len(found.parameters))), np.zeros(len(found.spread))
    for draw in range(draws):
        score, grid_s = np.zeros(len(free)), random.uniform(0.0, tick_s)
        for number, window in enumerate(windows):
            angle, slopes = random.uniform(0.0, math.tau), found.slopes[number]
            state = float(found.initial[number])
            told = recorder.run(window, rigid, state, angle_rad=angle, grid_s=grid_s)
            told[2] = unit * np.round(told[2] / unit)
            left = np.where(np.isfinite(window.outputs), told - smooth[number], np.nan)
            left[1] -= np.nanmean(left[1]) if np.isfinite(left[1]).any() else 0.0
            white = slopes.without_own(found.noise.white(left)[slopes.there])
            score += slopes.over_parameters.T @ white
            squares += np.nanmean(left**2, axis=1)
        off[draw, free] = found.solving[np.ix_(free, free)] @ score
    spread = np.sqrt(squares / (draws * len(windows)))
    return Bootstrap(off.mean(axis=0), off.T @ off / draws, spread)
