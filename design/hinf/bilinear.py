"""The bilinear map between sampled and continuous systems: s = 2/T (z - 1)/(z + 1).

It keeps the norm, so a sampled plant has its H-infinity design in the bilinear plane.
"""

import math

import numpy as np

from servobench.design.statespace import StateSpace, balanced


def tustin(system: StateSpace, rate_hz: float, exact_at_rad_s: float = 0.0) -> StateSpace:
    """Return the bilinear image of ``system``; its response is kept exactly at ``exact_at_rad_s``
    (prewarping).

    Error: ValueError for a prewarping frequency at or above half of the sampling rate.
    """
    period_s = 1.0 / rate_hz
    if not 0.0 <= exact_at_rad_s * period_s < math.pi:
        raise ValueError(
            f"more than {exact_at_rad_s / math.pi:.3g} Hz, for the loop crosses at {exact_at_rad_s:.4g} "
            "rad/s; sample faster, or lower the crossing of w1"
        )
    half = 0.5 * period_s
    if exact_at_rad_s > 0.0:
        half = math.tan(exact_at_rad_s * half) / exact_at_rad_s
    even = balanced(system)
    inverse = np.linalg.inv(np.eye(even.order) - half * even.A)
    A = inverse @ (np.eye(even.order) + half * even.A)
    root = math.sqrt(2.0 * half)
    return StateSpace(
        A,
        root * inverse @ even.B,
        root * even.C @ inverse,
        even.D + half * even.C @ inverse @ even.B,
        period_s,
    )


def from_bilinear(system: StateSpace, period_s: float) -> StateSpace:
    """Return the sampled system of a ``system`` in the bilinear plane: Tustin's rule without prewarping."""
    return tustin(system, 1.0 / period_s)


def to_bilinear(system: StateSpace) -> StateSpace:
    """Invert :func:`from_bilinear`. Error: ValueError for a pole at z = -1."""
    period_s = system.period_s
    if period_s is None:
        raise ValueError("a sampled system is expected")
    half, n = 0.5 * period_s, system.order
    inverse = np.linalg.inv(system.A + np.eye(n))
    root = math.sqrt(2.0 / half)
    return StateSpace(
        (system.A - np.eye(n)) @ inverse / half,
        root * inverse @ system.B,
        root * system.C @ inverse,
        system.D - system.C @ inverse @ system.B,
    )
