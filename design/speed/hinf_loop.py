"""A conditioned controller's loop as it runs: sampled, held, with a delay that is no whole period.

    xi = [T, omega, w | u in force | b_1 .. b_n | x_c]        b_1: the newest command, b_2 the one before ...

A sample is taken: its command is b_1, and the controller goes on. r into the period the command of m periods
ago begins to act, tau = m h + r. The plant may be another than that of the design, and so may its delay.
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
from design.speed.conditioned import Conditioned
from design.speed.predictor_loop import split
from design.speed.predictor_plant import FILTERED, LOAD, SPEED, PredictorPlant
from design.statespace import ComplexArray

_SHAFT = 3
_INPUT = _SHAFT
_BUFFER = _INPUT + 1
_WITHIN = 4
"""Instants of a period at which the shaft is looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class HinfLoop:
    """The loop of ``controller`` around ``plant``, whose commands act ``delay_s`` after their samples."""

    controller: Conditioned
    plant: PredictorPlant
    delay_s: float

    @property
    def model(self) -> SpeedModel:
        """Of the plant."""
        A, B = self.plant.A[:_SHAFT, :_SHAFT], self.plant.B[:_SHAFT]
        load = self.plant.A[:_SHAFT, LOAD]
        return SpeedModel(A, B, load, np.array([0.0, 1.0, 0.0]), np.array([0.05, 1.0, 1.0]))

    @property
    def size(self) -> int:
        """Of xi."""
        return self.first_state + self.controller.order

    @property
    def kept(self) -> int:
        """All of it matters."""
        return self.size

    @property
    def first_command(self) -> int:
        """Where b_1 stands in xi."""
        return _BUFFER

    @property
    def first_state(self) -> int:
        """Where x_c begins."""
        return _BUFFER + split(self.delay_s, self.controller.period_s)[0] + 1

    def chain(self) -> list[Operation]:
        """A period that begins with a sample."""
        behind, acts_s = split(self.delay_s, self.controller.period_s)
        acting = np.eye(self.size)
        acting[_INPUT] = 0.0
        acting[_INPUT, _BUFFER + behind] = 1.0
        return [Jump(self._sampled()), Flow(acts_s), Jump(acting), Flow(self.controller.period_s - acts_s)]

    def _sampled(self) -> Array:
        J, c, at = np.eye(self.size), self.controller, self.first_state
        J[_BUFFER:] = 0.0
        J[_BUFFER, FILTERED], J[_BUFFER, at:] = -c.D, c.C
        for place in range(_BUFFER + 1, at):
            J[place, place - 1] = 1.0
        J[at:, FILTERED], J[at:, at:] = -(c.B + c.L * c.D), c.A + np.outer(c.L, c.C)
        return J

    def transition(self) -> Array:
        """(size, size) over a period, from before a sample to before the next."""
        total = np.eye(self.size)
        for operation in self.chain():
            total = (operation.J if isinstance(operation, Jump) else self._flow(operation.length_s)) @ total
        return total

    def _flow(self, length_s: float) -> Array:
        total = np.eye(self.size)
        A, B = self.plant.step(length_s)
        total[:_SHAFT, :_SHAFT], total[:_SHAFT, _INPUT] = A[:_SHAFT, :_SHAFT], B[:_SHAFT]
        return total

    def spectral_radius(self) -> float:
        """Largest magnitude of a pole."""
        return float(np.max(np.abs(np.linalg.eigvals(self.transition()))))

    def torque_noise_nm(self, speed_noise_rad_s: float) -> float:
        """Rms of the command by white noise on each sample; inf if unstable."""
        if self.spectral_radius() >= 1.0:
            return math.inf
        sampled, *rest = self.chain()
        after = np.eye(self.size)
        for operation in rest:
            after = (operation.J if isinstance(operation, Jump) else self._flow(operation.length_s)) @ after
        assert isinstance(sampled, Jump)
        noise = sampled.J[:, FILTERED] * speed_noise_rad_s
        noise[:_BUFFER] = 0.0
        X = scipy.linalg.solve_discrete_lyapunov(sampled.J @ after, np.outer(noise, noise))
        return math.sqrt(X[_BUFFER, _BUFFER])

    def gain(self) -> float:
        """L2 gain from load torque to speed, rad/s per N m; inf if unstable."""
        return discrete_norm(lifted(self, self.chain()))

    def margins(self) -> Margins:
        """Of the loop cut where commands begin to act, between samples of the plant."""
        h, K = self.controller.period_s, self.controller.K
        behind, acts_s = split(self.delay_s, h)
        before, after = self.plant.step(acts_s), self.plant.step(h - acts_s)
        late, early = (after[0] @ before[1])[:_SHAFT], after[1][:_SHAFT]
        P = self.plant.step(h)[0][:_SHAFT, :_SHAFT]

        def response(omega: Array) -> ComplexArray:
            z = np.exp(1j * omega * h)[:, None, None]
            column = (late + z[:, :, 0] * early)[:, :, None]  # of u a period ago, and of u
            shaft = np.linalg.solve(z * np.eye(_SHAFT) - P, column)[:, FILTERED, 0]
            return np.asarray(K.response(omega)[:, 0, 0] * shaft / z[:, 0, 0] ** (behind + 1))

        return margins_of(response, 1e-4 / h, math.pi / h)

    def load_steps(self, load_nm: float, periods: int, phases: Sequence[float], lost: int = 0) -> Array:
        """(instants, phases) speeds of the shaft, four a period and where commands begin to act.

        From rest; the load comes a phase of a period after a sample. The first ``lost`` samples after it do
        not come, so that the last before it is held.
        """
        h, c = self.controller.period_s, self.controller
        behind, acts_s = split(self.delay_s, h)
        x = np.zeros((LOAD + 1, len(phases)))
        for place, phase in enumerate(phases):
            x[:, place] = self.plant.step((1.0 - phase) * h)[0][:, LOAD] * load_nm
        state = np.zeros((c.order, len(phases)))
        sent = [np.zeros(len(phases))] * (behind + 2)
        instants = {h * (part + 1) / _WITHIN for part in range(_WITHIN)} | ({acts_s} if acts_s else set())
        looks = [self._look(acts_s, at_s) for at_s in sorted(instants)]
        speeds = [x[SPEED]]
        for number in range(periods):
            error = np.zeros(len(phases)) if number < lost else -x[FILTERED]
            sent = [c.C @ state + c.D * error, *sent[:-1]]
            state = c.A @ state + np.outer(c.B, error) + np.outer(c.L, sent[0])
            ends = [
                first @ x + np.outer(held, sent[behind + 1]) + np.outer(entered, sent[behind])
                for first, held, entered in looks
            ]
            speeds += [end[SPEED] for end in ends]
            x = ends[-1]
        return np.array(speeds)

    def _look(self, acts_s: float, at_s: float) -> tuple[Array, Array, Array]:
        """The state ``at_s`` into a period, from that at its begin, the command before and the one after."""
        if at_s <= acts_s:
            first, held = self.plant.step(at_s)
            return first, held, np.zeros(LOAD + 1)
        (first, held), (second, entered) = self.plant.step(acts_s), self.plant.step(at_s - acts_s)
        return second @ first, second @ held, entered
