"""The Kalman filter on count and filtered speed of one sample: speed, filtered speed, angle and load torque.

    606Ch = f (6064h - m)      m: an exponential mean of past counts      f: see :func:`rounding`

A count is rounded to a whole one, and so is each in m: the mean has a smaller rounding, independent of that
of the newest count. The filter knows both of each sample, and their covariance. Its gains are constant, but
that a sample behind lost ones counts for more.
"""

import math
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.speed.predictor_plant import FILTERED, LOAD, SPEED, PredictorPlant

UNSURE = 4
"""States of the filter: [omega, w, angle, T_L]. The torque follows from the commands."""
_ANGLE, _LOAD = 2, 3
READ = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
"""Count and filtered speed."""


def rounding(counts_per_revolution: int, filter_hz: float, rate_hz: float, jitter_rad: float = 0.0) -> Array:
    """Return the covariance (2, 2) that rounding adds to a count, rad, and to 606Ch, rad/s.

    The filter is a (1 - z^-1)/(1 - (1 - a) z^-1) of the count times the rate: the newest count has the share
    f = a rate, the mean m of the past ones a rounding of a/(2 - a) of a count's variance. ``jitter_rad``: rms
    angle by which the shaft turns within what the instant of a sample is unsure by.
    """
    a = 1.0 / (1.0 + rate_hz / (math.tau * filter_hz))
    f, of_count = a * rate_hz, (math.tau / counts_per_revolution) ** 2 / 12.0
    both = of_count * np.array([[1.0, f], [f, 2.0 * f * f / (2.0 - a)]])
    both[0, 0] += jitter_rad**2
    return both


@dataclass(frozen=True, slots=True)
class FusedWalks:
    """What drives the filter's model."""

    load_nm_sqrt_s: float
    """Random walk of the load."""
    speed_rad_s_sqrt_s: float
    """Random walk of the speed itself."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedFilter:
    """P+ = Phi P Phi' + Q between two samples, over [omega, w, angle, T_L]."""

    Phi: Array
    Q_torque: Array
    Q_load: Array
    Q_speed: Array
    R: Array
    """(2, 2) covariance of the noise on count and filtered speed."""

    def stationary(self, walks: FusedWalks) -> Array:
        """Return P (4, 4) before each correction, where every sample comes."""
        from scipy.linalg import solve_discrete_are

        return np.asarray(solve_discrete_are(self.Phi.T, READ.T, self._process(walks), self.R))

    def gain(self, P: Array) -> Array:
        """Return L (4, 2) of a correction from P."""
        return np.asarray(np.linalg.solve(READ @ P @ READ.T + self.R, READ @ P).T)

    def gains(self, walks: FusedWalks, losses_max: int) -> list[Array]:
        """Return L (4, 2) of the sample after 0, 1 .. lost ones, before which every one came."""
        P = self.stationary(walks)
        gains = [self.gain(P)]
        P = P - gains[0] @ READ @ P
        P = self._predicted(P, walks)
        for _ in range(losses_max):
            P = self._predicted(P, walks)
            gains.append(self.gain(P))
        return gains

    def spread_rad(self, walks: FusedWalks) -> float:
        """Return the standard deviation of a count from the expected one."""
        return math.sqrt(self.stationary(walks)[_ANGLE, _ANGLE] + self.R[0, 0])

    def _process(self, walks: FusedWalks) -> Array:
        load, speed = walks.load_nm_sqrt_s, walks.speed_rad_s_sqrt_s
        return np.asarray(self.Q_torque + load * load * self.Q_load + speed * speed * self.Q_speed)

    def _predicted(self, P: Array, walks: FusedWalks) -> Array:
        return np.asarray(self.Phi @ P @ self.Phi.T + self._process(walks))


def fused_filter(plant: PredictorPlant, period_s: float, R: Array, torque_noise_nm: float) -> FusedFilter:
    """Make the filter. ``R``: see :func:`rounding`; ``torque_noise_nm``: rms difference between the torque of
    a period and its command."""
    from scipy.linalg import expm

    A = np.zeros((UNSURE, UNSURE))
    places = (SPEED, FILTERED, LOAD)
    own = (0, 1, _LOAD)
    A[np.ix_(own, own)] = plant.A[np.ix_(places, places)]
    A[_ANGLE, 0] = 1.0

    def within(place: int) -> tuple[Array, Array]:
        """Return Phi and Q for white noise of 1 per root of s on a state (Van Loan, 1978)."""
        noise = np.zeros((UNSURE, UNSURE))
        noise[place, place] = 1.0
        total = expm(np.block([[-A, noise], [np.zeros_like(A), A.T]]) * period_s)
        Phi = total[UNSURE:, UNSURE:].T
        added = Phi @ total[:UNSURE, UNSURE:]
        return Phi, 0.5 * (added + added.T)

    Phi, of_load = within(_LOAD)
    _, of_speed = within(0)
    held = torque_noise_nm * Phi[:, _LOAD]
    held[_LOAD] = 0.0
    return FusedFilter(Phi, np.outer(held, held), of_load, of_speed, R)
