"""A predictor's plant: current loop, shaft, the drive's speed filter, and a load that walks.

    T' = a (u - T)     J omega' = T - B omega - T_L     w' = f (omega - w)     T_L' = white noise
    y = w + noise of the encoder

State x = [T, omega, w, T_L]: N m, rad/s, rad/s, N m. The torque has no variance: it follows from the
commands, and its difference from them counts as noise on the speed.
"""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.motor import PmsmParameters

STATES = 4
TORQUE, SPEED, FILTERED, LOAD = range(STATES)
_UNSURE = (SPEED, FILTERED, LOAD)
READ = np.array([0.0, 1.0, 0.0])
"""The filtered speed among the states with a variance."""
_DOUBLINGS, _SETTLED = 60, 1e-15
"""Doublings of the number of periods at most, and the relative change that ends them."""


@dataclass(frozen=True, slots=True)
class PredictorPlant:
    """The parameters."""

    inertia_kg_m2: float
    viscous_friction_nm_s: float
    current_rate_rad_s: float
    """a."""
    filter_rate_rad_s: float
    """f."""

    @property
    def A(self) -> Array:
        """(4, 4)."""
        J, a, f = self.inertia_kg_m2, self.current_rate_rad_s, self.filter_rate_rad_s
        return np.array(
            [
                [-a, 0.0, 0.0, 0.0],
                [1.0 / J, -self.viscous_friction_nm_s / J, 0.0, -1.0 / J],
                [0.0, f, -f, 0.0],
                [0.0, 0.0, 0.0, 0.0],
            ]
        )

    @property
    def B(self) -> Array:
        """(4,), input of the command."""
        return np.array([self.current_rate_rad_s, 0.0, 0.0, 0.0])

    def changed(self, inertia: float = 1.0, current: float = 1.0) -> "PredictorPlant":
        """Return the plant with a multiple of the inertia, and of the current loop's bandwidth."""
        return replace(
            self,
            inertia_kg_m2=self.inertia_kg_m2 * inertia,
            current_rate_rad_s=self.current_rate_rad_s * current,
        )

    def step(self, length_s: float) -> tuple[Array, Array]:
        """Return transition (4, 4) and input (4,) under a command held for ``length_s``."""
        return _step(self, length_s)

    def look(self, acts_s: float, at_s: float) -> tuple[Array, Array, Array]:
        """Return the maps to the state ``at_s`` into a period, from that at its begin, the command before and
        the one after.

        ``acts_s``: when the latter begins to act.
        """
        if at_s <= acts_s:
            first, held = self.step(at_s)
            return first, held, np.zeros(STATES)
        (first, held), (second, entered) = self.step(acts_s), self.step(at_s - acts_s)
        return second @ first, second @ held, entered

    def feedback(self, bandwidth_rad_s: float, torque_rate_rad_s: float) -> Array:
        """Return F (4,) of u = -F x: the plant without delay gets these two poles, and the load is
        cancelled."""
        J, B, a = self.inertia_kg_m2, self.viscous_friction_nm_s, self.current_rate_rad_s
        torque = (bandwidth_rad_s + torque_rate_rad_s - B / J) / a - 1.0
        speed = (bandwidth_rad_s * torque_rate_rad_s - a * (1.0 + torque) * B / J) * J / a
        return np.array([torque, speed, 0.0, -(1.0 + torque)])


@cache
def _step(plant: PredictorPlant, length_s: float) -> tuple[Array, Array]:
    from scipy.linalg import expm  # a third of a second, and an extra, that a run does without

    M = np.zeros((STATES + 1, STATES + 1))
    M[:STATES, :STATES], M[:STATES, STATES] = plant.A, plant.B
    total = expm(M * length_s)
    return total[:STATES, :STATES], total[:STATES, STATES]


@dataclass(frozen=True, slots=True, eq=False)
class KalmanModel:
    """P+ = Phi P Phi' + Q between two samples, over [omega, w, T_L]; Q = Q_0 + walk^2 Q_1."""

    Phi: Array
    Q_torque: Array
    Q_walk: Array
    """Process noise of a walk of 1 N m per root of s."""
    R: float
    """Variance of the noise on a sample, (rad/s)^2."""

    def process(self, walk: float) -> Array:
        """Return Q (3, 3)."""
        return np.asarray(self.Q_torque + walk * walk * self.Q_walk)

    def stationary(self, walk: float) -> Array:
        """Return P (3, 3) before each correction, where every sample comes."""
        return np.asarray(self._stationary(np.array([walk]))[0])

    def _stationary(self, walks: Array) -> Array:
        """Return the same for (N,) walks, (N, 3, 3).

        By doubling: from covariances after k periods to those after 2 k (Chu, Fan, Lin, Wang, Int. J. Control
        77(8), 2004).
        """
        n = len(self.Phi)
        # in units in which every state's walk of a period has the size of the noise on a sample
        units = np.sqrt(np.diag(self.Phi @ self.process(1.0) @ self.Phi.T + self.process(1.0)))
        H = (self.Q_torque + (walks * walks)[:, None, None] * self.Q_walk) / np.outer(units, units)
        A = np.broadcast_to((self.Phi * units / units[:, None]).T, H.shape)
        G = np.broadcast_to(np.outer(READ * units, READ * units) / self.R, H.shape)
        for _ in range(_DOUBLINGS):
            W = np.linalg.solve(np.eye(n) + G @ H, np.concatenate([A, G], axis=2))
            turned, added = W[..., :n], H @ W[..., :n]
            later = H + np.swapaxes(A, 1, 2) @ added
            G = G + A @ W[..., n:] @ np.swapaxes(A, 1, 2)
            A = A @ turned
            later = 0.5 * (later + np.swapaxes(later, 1, 2))
            settled = np.max(np.abs(later - H)) <= _SETTLED * np.max(np.abs(later))
            H = later
            if settled:
                break
        return np.asarray(H * np.outer(units, units))

    @cache  # noqa: B019 - a model lives as long as its design
    def settled(self, walk: float) -> Array:
        """Return P (3, 3) after each correction, where every sample comes."""
        return self.corrected(self.stationary(walk))

    def gain(self, P: Array) -> Array:
        """Return L (3,) of a correction from P."""
        return np.asarray(P @ READ / (READ @ P @ READ + self.R))

    def corrected(self, P: Array) -> Array:
        """Return P after a correction."""
        return np.asarray(P - np.outer(self.gain(P), READ @ P))

    def predicted(self, P: Array, walk: float) -> Array:
        """Return P a period later."""
        return np.asarray(self.Phi @ P @ self.Phi.T + self.process(walk))

    def observer(self, walk: float) -> Array:
        """Return L (4,) of x, where every sample comes."""
        return np.asarray(self.observers(np.array([walk]))[0])

    def observers(self, walks: Array) -> Array:
        """Return the same for (N,) walks, (N, 4)."""
        read = self._stationary(walks) @ READ
        return np.hstack([np.zeros((len(walks), 1)), read / (read @ READ + self.R)[:, None]])


def of_state(gain: Array) -> Array:
    """Return a gain of [omega, w, T_L] as one of x: the torque stays."""
    return np.concatenate(([0.0], gain))


def kalman_model(
    plant: PredictorPlant, period_s: float, speed_noise_rad_s: float, torque_noise_nm: float
) -> KalmanModel:
    """Make the model. ``torque_noise_nm``: rms difference between the torque of a period and its command."""
    from scipy.linalg import expm  # as above

    unsure = np.ix_(_UNSURE, _UNSURE)
    A = plant.A[unsure]
    n = len(A)
    walk = np.zeros((n, n))
    walk[-1, -1] = 1.0
    # Van Loan, IEEE Trans. Autom. Control 23(3), 1978
    M = np.block([[-A, walk], [np.zeros((n, n)), A.T]])
    # of a part of the period, then doubled: where the filter forgets within one, M alone grows beyond double
    halvings = max(0, math.ceil(math.log2(max(period_s * float(np.linalg.norm(A, 2)), 1.0))))
    total = expm(M * (period_s / 2.0**halvings))
    Phi = total[n:, n:].T
    added = Phi @ total[:n, n:]
    for _ in range(halvings):
        added = added + Phi @ added @ Phi.T
        Phi = Phi @ Phi
    held = torque_noise_nm * np.append(Phi[:2, 2], 0.0)
    return KalmanModel(Phi, np.outer(held, held), 0.5 * (added + added.T), speed_noise_rad_s**2)


def encoder_noise_rad_s(counts_per_revolution: int, filter_hz: float, rate_hz: float) -> float:
    """Return the rms that the rounding of a count adds to a filtered speed.

    Each count has an error spread evenly over one count; their difference over a tick goes through the filter
    a (1 - z^-1)/(1 - (1 - a) z^-1), whose impulse response has the square sum 2 a^2/(2 - a).
    """
    a = 1.0 / (1.0 + rate_hz / (math.tau * filter_hz))
    rounding_rad = math.tau / counts_per_revolution / math.sqrt(12.0)
    return rounding_rad * rate_hz * a * math.sqrt(2.0 / (2.0 - a))


def plant_of(motor: PmsmParameters, current_rate_rad_s: float, filter_hz: float) -> PredictorPlant:
    """Return the plant of a motor behind a drive."""
    return PredictorPlant(
        motor.inertia_kg_m2, motor.viscous_friction_nm_s, current_rate_rad_s, math.tau * filter_hz
    )
