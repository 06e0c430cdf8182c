"""A predictor's loop with constant gains, as it runs: sampled, held, with a delay that is no whole period.

    xi = [T, omega, w | u in force | x^ | b_1 .. b_n]        b_1: the newest command, b_2 the one before ...

A sample is taken: x^ is corrected, predicted over the delay and fed back; the commands move on. r into the
period the command of m periods ago begins to act, tau = m h + r. At the end of the period x^ follows.
The plant may be another than the predictor's, and so may its delay.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from design.delay.delay_loop import Array
from design.delay.speed_loop import SpeedModel
from design.hinf.margins import Margins, margins_of
from design.sampled.held_loop import Flow, Jump, Operation
from design.sampled.lifting import discrete_norm, lifted
from design.speed.predictor_plant import FILTERED, LOAD, STATES, PredictorPlant
from design.statespace import ComplexArray

_SHAFT = 3
"""States of the plant: T, omega, w."""
_INPUT, _OBSERVER = _SHAFT, _SHAFT + 1
_BUFFER = _OBSERVER + STATES
_WHOLE = 1e-9
_STEADY = 1.0 - 1e-9
_SEARCH = 20
"""Steps of a period in which the delay margin is sought."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """What a predictor reckons with."""

    plant: PredictorPlant
    period_s: float
    delay_s: float
    """tau: from a sample to the voltage that its command makes."""
    F: Array
    """(4,): u = -F x^."""


def split(delay_s: float, period_s: float) -> tuple[int, float]:
    """m and r of tau = m h + r, 0 <= r < h."""
    whole = math.floor(delay_s / period_s + _WHOLE)
    return whole, max(0.0, delay_s - whole * period_s)


class PredictorLoop:
    """The loop around ``plant``, whose commands act ``delay_s`` after their samples."""

    def __init__(
        self, prediction: Prediction, plant: PredictorPlant | None = None, delay_s: float | None = None
    ) -> None:
        self.prediction = prediction
        self.plant = plant or prediction.plant
        self._whole, self._rest_s = split(prediction.delay_s, prediction.period_s)
        self._acts_behind, self._acts_s = split(
            prediction.delay_s if delay_s is None else delay_s, prediction.period_s
        )
        self.size = _BUFFER + max(self._whole, self._acts_behind) + 2
        self.kept = self.size
        A, B = self.plant.A[:_SHAFT, :_SHAFT], self.plant.B[:_SHAFT]
        load = self.plant.A[:_SHAFT, LOAD]
        self.model = SpeedModel(A, B, load, np.array([0.0, 1.0, 0.0]), np.array([0.05, 1.0, 1.0]))
        self._state_ahead, self._commands_ahead = self._ahead()
        lost = self.chain(None)
        self._uncorrected = self.transition(lost)
        self._entering = np.zeros((self.size, STATES))
        """What a correction adds to xi behind its jump, of each entry of x^."""
        self._entering[_OBSERVER:_BUFFER] = np.eye(STATES)
        self._entering[_BUFFER] = -prediction.F @ self._state_ahead
        self._entered = self.transition(lost[1:]) @ self._entering

    def chain(self, L: Array | None) -> list[Operation]:
        """A period that begins with a sample of gain L (4,); None: with a lost one."""
        rest_s = self.prediction.period_s - self._acts_s
        return [
            Jump(self._sampled(np.zeros(STATES) if L is None else L)),
            Flow(self._acts_s),
            Jump(self._acting()),
            Flow(rest_s),
            Jump(self._followed()),
        ]

    def transition(self, chain: Sequence[Operation]) -> Array:
        """The product of a chain, (size, size)."""
        total = np.eye(self.size)
        for operation in chain:
            total = (operation.J if isinstance(operation, Jump) else self._flow(operation.length_s)) @ total
        return total

    def is_stable(self, L: Array) -> bool:
        """With every sample."""
        return bool(np.max(np.abs(np.linalg.eigvals(self._closed(L)))) < _STEADY)

    def _closed(self, L: Array) -> Array:
        """The product of ``chain(L)``: it is linear in L."""
        return np.asarray(self._uncorrected + np.outer(self._entered @ L, self._read))

    @property
    def _read(self) -> Array:
        read = np.zeros(self.size)
        read[FILTERED], read[_OBSERVER + FILTERED] = 1.0, -1.0
        return read

    def torque_noise_nm(self, L: Array, speed_noise_rad_s: float) -> float:
        """Rms of the command by white noise on each sample; inf if unstable."""
        if not self.is_stable(L):
            return math.inf
        chain, noise = self.chain(L), self._entering @ L
        X = scipy.linalg.solve_discrete_lyapunov(
            self.transition([*chain[1:], chain[0]]), np.outer(noise, noise) * speed_noise_rad_s**2
        )
        return math.sqrt(X[_BUFFER, _BUFFER])

    def gain(self, chain: Sequence[Operation]) -> float:
        """L2 gain from load torque to speed, rad/s per N m, of the loop that repeats ``chain``; inf if
        unstable."""
        return discrete_norm(lifted(self, chain))

    def margins(self, L: Array) -> Margins:
        """Of the loop cut where commands begin to act, between samples of the plant."""
        h = self.prediction.period_s
        C, b, c, d = self._controller(L)
        P, B = self.plant.step(h)[0][:_SHAFT, :_SHAFT], self._held()

        def response(omega: Array) -> ComplexArray:
            z = np.exp(1j * omega * h)[:, None, None]
            inner = np.linalg.solve(z * np.eye(len(C)) - C, np.broadcast_to(b[:, None], (len(z), len(C), 1)))
            controller = (c @ inner)[:, 0] + d
            late, early = B
            column = (late + z[:, :, 0] * early)[:, :, None]  # of u a period ago, and of u
            shaft = np.linalg.solve(z * np.eye(_SHAFT) - P, column)[:, FILTERED, 0]
            return np.asarray(-controller * shaft / z[:, 0, 0] ** (self._acts_behind + 1))

        return margins_of(response, 1e-4 / h, math.pi / h)

    def _controller(self, L: Array) -> tuple[Array, Array, Array, float]:
        """A, b, c, d from a sample to its command; state: x^ as predicted to the sample, and the commands."""
        jump, follow = self._sampled(L)[_OBSERVER:, :], self._followed()[_OBSERVER:, _OBSERVER:]
        A, b = jump[:, _OBSERVER:], jump[:, FILTERED]
        place = STATES  # of b_1
        return follow @ A, follow @ b, A[place], float(b[place])

    def _held(self) -> tuple[Array, Array]:
        """What of a period's commands the shaft keeps: of the one in force before, and of the one after."""
        before, after = (
            self.plant.step(self._acts_s),
            self.plant.step(self.prediction.period_s - self._acts_s),
        )
        return (after[0] @ before[1])[:_SHAFT], after[1][:_SHAFT]

    def _ahead(self) -> tuple[Array, Array]:
        """From x^ (4, 4) and the commands before the new one (4, n) to the state at its instant."""
        plant, h = self.prediction.plant, self.prediction.period_s
        commands = np.zeros((STATES, self.size - _BUFFER))
        first, entered = plant.step(self._rest_s)
        commands[:, self._whole] = entered
        whole, entered = plant.step(h)
        for place in range(self._whole - 1, -1, -1):
            first, commands = whole @ first, whole @ commands
            commands[:, place] += entered
        return first, commands

    def _sampled(self, L: Array) -> Array:
        J = np.eye(self.size)
        J[_OBSERVER:_BUFFER] += np.outer(L, self._read)
        state, commands = self._state_ahead, self._commands_ahead
        J[_BUFFER:] = 0.0
        J[_BUFFER] = -self.prediction.F @ state @ J[_OBSERVER:_BUFFER]
        J[_BUFFER, _BUFFER:] -= self.prediction.F @ commands
        for place in range(_BUFFER + 1, self.size):
            J[place, place - 1] = 1.0
        return J

    def _acting(self) -> Array:
        J = np.eye(self.size)
        J[_INPUT] = 0.0
        J[_INPUT, _BUFFER + self._acts_behind] = 1.0
        return J

    def _followed(self) -> Array:
        plant, h = self.prediction.plant, self.prediction.period_s
        before, after = plant.step(self._rest_s), plant.step(h - self._rest_s)
        J = np.eye(self.size)
        J[_OBSERVER:_BUFFER, _OBSERVER:_BUFFER] = after[0] @ before[0]
        J[_OBSERVER:_BUFFER, _BUFFER + self._whole] += after[1]
        J[_OBSERVER:_BUFFER, _BUFFER + self._whole + 1] += after[0] @ before[1]
        return J

    def _flow(self, length_s: float) -> Array:
        total = np.eye(self.size)
        A, B = self.plant.step(length_s)
        total[:_SHAFT, :_SHAFT], total[:_SHAFT, _INPUT] = A[:_SHAFT, :_SHAFT], B[:_SHAFT]
        return total


def delay_margin_s(prediction: Prediction, L: Array) -> float:
    """What the delay may be longer than the predictor reckons, to a twentieth of a period below."""
    step_s = prediction.period_s / _SEARCH
    most = round((prediction.delay_s + 5.0 * prediction.period_s) / step_s)
    for more in range(1, most):
        if not PredictorLoop(prediction, delay_s=prediction.delay_s + more * step_s).is_stable(L):
            return (more - 1) * step_s
    return most * step_s
