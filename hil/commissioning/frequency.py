"""Frequency response by a multisine in whole periods: no leakage, and a meaningful coherence."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servobench.hil.commissioning.identify import Array

ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse:
    """Output over input at the excited lines."""

    frequency_hz: Array
    response: ComplexArray
    coherence: Array
    """0..1: the part of the output explained by the input."""


def lines_hz(low_hz: float, high_hz: float, count: int, block_s: float) -> Array:
    """Return up to ``count`` different lines, whole multiples of 1/block, evenly spaced by ratio."""
    steps = np.geomspace(low_hz * block_s, high_hz * block_s, count)
    return np.asarray(np.unique(np.round(steps)) / block_s)


def frequency_response(
    time: Array, source: Array, output: Array, lines: Array, block_s: float, period_s: float, skip_s: float
) -> FrequencyResponse:
    """Return H1 = S_yu / S_uu over whole blocks, after ``skip_s``; lost samples are interpolated."""
    count = round(block_s / period_s)
    start = time[0] + skip_s
    blocks = int((time[-1] - start) / block_s)
    if blocks < 2:
        raise ValueError(f"{blocks} whole blocks of {block_s:g} s, at least two are needed")
    grid = start + period_s * np.arange(blocks * count)
    u = np.interp(grid, time, source).reshape(blocks, count)
    y = np.interp(grid, time, output).reshape(blocks, count)
    spectrum_u = np.fft.rfft(u - u.mean(), axis=1)
    spectrum_y = np.fft.rfft(y - y.mean(), axis=1)
    bins = np.round(lines * block_s).astype(int)
    u_lines, y_lines = spectrum_u[:, bins], spectrum_y[:, bins]
    cross = (y_lines * u_lines.conj()).mean(axis=0)
    power_u = (np.abs(u_lines) ** 2).mean(axis=0)
    power_y = (np.abs(y_lines) ** 2).mean(axis=0)
    coherence = np.abs(cross) ** 2 / np.maximum(power_u * power_y, 1e-300)
    return FrequencyResponse(lines, cross / np.maximum(power_u, 1e-300), np.minimum(coherence, 1.0))


@dataclass(frozen=True, slots=True)
class StepLag:
    """Response of a first-order lag behind a dead time to a step."""

    half_us: float
    """Time to half of the step."""
    dead_us: float
    lag_us: float
    """Time constant."""
    mean_us: float
    """Area above the response: its final lag behind the step, whatever its shape. For a loop with one
    integrator it is 1/bandwidth, however long the dead time in the loop is."""


_SETTLED_LAGS = 6.0
"""After half of the step: the remainder, 0.1 % of a first-order lag, is less than the error of a drive's
torque feedback, which would add to the area for as long as it is taken."""


def step_lag(age_us: Array, part: Array) -> StepLag:
    """Find the lag from samples of a step response at many ages: the part of the step reached.

    Equivalent-time sampling: each sample is of another repetition of the step. The answer at each age is the
    median of its neighbours. Raises ValueError if the samples do not show the rise.
    """
    order = np.argsort(age_us, kind="stable")
    age, value = age_us[order], part[order]
    count = max(5, len(age) // 150) | 1
    if len(age) < 5 * count:
        raise ValueError(f"{len(age)} samples are too few")
    windows = np.lib.stride_tricks.sliding_window_view
    middle = np.median(windows(value, count), axis=1)
    smooth = np.maximum.accumulate(middle)
    at = windows(age, count).mean(axis=1)
    low, half, most = (_crossing(at, smooth, level) for level in (0.1, 0.5, 0.9))
    # 1 - exp(-t/T) passes 10 % and 90 % ln 9 time constants apart, and 50 % after ln 2 of them.
    lag = (most - low) / float(np.log(9.0))
    there = at <= half + _SETTLED_LAGS * lag
    mean = float(at[0] + np.trapezoid(1.0 - middle[there], at[there]))
    return StepLag(half, half - lag * float(np.log(2.0)), lag, mean)


def _crossing(at: Array, value: Array, level: float) -> float:
    above = int(np.argmax(value >= level))
    if value[above] < level or value[0] >= level:
        raise ValueError(f"the answer to the step does not pass {100 * level:.0f} % where it was sampled")
    before, after = value[above - 1], value[above]
    part = (level - before) / (after - before) if after > before else 0.0
    return float(at[above - 1] + part * (at[above] - at[above - 1]))
