"""How low the peak after a load step can be where the reading has noise: a bound by estimation theory.

A command is a function of the readings before it. Without a step its rms is n at most; let r be the density
of the readings under a step of +L over that without one, r' that under -L. Then the mean of the command under
a step, of the two signs the worse, is at most

    E[u (r - r')/2] <= n sqrt(E[(r - r')^2]/4) = n sqrt(sinh d^2)

by Cauchy and Schwarz (the bound of Hammersley, Chapman and Robbins); d^2 is the sum of the squares of what
the step has done to each reading over its noise, white and Gaussian. The shaft is linear, and a larger torque
against the load leaves a smaller error at each instant: so the mean peak is at least the peak under these
largest means. State, instant and size of the step count as known, so no controller with that much noise in
its torque peaks less in the mean, however it is made.
"""

import math
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.speed.predictor_plant import FILTERED, LOAD, SPEED, STATES, PredictorPlant

_PARTS = 16
"""Instants of a period at which the shaft is looked at."""
_ANY = 20.0
"""A command of so many times the load is as good as any."""


@dataclass(frozen=True, slots=True)
class NoisyStep:
    """A step of the load, and what a controller of it has and may do."""

    plant: PredictorPlant
    period_s: float
    delay_s: float
    """From a sample to the voltage of its command."""
    load_nm: float
    speed_noise_rad_s: float
    command_noise_nm: float
    """Rms of the command where no step comes."""

    def least_peak_rad_s(self, phase: float) -> float:
        """Return the bound of the mean peak, where the step comes ``phase`` of a period after a sample."""
        until_s = (1.0 - phase) * self.period_s
        x = np.zeros(STATES)
        x[LOAD] = self.load_nm
        seen, command = 0.0, 0.0
        read = self._moved(x, 0.0, until_s)
        x = self._moved(x, 0.0, until_s + self.delay_s)
        largest = -float(x[SPEED])
        while command < _ANY * self.load_nm:
            seen += (float(read[FILTERED]) / self.speed_noise_rad_s) ** 2
            command = min(self.command_noise_nm * math.sqrt(math.sinh(min(seen, 300.0))), _ANY * self.load_nm)
            # what commands do to a reading is known, and so no part of what it tells
            read = self._moved(read, 0.0, self.period_s)
            for _ in range(_PARTS):
                x = self._moved(x, command, self.period_s / _PARTS)
                largest = max(largest, -float(x[SPEED]))
        return largest

    def _moved(self, x: Array, command_nm: float, length_s: float) -> Array:
        first, entered = self.plant.step(length_s)
        return np.asarray(first @ x + entered * command_nm)
