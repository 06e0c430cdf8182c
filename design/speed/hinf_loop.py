"""A conditioned controller's loop as it runs: sampled, held, with a delay that is no whole period.

    xi = [T, omega, w | u in force | b_1 .. b_n | x_c]        b_1: the newest command, b_2 the one before ...

A sample is taken: its command is b_1, and the controller advances. r into the period the command of m periods
ago begins to act, tau = m h + r. The plant may be another than that of the design, and so may its delay.
"""

import math
from collections.abc import Sequence

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.hinf.margins import Margins
from servobench.design.sampled.held_loop import Operation
from servobench.design.speed.conditioned import Conditioned
from servobench.design.speed.plant_loop import INPUT, PlantLoop, split
from servobench.design.speed.predictor_plant import FILTERED, LOAD, SPEED, PredictorPlant
from servobench.design.speed.predictor_trial import WITHIN

_BUFFER = INPUT + 1


class HinfLoop(PlantLoop):
    """The loop of ``controller`` around ``plant``, whose commands act ``delay_s`` after their samples."""

    def __init__(self, controller: Conditioned, plant: PredictorPlant, delay_s: float) -> None:
        self.controller = controller
        self.first_state = _BUFFER + split(delay_s, controller.period_s)[0] + 1
        """Place of x_c in xi."""
        size = self.first_state + controller.order
        super().__init__(plant, controller.period_s, delay_s, _BUFFER, size)

    def chain(self) -> list[Operation]:
        """Return a period that begins with a sample."""
        return self.period(self._sampled())

    def _sampled(self) -> Array:
        J, c, at = np.eye(self.size), self.controller, self.first_state
        J[_BUFFER:] = 0.0
        J[_BUFFER, FILTERED], J[_BUFFER, at:] = -c.D, c.C
        for place in range(_BUFFER + 1, at):
            J[place, place - 1] = 1.0
        J[at:, FILTERED], J[at:, at:] = -(c.B + c.L * c.D), c.A + np.outer(c.L, c.C)
        return J

    def spectral_radius(self) -> float:
        """Return the largest magnitude of a pole."""
        return float(np.max(np.abs(np.linalg.eigvals(self.transition(self.chain())))))

    def torque_noise_nm(self, speed_noise_rad_s: float) -> float:
        """Return the rms of the command caused by white noise on each sample; inf if unstable."""
        if self.spectral_radius() >= 1.0:
            return math.inf
        noise = self._sampled()[:, FILTERED] * speed_noise_rad_s
        noise[:_BUFFER] = 0.0
        return self.command_rms_nm(self.chain(), np.outer(noise, noise))

    def margins(self) -> Margins:
        """Return the margins of the loop cut where commands begin to act, between samples of the plant."""
        return self.margins_with(self.controller.K)

    def load_steps(self, load_nm: float, periods: int, phases: Sequence[float], lost: int = 0) -> Array:
        """Return (instants, phases) speeds of the shaft, four a period and where commands begin to act.

        From rest; the load comes a phase of a period after a sample. The first ``lost`` samples after it are
        lost, so that the last one before it is held.
        """
        h, c, behind, acts_s = self.period_s, self.controller, self.behind, self.acts_s
        x = np.zeros((LOAD + 1, len(phases)))
        for place, phase in enumerate(phases):
            x[:, place] = self.plant.step((1.0 - phase) * h)[0][:, LOAD] * load_nm
        state = np.zeros((c.order, len(phases)))
        sent = [np.zeros(len(phases))] * (behind + 2)
        instants = {h * (part + 1) / WITHIN for part in range(WITHIN)} | ({acts_s} if acts_s else set())
        looks = [self.plant.look(acts_s, at_s) for at_s in sorted(instants)]
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
