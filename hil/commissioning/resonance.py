"""The resonance of a coupled load in a frequency response: where it shows, and its frequency and damping.

The torque is held between samples, so that the sampled response is rational in z, with the poles exp(p T) of
the machine: no filter in front of the samples and no delay moves them.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from servobench.hil.commissioning.excitation import FrequencyResponse
from servobench.hil.commissioning.identify import Array

RISE_MIN: Final = 1.5
"""Above the rigid shaft: less is the error of a response, or a coupling that no speed loop feels."""
_BELOW, _ABOVE = 0.75, 1.3
"""The lines of a closer look, of the frequency of the highest rise: the resonance is a tenth off at most."""
_LINES_MAX: Final = 20
_COHERENT: Final = 0.3
"""A line counts by the square root of its signal over its noise; below this it says nothing."""
_NUMERATOR: Final = 4
"""Coefficients: two zeros, and one for the slope of all that is further away."""
_ROUNDS: Final = 8
"""Of the fit; each weighs by the denominator of the one before."""
_DAMPING_MAX: Final = 0.3
"""More is no resonance."""


class Resonance(NamedTuple):
    """A pair of poles."""

    frequency_hz: float
    damping_ratio: float
    magnitude: float
    """The largest measured, rad/s per N m."""


def closer_lines_hz(near_hz: float, block_s: float, highest_hz: float) -> Array:
    """Return lines (k,) around a resonance, whole multiples of 1/block, as far as they can be excited."""
    low, high = _BELOW * near_hz * block_s, min(_ABOVE * near_hz, highest_hz) * block_s
    step = max(1.0, math.ceil((high - low) / _LINES_MAX))
    return np.asarray(np.arange(math.ceil(low), high, step) / block_s)


def resonance_of(measured: FrequencyResponse, period_s: float) -> Resonance | None:
    """Fit a pair of poles to the coherent lines; None where they show none inside their band."""
    good = measured.coherence > _COHERENT
    frequency, response = measured.frequency_hz[good], measured.response[good]
    if len(frequency) < 2 * (_NUMERATOR + 2):
        return None
    back = np.exp(-2j * math.pi * frequency * period_s)
    coherence = np.minimum(measured.coherence[good], 0.99)
    sure = np.sqrt(coherence / (1.0 - coherence)) / np.abs(response)
    weight = sure
    poles = np.zeros(2)
    for _ in range(_ROUNDS):
        columns = [back**power for power in range(_NUMERATOR)]
        columns += [-response * back, -response * back**2]
        matrix = np.stack(columns, axis=1) * weight[:, None]
        right = response * weight
        scale = np.linalg.norm(matrix, axis=0)
        both = np.vstack([matrix.real, matrix.imag]) / scale
        solution = np.linalg.lstsq(both, np.concatenate([right.real, right.imag]), rcond=None)[0] / scale
        poles = solution[_NUMERATOR:]
        below = 1.0 + poles[0] * back + poles[1] * back**2
        weight = sure / np.maximum(np.abs(below), 1e-9)
    roots = np.roots([1.0, *poles])
    rate = np.log(roots[np.argmax(roots.imag)].astype(complex)) / period_s
    hz, damping = abs(rate) / math.tau, -rate.real / abs(rate)
    if not (frequency[0] < hz < frequency[-1] and 0.0 < damping < _DAMPING_MAX):
        return None
    return Resonance(float(hz), float(damping), float(np.abs(response).max()))
