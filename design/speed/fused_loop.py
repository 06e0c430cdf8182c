"""The loop of a predictor on count and speed: sampled, held, with a delay that is no whole period.

    xi = [T, omega, w, angle | u in force | x^ | b_1 .. b_n]    b_1: the newest command, b_2 the one before

The angle is that of the shaft beyond the estimated one: neither alone matters, and neither returns. A sample
is taken: x^ = [T, omega, w, T_L] and the angle are corrected, x^ is predicted over the delay and fed back. r
into the period the command of m periods ago begins to act, tau = m h + r. At the end of the period x^
follows. The plant may be another than the predictor's, and so may its delay.
"""

import math
from functools import cache

import numpy as np
import scipy.linalg

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.hinf.margins import Margins, margins_of
from servobench.design.sampled.held_loop import Flow, HeldInput, Jump, Operation
from servobench.design.sampled.lifting import lifted_gain
from servobench.design.speed.plant_loop import split
from servobench.design.speed.predictor_loop import Prediction
from servobench.design.speed.predictor_plant import FILTERED, LOAD, SPEED, STATES, PredictorPlant
from servobench.design.statespace import ComplexArray

_SHAFT = 4
_ANGLE, _INPUT, _STATE = 3, _SHAFT, _SHAFT + 1
_BUFFER = _STATE + STATES
_STABLE = 1.0 - 1e-9
_CORRECTED = (_STATE + SPEED, _STATE + FILTERED, _ANGLE, _STATE + LOAD)
"""Places of the corrections of [omega, w, angle, T_L]."""
WITHIN = 8
"""Instants of a period at which the shaft is evaluated."""


@cache
def _generator(plant: PredictorPlant) -> Array:
    """Return A (6, 6) of [T, omega, w, angle, u, T_L]."""
    A = np.zeros((6, 6))
    A[:3, :3], A[:3, 4], A[:3, 5] = plant.A[:3, :3], plant.B[:3], plant.A[:3, LOAD]
    A[_ANGLE, SPEED] = 1.0
    return A


@cache
def _moved(plant: PredictorPlant, length_s: float) -> Array:
    return np.asarray(scipy.linalg.expm(_generator(plant) * length_s))


class FusedLoop(HeldInput):
    """The loop around ``plant``, whose commands act ``delay_s`` after their samples."""

    first_command = _BUFFER
    """Place of b_1 in xi."""

    def __init__(
        self, prediction: Prediction, plant: PredictorPlant | None = None, delay_s: float | None = None
    ) -> None:
        self.prediction, self.plant = prediction, plant or prediction.plant
        h = self.period_s = prediction.period_s
        self._whole, self._rest_s = split(prediction.delay_s, h)
        self._behind, self._acts_s = split(prediction.delay_s if delay_s is None else delay_s, h)
        size = _BUFFER + max(self._whole, self._behind) + 2
        A = _generator(self.plant)
        scale = np.array([0.05, 1.0, 1.0, 1e-3])
        model = SpeedModel(A[:4, :4], A[:4, 4], A[:4, 5], np.array([0.0, 1.0, 0.0, 0.0]), scale)
        super().__init__(model, size, size)
        self._read = np.zeros((2, size))
        self._read[0, _ANGLE] = 1.0
        self._read[1, FILTERED], self._read[1, _STATE + FILTERED] = 1.0, -1.0
        self._acting = np.eye(size)
        self._acting[_INPUT] = 0.0
        self._acting[_INPUT, _BUFFER + self._behind] = 1.0
        self._followed = self._follow()
        self._decided = self._decide()

    def chain(self, L: Array | None) -> list[Operation]:
        """Return a period that begins with a sample of gain L (4, 2); None: with a lost one."""
        return [
            Jump(self._sampled(L)),
            Flow(self._acts_s),
            Jump(self._acting),
            Flow(self.period_s - self._acts_s),
            Jump(self._followed),
        ]

    def radius(self, L: Array) -> float:
        """Return the spectral radius of a period, every sample received."""
        return float(np.max(np.abs(np.linalg.eigvals(self.transition(self.chain(L))))))

    def is_stable(self, L: Array) -> bool:
        """Return True if the loop is stable with every sample received."""
        return self.radius(L) < _STABLE

    def gain(self, L: Array) -> float:
        """Return the L2 gain from load torque to speed, rad/s per N m; inf if unstable."""
        return lifted_gain(self, self.chain(L))

    def noise(self, L: Array, R: Array) -> tuple[float, float]:
        """Return the rms of command, N m, and speed, rad/s, by noise of covariance R on each sample; inf if
        unstable."""
        if not self.is_stable(L):
            return math.inf, math.inf
        first, *rest = self.chain(L)
        noise = self._decided @ self._correction(L)
        assert isinstance(first, Jump)
        X = scipy.linalg.solve_discrete_lyapunov(self.transition([*rest, first]), noise @ R @ noise.T)
        return math.sqrt(X[_BUFFER, _BUFFER]), math.sqrt(X[SPEED, SPEED])

    def margins(self, L: Array) -> Margins:
        """Return the margins of the loop cut where commands begin to act."""
        sampled, before, _, after, followed = self.chain(L)
        freed = np.eye(self.size)
        freed[_INPUT] = 0.0
        open_loop = self.transition([after, followed, sampled, before])
        A, B, C = open_loop @ freed, open_loop[:, _INPUT], np.eye(self.size)[_BUFFER + self._behind]

        def response(omega: Array) -> ComplexArray:
            z = np.exp(1j * omega * self.period_s)[:, None, None]
            states = np.linalg.solve(
                z * np.eye(self.size) - A, np.broadcast_to(B[:, None], (*z.shape[:1], len(B), 1))
            )
            return np.asarray(-(states[:, :, 0] @ C))

        return margins_of(response, 1e-4 / self.period_s, math.pi / self.period_s)

    def peaks(self, gains: list[Array], load_nm: float, phases: Array, periods: int, lost: int = 0) -> Array:
        """Return (n,) the largest deviations of the speed after a load step from rest, rad/s.

        ``phases``: (n,) of a period after a sample, the next being number 0; ``lost``: samples lost from that
        on.
        """
        h, size = self.period_s, self.size
        X = np.zeros((size + 1, len(phases)))
        X[size] = load_nm
        for column, phase in enumerate(phases):
            X[:, column] = self._loaded((1.0 - phase) * h) @ X[:, column]
        peaks = np.abs(X[SPEED])
        grids = {id(L): self._grid(L) for L in (None, gains[0], gains[min(lost, len(gains) - 1)])}
        for number in range(periods):
            L = None if number < lost else gains[min(lost, len(gains) - 1) if number == lost else 0]
            looks, whole = grids[id(L)]
            peaks = np.maximum(peaks, np.abs(looks @ X).max(axis=0))
            X = whole @ X
        return np.asarray(peaks)

    def _grid(self, L: Array | None) -> tuple[Array, Array]:
        """Return the speeds (WITHIN, size + 1) within a period, and its whole map, of xi and the load."""
        h, acts_s = self.period_s, self._acts_s
        sampled, acting, followed = (_with_load(J) for J in (self._sampled(L), self._acting, self._followed))
        begun = acting @ self._loaded(acts_s) @ sampled
        looks = []
        for part in range(1, WITHIN + 1):
            at_s = h * part / WITHIN
            early = at_s <= acts_s
            moved = self._loaded(at_s) @ sampled if early else self._loaded(at_s - acts_s) @ begun
            looks.append(moved[SPEED])
        return np.array(looks), followed @ self._loaded(h - acts_s) @ begun

    def _loaded(self, length_s: float) -> Array:
        total = np.eye(self.size + 1)
        moved = _moved(self.plant, length_s)
        total[:5, :5], total[:5, self.size] = moved[:5, :5], moved[:5, 5]
        return total

    def _flow(self, length_s: float) -> Array:
        total = np.eye(self.size)
        total[:5, :5] = _moved(self.plant, length_s)[:5, :5]
        return total

    def _correction(self, L: Array) -> Array:
        """Return (size, 2): what a sample's innovation, or its noise, adds to xi before the command."""
        entering = np.zeros((self.size, 2))
        entering[list(_CORRECTED)] = L
        entering[_ANGLE] *= -1.0
        return entering

    def _sampled(self, L: Array | None) -> Array:
        if L is None:
            return self._decided
        return np.asarray(self._decided @ (np.eye(self.size) + self._correction(L) @ self._read))

    def _decide(self) -> Array:
        """Return the jump of a command: x^ predicted over the delay and fed back; the others move on."""
        plant, h, F = self.prediction.plant, self.period_s, self.prediction.F
        ahead = np.zeros((STATES, self.size))
        first, entered = plant.step(self._rest_s)
        ahead[:, _STATE:_BUFFER] = first
        ahead[:, _BUFFER + self._whole] = entered
        whole, entered = plant.step(h)
        for place in range(self._whole - 1, -1, -1):
            ahead = whole @ ahead
            ahead[:, _BUFFER + place] += entered
        J = np.eye(self.size)
        J[_BUFFER] = -F @ ahead
        for place in range(_BUFFER + 1, self.size):
            J[place] = np.eye(self.size)[place - 1]
        return J

    def _follow(self) -> Array:
        """Return the jump at a period's end: x^ follows, and the estimated angle with it."""
        plant, h = self.prediction.plant, self.period_s
        moved = np.zeros((6, self.size))  # of [T, omega, w, angle, u, T_L]
        moved[:3, _STATE : _STATE + 3], moved[5, _STATE + LOAD] = np.eye(3), 1.0
        for length_s, place in ((self._rest_s, self._whole + 1), (h - self._rest_s, self._whole)):
            moved[4] = np.eye(self.size)[_BUFFER + place]
            moved = _moved(plant, length_s) @ moved
        J = np.eye(self.size)
        J[_STATE : _STATE + 3], J[_STATE + LOAD] = moved[:3], moved[5]
        J[_ANGLE] -= moved[_ANGLE]
        return J


def _with_load(J: Array) -> Array:
    larger = np.eye(len(J) + 1)
    larger[:-1, :-1] = J
    return larger
