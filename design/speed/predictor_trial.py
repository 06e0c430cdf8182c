"""A load step on a predictor's loop with adaptive gains: lost samples, and detected steps.

The filter here uses numpy matrices, that of a drive's host scalars (hil/control/load_filter.py): tests
compare the two.
"""

from dataclasses import dataclass

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.speed.plant_loop import split
from servobench.design.speed.predictor_loop import Prediction
from servobench.design.speed.predictor_plant import (
    FILTERED,
    LOAD,
    READ,
    SPEED,
    STATES,
    KalmanModel,
    PredictorPlant,
    of_state,
)

STEP_SIGMAS = 1.5
"""Innovation, in standard deviations, taken for a step of the load."""
WITHIN = 4
"""Instants of a period at which the shaft is evaluated."""


@dataclass(frozen=True, slots=True, eq=False)
class Walks:
    """The two intensities of the load's walk, N m per root of s."""

    quiet: float
    bold: float
    """Walk of the filter whose covariance is taken over when a step is seen."""


class _Known:
    """Covariances before a sample, and what follows from them: trials of one filter meet the same again."""

    def __init__(self, model: KalmanModel, walks: Walks, quiet: Array, bold: Array) -> None:
        self._model, self._walks = model, walks
        self._quiet, self._bold = quiet, bold
        self._later: dict[bool | None, tuple[Array, _Known]] = {}
        self.spread = float(READ @ quiet @ READ) + model.R
        """Variance of the innovation."""

    def after(self, step: bool | None) -> tuple[Array, "_Known"]:
        """Return L (4,) and the covariances a period later. ``step``: one was seen; None: the sample is
        lost."""
        if step not in self._later:
            model, quiet = self._model, self._bold if step else self._quiet
            bold, L = self._bold, of_state(model.gain(quiet))
            if step is not None:
                quiet, bold = model.corrected(quiet), model.corrected(bold)
            self._later[step] = L, _predicted(model, self._walks, quiet, bold)
        return self._later[step]


def _predicted(model: KalmanModel, walks: Walks, quiet: Array, bold: Array) -> _Known:
    """Return what is known a period after two covariances."""
    return _Known(model, walks, model.predicted(quiet, walks.quiet), model.predicted(bold, walks.bold))


class AdaptiveFilter:
    """The gains of each sample."""

    def __init__(self, model: KalmanModel, walks: Walks) -> None:
        self._begin = _predicted(model, walks, model.settled(walks.quiet), model.settled(walks.bold))
        self.begin()

    def begin(self) -> None:
        """Begin anew, where every sample came before."""
        self._known = self._begin
        self.steps_seen = 0

    def lose(self) -> None:
        """Advance by a period whose sample is lost."""
        _, self._known = self._known.after(None)

    def correct(self, innovation: float) -> Array:
        """Return L (4,) for a sample with this innovation, rad/s, and advance by a period."""
        step = innovation * innovation > STEP_SIGMAS**2 * self._known.spread
        self.steps_seen += step
        L, self._known = self._known.after(step)
        return L


@dataclass(frozen=True, slots=True, eq=False)
class LoadTrial:
    """Result of a run."""

    speeds_rad_s: Array
    """(n,) speeds of the shaft, four a period."""
    commands_nm: Array
    """(k,) one for each sample."""
    steps_seen: int

    @property
    def peak_rad_s(self) -> float:
        """Largest deviation."""
        return float(np.max(np.abs(self.speeds_rad_s)))


def load_step(
    prediction: Prediction,
    filtering: AdaptiveFilter,
    load_nm: float,
    periods: int,
    *,
    phase: float = 0.0,
    plant: PredictorPlant | None = None,
    delay_s: float | None = None,
    noise_rad_s: Array | None = None,
    lost: frozenset[int] = frozenset(),
) -> LoadTrial:
    """Simulate a load step from rest; the load comes ``phase`` of a period after a sample, the next being
    number 0.

    ``plant``, ``delay_s``: the real ones, if they are not the predictor's; ``noise_rad_s``: (periods,) on the
    samples; ``lost``: numbers of the lost ones.
    """
    own, h = prediction.plant, prediction.period_s
    real = plant or own
    whole, rest_s = split(prediction.delay_s, h)
    behind, acts_s = split(prediction.delay_s if delay_s is None else delay_s, h)
    before, after, full = own.step(rest_s), own.step(h - rest_s), own.step(h)
    looks = [real.look(acts_s, h * (part + 1) / WITHIN) for part in range(WITHIN)]
    x, estimate = np.zeros(STATES), np.zeros(STATES)
    x[LOAD] = load_nm
    x = real.step((1.0 - phase) * h)[0] @ x
    sent = np.zeros(max(whole, behind) + 2)
    speeds, commands = [float(x[SPEED])], []
    for number in range(periods):
        if number in lost:
            filtering.lose()
        else:
            noise = 0.0 if noise_rad_s is None else float(noise_rad_s[number])
            innovation = float(x[FILTERED] - estimate[FILTERED]) + noise
            estimate = estimate + filtering.correct(innovation) * innovation
        ahead = before[0] @ estimate + before[1] * sent[whole]
        for place in range(whole - 1, -1, -1):
            ahead = full[0] @ ahead + full[1] * sent[place]
        sent = np.concatenate(([-float(prediction.F @ ahead)], sent[:-1]))
        commands.append(sent[0])
        for look in looks:
            y = look[0] @ x + look[1] * sent[behind + 1] + look[2] * sent[behind]
            speeds.append(float(y[SPEED]))
        x = y
        estimate = before[0] @ estimate + before[1] * sent[whole + 1]
        estimate = after[0] @ estimate + after[1] * sent[whole]
    return LoadTrial(np.array(speeds), np.array(commands), filtering.steps_seen)
