"""A predictor's loop with constant gains: sampled, held, with a delay that is no whole period.

    xi = [T, omega, w | u in force | x^ | b_1 .. b_n]        b_1: the newest command, b_2 the one before ...

A sample is taken: x^ is corrected, predicted over the delay and fed back; the commands move on. r into the
period the command of m periods ago begins to act, tau = m h + r. At the end of the period x^ follows.
The plant may be another than the predictor's, and so may its delay.

A load step on a predictor's loop with adaptive gains: lost samples, and detected steps.

The filter here uses numpy matrices, that of a drive's host scalars (hil/control/load_filter.py): tests
compare the two.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.hinf.margins import Margins
from servobench.design.sampled.held_loop import Jump, Operation
from servobench.design.speed.plant_loop import INPUT, PlantLoop, later_s, split
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
from servobench.design.statespace import StateSpace

_OBSERVER = INPUT + 1
_BUFFER = _OBSERVER + STATES
_DOUBLINGS, _SETTLED = 60, 1e-15
"""Doublings of the number of periods at most, and the relative change that ends them."""
_STEADY = 1.0 - 1e-9
"""A pole at 1, as of a load that nothing corrects, is found only to rounding errors."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The predictor's model."""

    plant: PredictorPlant
    period_s: float
    delay_s: float
    """tau: from a sample to the voltage caused by its command."""
    F: Array
    """(4,): u = -F x^."""


class PredictorLoop(PlantLoop):
    """The loop around ``plant``, whose commands act ``delay_s`` after their samples."""

    def __init__(
        self, prediction: Prediction, plant: PredictorPlant | None = None, delay_s: float | None = None
    ) -> None:
        h = prediction.period_s
        self.prediction = prediction
        self._whole, self._rest_s = split(prediction.delay_s, h)
        delay_s = prediction.delay_s if delay_s is None else delay_s
        size = _BUFFER + max(self._whole, split(delay_s, h)[0]) + 2
        super().__init__(plant or prediction.plant, h, delay_s, _BUFFER, size)
        self._read = np.zeros(self.size)
        self._read[FILTERED], self._read[_OBSERVER + FILTERED] = 1.0, -1.0
        self._state_ahead, self._commands_ahead = self._ahead()
        lost = self.chain(None)
        self._uncorrected = self.transition(lost)
        self._entering = np.zeros((self.size, STATES))
        """The addition of a correction to xi after its jump, for each entry of x^."""
        self._entering[_OBSERVER:_BUFFER] = np.eye(STATES)
        self._entering[_BUFFER] = -prediction.F @ self._state_ahead
        self._jump = self.transition(lost[:1])
        self._behind_jump = self.transition(lost[1:])
        self._entered = self._behind_jump @ self._entering

    def chain(self, L: Array | None) -> list[Operation]:
        """Return a period that begins with a sample of gain L (4,); None: with a lost one."""
        sampled = self._sampled(np.zeros(STATES) if L is None else L)
        return [*self.period(sampled), Jump(self._followed())]

    def is_stable(self, L: Array) -> bool:
        """Return True if the loop is stable with every sample received."""
        return bool(np.max(np.abs(np.linalg.eigvals(self._closed(L)))) < _STEADY)

    def _closed(self, L: Array) -> Array:
        """Return the product of ``chain(L)``: it is linear in L."""
        return np.asarray(self._uncorrected + np.outer(self._entered @ L, self.read))

    @property
    def read(self) -> Array:
        """The (size,) row of xi that is the innovation of a sample."""
        return self._read

    @property
    def closed_parts(self) -> tuple[Array, Array]:
        """The period without a sample (size, size), and what enters it for each entry of a gain (size, 4)."""
        return self._uncorrected, self._entered

    def torque_noise_nm(self, L: Array, speed_noise_rad_s: float) -> float:
        """Return the rms of the command caused by white noise on each sample; inf if unstable."""
        noise = self._entering @ L
        # behind the jump of a sample, which is that of a lost one and what the gain adds
        turned = (self._jump + np.outer(noise, self.read)) @ self._behind_jump
        if not float(np.max(np.abs(np.linalg.eigvals(turned)))) < _STEADY:
            return math.inf
        return speed_noise_rad_s * rms_at(self.first_command, turned, noise)

    def margins(self, L: Array) -> Margins:
        """Return the margins of the loop cut where commands begin to act, between samples of the plant."""
        return self.margins_with(self._controller(L))

    def _controller(self, L: Array) -> StateSpace:
        """Return the system from the speed error at a sample to its command; state: predicted x^, and the
        commands."""
        jump, follow = self._sampled(L)[_OBSERVER:, :], self._followed()[_OBSERVER:, _OBSERVER:]
        A, b = jump[:, _OBSERVER:], jump[:, [FILTERED]]
        newest = [STATES]  # b_1
        return StateSpace(follow @ A, follow @ b, -A[newest], -b[newest], self.period_s)

    def _ahead(self) -> tuple[Array, Array]:
        """Return the maps from x^ (4, 4) and the commands before the new one (4, n) to the state at its
        instant."""
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
        J[_OBSERVER:_BUFFER] += np.outer(L, self.read)
        state, commands = self._state_ahead, self._commands_ahead
        J[_BUFFER:] = 0.0
        J[_BUFFER] = -self.prediction.F @ state @ J[_OBSERVER:_BUFFER]
        J[_BUFFER, _BUFFER:] -= self.prediction.F @ commands
        for place in range(_BUFFER + 1, self.size):
            J[place, place - 1] = 1.0
        return J

    def _followed(self) -> Array:
        plant, h = self.prediction.plant, self.prediction.period_s
        before, after = plant.step(self._rest_s), plant.step(h - self._rest_s)
        J = np.eye(self.size)
        J[_OBSERVER:_BUFFER, _OBSERVER:_BUFFER] = after[0] @ before[0]
        J[_OBSERVER:_BUFFER, _BUFFER + self._whole] += after[1]
        J[_OBSERVER:_BUFFER, _BUFFER + self._whole + 1] += after[0] @ before[1]
        return J


def rms_at(place: int, A: Array, b: Array) -> float:
    """Return the rms of an entry of x, x+ = A x + b w, w white noise of 1, A stable.

    By doubling: from the covariance of k periods to that of 2 k.
    """
    X = np.outer(b, b)
    for _ in range(_DOUBLINGS):
        added = A @ X @ A.T
        X = X + added
        if np.max(np.abs(added)) <= _SETTLED * np.max(np.abs(X)):
            break
        A = A @ A
    return math.sqrt(X[place, place])


@dataclass(frozen=True, slots=True, eq=False)
class LoopsTogether:
    """The closed periods of (m,) loops with states of one size s, whose gains are one."""

    uncorrected: Array
    """(m, s, s)."""
    entered: Array
    """(m, s, 4)."""
    read: Array
    """(s,)."""

    def are_stable(self, L: Array) -> bool:
        """Return True if each is stable with every sample received; L (4,)."""
        closed = self.uncorrected + (self.entered @ L)[:, :, None] * self.read
        return bool(np.max(np.abs(np.linalg.eigvals(closed))) < _STEADY)


def together(loops: Sequence[PredictorLoop]) -> list[LoopsTogether]:
    """Return loops of like size side by side."""
    sizes = sorted({loop.size for loop in loops})
    like = [[loop for loop in loops if loop.size == size] for size in sizes]
    return [
        LoopsTogether(
            np.array([each.closed_parts[0] for each in group]),
            np.array([each.closed_parts[1] for each in group]),
            group[0].read,
        )
        for group in like
    ]


def delay_margin_s(prediction: Prediction, L: Array) -> float:
    """Return how much longer the delay may be than predicted, rounded down to a twentieth of a period."""
    return later_s(
        lambda delay_s: PredictorLoop(prediction, delay_s=delay_s).is_stable(L),
        prediction.delay_s,
        prediction.period_s,
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
