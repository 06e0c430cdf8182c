"""A position loop over a drive's speed mode: its gain for a delay, and its certificates.

    u = -K theta(t - tau), held for h         v' = omega_s (u - v)         theta' = v

in error coordinates: theta is the error of the position, v that of the speed; omega_s is the
bandwidth of the drive's closed speed loop, of first order. Positions are sampled every h, and tau passes
from a sample until its set-point acts; it need be no whole number of periods. In the form of
:mod:`servobench.design.delay.delay_loop`, x = [v, theta], so :mod:`servobench.design.sampled` certifies it as
it does a speed loop.
"""

import math

import numpy as np

from servobench.design.delay.delay_loop import Array, SpeedModel

SENSITIVITY_PEAK = 1.4
"""Peak of |S|, by which the gain is chosen: within it gain margins are at least 1.4 / 0.4 = 3.5 and phase
margins 2 asin(1 / 2.8) = 42 degrees, and |T| of such a loop stays below 1.1, so a step hardly overshoots."""
_GRID = 2000
"""Frequencies up to half the rate: S is flat between two of them, even with a delay of 100 periods."""
_BISECTIONS = 50
"""Halvings that leave 2^-50 of an interval: a double has 53 bits."""


def position_model(bandwidth_rad_s: float) -> SpeedModel:
    """Return the open loop; its disturbance is a speed, rad/s, at the shaft, its error the position, rad."""
    return SpeedModel(
        A=np.array([[-bandwidth_rad_s, 0.0], [1.0, 0.0]]),
        B1=np.array([bandwidth_rad_s, 0.0]),
        B2=np.array([0.0, 1.0]),
        C=np.array([0.0, 1.0]),
        state_scale=np.array([bandwidth_rad_s, 1.0]),
    )


def feedback(gain_per_s: float) -> Array:
    """Return K of u = K x, (2,)."""
    return np.array([0.0, -gain_per_s])


def design_position(period_s: float, delay_s: float, bandwidth_rad_s: float) -> float:
    """Return K, 1/s: the largest at which |S| peaks at :data:`SENSITIVITY_PEAK`.

    ``delay_s``: from sample to actuator, tau. Raises ValueError for an invalid time.
    """
    if not (period_s > 0.0 and delay_s >= 0.0 and bandwidth_rad_s > 0.0):
        raise ValueError("a period and a bandwidth above 0 and a delay of at least 0 expected")
    loop = _SampledIntegrator(period_s, delay_s, bandwidth_rad_s)
    # An integrator with dead time D is unstable from K = pi / 2 D on.
    high = math.pi / 2.0 / (delay_s + period_s / 2.0 + 1.0 / bandwidth_rad_s) * 4.0
    low = 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        keeps = loop.radius(middle) < 1.0 and loop.sensitivity_peak(middle) <= SENSITIVITY_PEAK
        low, high = (middle, high) if keeps else (low, middle)
    return low


def closed_loop(gain_per_s: float, period_s: float, delay_s: float, bandwidth_rad_s: float) -> Array:
    """Return one period of the closed loop, (n + 3, n + 3): [v, theta, the last n + 1 samples of theta]."""
    return _SampledIntegrator(period_s, delay_s, bandwidth_rad_s).step(gain_per_s)


class _SampledIntegrator:
    """theta at the samples as a function of the set-points, exactly."""

    def __init__(self, period_s: float, delay_s: float, bandwidth_rad_s: float) -> None:
        self.behind = math.floor(delay_s / period_s + 1e-9)
        rest_s = max(0.0, delay_s - self.behind * period_s)
        self.transition, whole = _held(bandwidth_rad_s, period_s)
        _, self._new = _held(bandwidth_rad_s, period_s - rest_s)
        self._old = whole - self._new

    def radius(self, gain_per_s: float) -> float:
        """Return the spectral radius of the closed loop; below 1 it is stable."""
        return float(np.abs(np.linalg.eigvals(self.step(gain_per_s))).max())

    def step(self, gain_per_s: float) -> Array:
        """Return the matrix of :func:`closed_loop`."""
        kept = self.behind + 1
        step = np.zeros((2 + kept, 2 + kept))
        step[:2, :2] = self.transition
        step[2, 1] = 1.0
        step[3:, 2:-1] = np.eye(kept - 1)
        # u of the sample n + 1 periods ago acts first, then that of n periods ago
        step[:2, 1 + kept] -= gain_per_s * self._old
        step[:2, 1 + self.behind] -= gain_per_s * self._new
        return step

    def sensitivity_peak(self, gain_per_s: float) -> float:
        """Return max |S| over frequency."""
        z = np.exp(1j * np.pi * np.arange(1, _GRID + 1) / _GRID)
        (a, _), (c, d) = self.transition
        # theta of [v, theta] out of (zI - Phi)^-1 Gamma, Phi lower triangular
        drive = self._old * z[:, None] ** -(self.behind + 1) + self._new * z[:, None] ** -self.behind
        speed = drive[:, 0] / (z - a)
        loop = gain_per_s * (drive[:, 1] + c * speed) / (z - d)
        return float(np.abs(1.0 / (1.0 + loop)).max())


def _held(bandwidth_rad_s: float, length_s: float) -> tuple[Array, Array]:
    """Return Phi (2, 2) and Gamma (2,) of a held input."""
    risen = -math.expm1(-bandwidth_rad_s * length_s)
    travelled_s = risen / bandwidth_rad_s
    return np.array([[1.0 - risen, 0.0], [travelled_s, 1.0]]), np.array([risen, length_s - travelled_s])
