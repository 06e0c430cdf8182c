"""The H-infinity norm of a state-space system, independent of any synthesis.

The norm is the peak of the largest singular value over frequency. A level g is exceeded somewhere exactly
if a Hamiltonian matrix of the system and g has eigenvalues on the imaginary axis, and these are the
frequencies where a singular value crosses g (Boyd and Balakrishnan 1990; Bruinsma and Steinbuch 1990).
The search climbs from crossing to crossing; the peak itself is then found by golden section. The first
grid holds 0, infinity and the poles' frequencies, because a peak may sit at rest.
"""

import math
from dataclasses import replace

import numpy as np
import scipy.linalg
import scipy.optimize

from servobench.design.statespace import Array, Peak, StateSpace, balanced, rebalanced, to_bilinear

_NEAR_AXIS = 1e-5
"""|real part| below this part of an eigenvalue's magnitude: perhaps a crossing, so it is examined."""
_STEPS_MAX = 60
"""Bound of the iteration: 400 random systems, combs of resonances among them, take four at most."""
_RELATIVE = 1e-11
"""Down to 1e-13 no system takes more than five steps; at 1e-15 rounding errors are climbed, in up to
seven."""
_OWN_PERIOD_S = 2.0
"""Period for which the bilinear map is s = (z - 1)/(z + 1): crossings of all rates are treated alike."""


def largest_gain(system: StateSpace, frequency_rad_s: Array) -> Array:
    """Return the (k,) largest singular value at the k frequencies, rad/s; infinite at a pole."""
    try:
        return np.asarray(np.linalg.norm(system.response(frequency_rad_s), 2, axis=(1, 2)), dtype=float)
    except np.linalg.LinAlgError:  # one of them is a pole, to rounding
        if len(frequency_rad_s) == 1:
            return np.array([math.inf])
        return np.concatenate(
            [largest_gain(system, frequency_rad_s[k : k + 1]) for k in range(len(frequency_rad_s))]
        )


def hinf_norm(system: StateSpace) -> Peak:
    """Return the largest singular value over frequency, to :data:`_RELATIVE`; infinite for an unstable
    system."""
    if not system.is_stable():
        return Peak(math.inf, math.nan)
    even = balanced(system)
    frequencies = _first_frequencies(even)
    peak = _best(even, frequencies)
    for _ in range(_STEPS_MAX):
        refined = _refined(even, peak)
        crossings = _crossings(even, refined.gain * (1.0 + _RELATIVE))
        middle = np.sqrt(crossings[:-1] * crossings[1:]) if len(crossings) > 1 else crossings
        higher = _best(even, np.concatenate([crossings, middle, [refined.frequency_rad_s]]))
        if higher.gain <= refined.gain * (1.0 + _RELATIVE):
            return refined
        peak = higher
    return peak


def norm_is_below(system: StateSpace, level: float) -> bool:
    """Return True if the system is stable and its largest singular value below ``level`` at every frequency.

    One level takes only part of the time of :func:`hinf_norm`.
    """
    if not system.is_stable():
        return False
    even = balanced(system)
    if not _best(even, _first_frequencies(even)).gain < level:
        return False
    crossings = _crossings(even, level)
    between = np.sqrt(crossings[:-1] * crossings[1:])
    return not len(crossings) or _best(even, np.concatenate([crossings, between])).gain < level


def _best(system: StateSpace, frequencies: Array) -> Peak:
    gains = largest_gain(system, frequencies)
    top = int(np.argmax(gains))
    return Peak(float(gains[top]), float(frequencies[top]))


def _rates(system: StateSpace) -> Array:
    poles = system.poles()
    if system.period_s is None:
        rates = np.concatenate([np.abs(poles), np.abs(poles.imag)])
    else:
        logs = np.log(np.where(poles == 0.0, 1e-300, poles)) / system.period_s
        rates = np.minimum(np.concatenate([np.abs(logs), np.abs(logs.imag)]), math.pi / system.period_s)
    return np.asarray(rates[rates > 0.0], dtype=float)


def _first_frequencies(system: StateSpace) -> Array:
    last = math.inf if system.period_s is None else math.pi / system.period_s
    rates = _rates(system)
    if not len(rates):
        return np.array([0.0, last])
    low, high = math.log10(rates.min()) - 1.0, math.log10(rates.max()) + 1.0
    if system.period_s is not None:
        high = min(high, math.log10(last))
    grid = np.logspace(low, high, 12 * max(4, math.ceil(high - low)))
    return np.unique(np.concatenate([[0.0], rates, grid[grid <= last], [last]]))


def _refined(system: StateSpace, peak: Peak) -> Peak:
    """Climb to the top of the hill at ``peak``."""
    omega = peak.frequency_rad_s
    if omega == 0.0 or math.isinf(omega):
        return peak
    last = math.inf if system.period_s is None else math.log(math.pi / system.period_s)
    width = 0.4

    def depth(log_omega: float) -> float:
        return -float(largest_gain(system, np.array([math.exp(log_omega)]))[0])

    bounds = (math.log(omega) - width, min(math.log(omega) + width, last))
    optimum = scipy.optimize.minimize_scalar(depth, bounds=bounds, method="bounded", options={"xatol": 1e-9})
    return Peak(-optimum.fun, math.exp(optimum.x)) if -optimum.fun > peak.gain else peak


def _crossings(system: StateSpace, level: float) -> Array:
    """Return frequencies, rad/s, where a singular value may cross ``level``, in order."""
    if system.period_s is not None:
        return _sampled_crossings(system, level)
    A, B, C, D = system.A, system.B, system.C, system.D
    R = level**2 * np.eye(D.shape[1]) - D.T @ D
    if np.linalg.cond(R) > 1e14:
        return np.zeros(0)
    BR = np.linalg.solve(R, B.T).T
    E = A + BR @ D.T @ C
    S = np.eye(len(D)) + D @ np.linalg.solve(R, D.T)
    H = np.block([[E, BR @ B.T], [-C.T @ S @ C, -E.T]])
    values = np.linalg.eigvals(rebalanced(H))
    near = np.abs(values.real) <= _NEAR_AXIS * np.abs(values)
    return np.unique(np.abs(values[near].imag))


def _sampled_crossings(system: StateSpace, level: float) -> Array:
    """Return the same on the unit circle, through the bilinear map s = (z - 1)/(z + 1)."""
    values = _crossings(to_bilinear(replace(system, period_s=_OWN_PERIOD_S)), level)
    assert system.period_s is not None
    return np.asarray(2.0 * np.arctan(values) / system.period_s)
