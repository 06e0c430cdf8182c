"""The loop of a controller with its own states around a predictor's plant: sampled and held.

    xi = [T, omega, w | u in force | ...]        in the rest b_1: the newest command, b_2 the one before ...

A sample is taken and handed to the controller. r into the period the command of m periods ago begins to act;
tau = m h + r is the delay.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.hinf.margins import Margins, margins_of
from servobench.design.sampled.held_loop import Flow, HeldInput, Jump, Operation
from servobench.design.sampled.lifting import lifted_gain
from servobench.design.speed.predictor_plant import FILTERED, LOAD, PredictorPlant
from servobench.design.statespace import ComplexArray, StateSpace

SHAFT = 3
"""States of the plant: T, omega, w."""
INPUT = SHAFT
"""Place of the command in force in xi."""
_WHOLE = 1e-9
"""Share of a period: a quotient of two times in double precision is off by 1e-16 of itself, and no period by
as much."""
_SEARCH = 20
"""Steps of a period in which a delay margin is sought."""


def split(delay_s: float, period_s: float) -> tuple[int, float]:
    """Return m and r of tau = m h + r, 0 <= r < h."""
    whole = math.floor(delay_s / period_s + _WHOLE)
    return whole, max(0.0, delay_s - whole * period_s)


class PlantLoop(HeldInput):
    """A loop around ``plant``, whose commands act ``delay_s`` after their samples."""

    def __init__(
        self, plant: PredictorPlant, period_s: float, delay_s: float, first_command: int, size: int
    ) -> None:
        """``first_command``: place of b_1 in xi; ``size``: length of xi."""
        self.plant, self.period_s, self.delay_s = plant, period_s, delay_s
        self.first_command = first_command
        self.behind, self.acts_s = split(delay_s, period_s)
        A, B = plant.A[:SHAFT, :SHAFT], plant.B[:SHAFT]
        model = SpeedModel(A, B, plant.A[:SHAFT, LOAD], np.array([0.0, 1.0, 0.0]), np.array([0.05, 1.0, 1.0]))
        super().__init__(model, size, size)

    def period(self, sampled: Array) -> list[Operation]:
        """Return a period that begins with the jump ``sampled``."""
        acting = np.eye(self.size)
        acting[INPUT] = 0.0
        acting[INPUT, self.first_command + self.behind] = 1.0
        return [Jump(sampled), Flow(self.acts_s), Jump(acting), Flow(self.period_s - self.acts_s)]

    def gain(self, chain: Sequence[Operation]) -> float:
        """Return the L2 gain from load torque to speed, rad/s per N m, of the loop that repeats ``chain``;
        inf if unstable."""
        return lifted_gain(self, chain)

    def command_rms_nm(self, chain: Sequence[Operation], added: Array) -> float:
        """Return the command's rms in the loop that repeats ``chain``, whose first jump adds noise of
        covariance ``added``."""
        X = scipy.linalg.solve_discrete_lyapunov(self.transition([*chain[1:], chain[0]]), added)
        return math.sqrt(X[self.first_command, self.first_command])

    def margins_with(self, K: StateSpace) -> Margins:
        """Return the margins of the loop cut where commands begin to act, between samples of the plant; K:
        error to command."""
        h = self.period_s
        before, after = self.plant.step(self.acts_s), self.plant.step(h - self.acts_s)
        late, early = (after[0] @ before[1])[:SHAFT], after[1][:SHAFT]
        P = self.plant.step(h)[0][:SHAFT, :SHAFT]

        def response(omega: Array) -> ComplexArray:
            z = np.exp(1j * omega * h)[:, None, None]
            column = (late + z[:, :, 0] * early)[:, :, None]  # of u a period ago, and of u
            shaft = np.linalg.solve(z * np.eye(SHAFT) - P, column)[:, FILTERED, 0]
            return np.asarray(K.response(omega)[:, 0, 0] * shaft / z[:, 0, 0] ** (self.behind + 1))

        return margins_of(response, 1e-4 / h, math.pi / h)

    def _flow(self, length_s: float) -> Array:
        total = np.eye(self.size)
        A, B = self.plant.step(length_s)
        total[:SHAFT, :SHAFT], total[:SHAFT, INPUT] = A[:SHAFT, :SHAFT], B[:SHAFT]
        return total


def later_s(stable: Callable[[float], bool], delay_s: float, period_s: float) -> float:
    """Return how much longer a delay may be with the loop still ``stable``, rounded down to a twentieth of a
    period."""
    step_s = period_s / _SEARCH
    most = round((delay_s + 5.0 * period_s) / step_s)
    unstable = (more for more in range(1, most) if not stable(delay_s + more * step_s))
    return (next(unstable, most + 1) - 1) * step_s
