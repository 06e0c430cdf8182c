"""Parameters of a model fitted to windows of a recording, by Gauss-Newton with the initial states eliminated.

    minimise over theta, x_1 ... x_w:   sum_w sum_o sum_k (W_o (y_wo - f_wo(theta, x_w)))_k^2

Window w begins with a state x_w of its own, one number here, and some outputs may be off by a constant in
each. With A_w and B_w the slopes of its outputs over theta and over these, the step of theta is that of the
problem from which the columns of B_w are projected out (Golub & Pereyra 1973, variable projection):

    A'_w = (I - Q_w Q_w') A_w,   r'_w = (I - Q_w Q_w') r_w,   B_w = Q_w R_w
    H = sum A'_w' A'_w,   step = H^-1 sum A'_w' r'_w

Noise. W_o is what makes the residuals of output o white: an autoregression, fitted to them anew with each
step, over the rest that it leaves, which is never less than the output's quantum allows. Where the inputs
come from a controller that has seen the same readings this is no refinement: noise that is correlated in time
gets into the inputs that way, and plain least squares is biased (Ljung 1999, 13.4).

Covariance. From one window to the next residuals are hardly correlated, whatever the model lacks. So the
scores of whole windows count, each taken as it would be without its own window (a sandwich over clusters,
with the correction of MacKinnon & White 1985, HC3):

    C = H^-1 (sum s_w s_w') H^-1,   s_w = (I - H_w H^-1)^-1 A'_w' r'_w,   H_w = A'_w' A'_w
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Places = NDArray[np.intp]

Model = Callable[[int, Array, float], Array]
"""Outputs (o, n) of a window by its number, the parameters (p,) and its initial state."""

_SLOPE_STEP: Final = 1e-3
"""Of a parameter's scale: far above rounding, and far below what bends the outputs."""
_STEPS_MAX: Final = 20
_STEPS_MIN: Final = 3
"""The first ones weigh the outputs by what a bad start leaves of them."""
_HALVES_MAX: Final = 6
_NEAR: Final = 0.1
"""Of a scale: slopes taken that near a place are its slopes, to some per cent of themselves."""
_COARSE: Final = 0.01
"""Of a scale: where plain least squares stop, for they are but a start."""
_CONVERGED: Final = 0.05
"""Of a standard uncertainty: a smaller step changes nothing that is told."""
_LAGS: Final = 6
"""Order of the autoregression: of six readings, 1 ms apart, the last has left every filter of 150 Hz."""


@dataclass(frozen=True, slots=True)
class WindowedProblem:
    """What is fitted to what."""

    measured: tuple[Array, ...]
    """Of each window: (o, n) at even distances of time, NaN where nothing was measured."""
    initial: Array
    """(w,): a first guess of the state that each window begins with."""
    initial_scale: float
    model: Model
    floors: Array
    """(o,): the least standard deviation of each output, by its quantum."""
    offset: tuple[bool, ...]
    """By output: it may be off by a constant in each window."""
    scale: Array
    """(p,): what is a large change of each parameter."""
    lowest: Array
    """(p,): the least value of each; -inf: any."""

    def part(self, numbers: Sequence[int]) -> "WindowedProblem":
        """Return the problem of some of the windows."""
        model, chosen = self.model, tuple(numbers)
        return replace(
            self,
            measured=tuple(self.measured[number] for number in chosen),
            initial=self.initial[list(chosen)],
            model=lambda number, theta, state: model(chosen[number], theta, state),
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """What the residuals are taken for."""

    sigma: Array
    """(o,): of what the autoregression leaves."""
    lags: Array
    """(o, l): of the autoregression."""

    def white(self, values: Array) -> Array:
        """Return (o, n) without what the values before tell, over sigma; the first ones are NaN."""
        count = self.lags.shape[1]
        rest = values.copy()
        for lag in range(1, count + 1):
            rest[:, lag:] -= self.lags[:, lag - 1, None] * values[:, :-lag]
        rest[:, :count] = math.nan
        return np.asarray(rest / self.sigma[:, None])


@dataclass(frozen=True, slots=True)
class WindowedFit:
    """The solution, with what its uncertainty and a prediction need."""

    parameters: Array
    """(p,)"""
    initial: Array
    """(w,)"""
    covariance: Array
    """(p, p); 0 of those that were not free."""
    singular_values: Array
    """Of the slopes, each parameter in its scale and each output white; falling."""
    directions: Array
    """(free, p): row i belongs to singular value i."""
    noise: Noise
    spread: Array
    """(o,): root mean square of what is left of each output."""
    spreads: Array
    """(w, o): the same of each window."""
    left: tuple[Array, ...]
    """(o, n) of each window: what is left, without the offsets."""
    solving: Array
    """(p, p): from a score to a step of the parameters."""
    slopes: "tuple[Slopes, ...]"
    steps: int
    converged: bool


class FitFailed(ValueError):
    """The windows are too few, or the model is no finite number."""


@dataclass(frozen=True, slots=True)
class Slopes:
    """Of one window, white; rows without a measurement are left out."""

    there: NDArray[np.bool_]
    """(o, n): the rows that are left."""
    over_parameters: Array
    """(n, free), each parameter in its scale."""
    own: Array
    """(n, q): over the initial state in its scale, and over the offsets."""
    basis: Array
    """(n, q): orthonormal, of ``own``."""

    def without_own(self, columns: Array) -> Array:
        """Return (n, ...) with what initial state and offsets can explain taken out."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))


def fit_windows(
    problem: WindowedProblem,
    start: Array,
    free: NDArray[np.bool_],
    *,
    white: bool = True,
    steps_max: int = _STEPS_MAX,
) -> WindowedFit:
    """Fit the parameters that are ``free``, (p,), from ``start``, (p,); the others stay.

    ``white``: by autoregressions, which take what a start far off leaves for noise; False: by plain least
    squares, from anywhere. Raises FitFailed.
    """
    theta, initial = start.astype(float), problem.initial.astype(float)
    places = np.flatnonzero(free)
    if len(problem.measured) < 2 * len(places) + 2:
        raise FitFailed(f"{len(problem.measured)} windows for {len(places)} parameters")
    left = _left(problem, theta, initial)
    had: list[_Taken | None] = [None] * len(initial)
    converged, step = False, 0
    while True:
        noise = _noise_of(problem, left, white)
        taken = [
            _taken(problem, number, theta, state, places, had[number]) for number, state in enumerate(initial)
        ]
        anew = all(one is not other for one, other in zip(taken, had, strict=True))
        had = [*taken]
        slopes = [_white(problem, number, each, noise) for number, each in enumerate(taken)]
        information, change = _step(slopes, noise, left)
        step += 1
        sure = np.sqrt(np.maximum(np.diag(_inverse(information)), 0.0))
        small = np.maximum(_CONVERGED * sure, 0.0 if white else _COARSE)
        # no change tells when initial states alone are there: they get one step more
        if step >= _STEPS_MIN + (len(places) == 0) and np.all(np.abs(change) <= small):
            converged = True
            break
        ahead = _descend(problem, slopes, (theta, initial, left), noise, places, change)
        if ahead is None and not anew and step < steps_max:
            had = [None] * len(initial)
            continue
        if ahead is None:
            converged = True
            break
        theta, initial, left = ahead
        if step >= steps_max:
            break
    return _solution(problem, (theta, initial, left), noise, slopes, places, step, converged)


State = tuple[Array, Array, list[Array]]
"""Parameters, initial states, and what is left of each window."""


@dataclass(frozen=True, slots=True)
class _Taken:
    """Slopes of a window, and where they were taken."""

    theta: Array
    state: float
    over_parameters: tuple[Array, ...]
    """(o, n) of each free parameter, in its scale."""
    over_state: Array


def _taken(
    problem: WindowedProblem, number: int, theta: Array, state: float, places: Places, had: _Taken | None
) -> _Taken:
    """Return those that it had, or new ones where it has moved on since."""
    if had is not None:
        moved = np.max(np.abs(theta - had.theta) / problem.scale, initial=0.0)
        if max(moved, abs(state - had.state) / problem.initial_scale) <= _NEAR:
            return had
    at = problem.model(number, theta, state)

    def slope(changed: Array, state_there: float) -> Array:
        return np.asarray((problem.model(number, changed, state_there) - at) / _SLOPE_STEP)

    columns = []
    for place in places.tolist():
        ahead = theta.copy()
        ahead[place] += _SLOPE_STEP * problem.scale[place]
        columns.append(slope(ahead, state))
    over_state = slope(theta, state + _SLOPE_STEP * problem.initial_scale)
    return _Taken(theta, state, tuple(columns), over_state)


def _white(problem: WindowedProblem, number: int, taken: _Taken, noise: Noise) -> Slopes:
    measured = problem.measured[number]
    there = np.isfinite(noise.white(measured))
    columns = [noise.white(each)[there] for each in taken.over_parameters]
    own = [noise.white(taken.over_state)[there]]
    for output, free in enumerate(problem.offset):
        if free and there[output].any():
            constant = np.zeros(measured.shape)
            constant[output] = 1.0
            own.append(noise.white(constant)[there])
    own_slopes = np.stack(own, axis=1)
    basis, weights, _ = np.linalg.svd(own_slopes, full_matrices=False)
    over_parameters = np.stack(columns, axis=1) if columns else np.empty((int(there.sum()), 0))
    return Slopes(there, over_parameters, own_slopes, basis[:, weights > 1e-9 * weights[0]])


def _step(slopes: Sequence[Slopes], noise: Noise, left: Sequence[Array]) -> tuple[Array, Array]:
    """Return H, and the step of the free parameters in their scales."""
    count = slopes[0].over_parameters.shape[1]
    information, score = np.zeros((count, count)), np.zeros(count)
    for each, residual in zip(slopes, left, strict=True):
        matrix = each.without_own(each.over_parameters)
        information += matrix.T @ matrix
        score += matrix.T @ noise.white(residual)[each.there]
    return information, _inverse(information) @ score


def _inverse(information: Array) -> Array:
    """Return the inverse, without directions that nothing tells."""
    values, vectors = np.linalg.eigh(information)
    usable = values > 1e-12 * max([1e-300, *values.tolist()])
    return np.asarray((vectors[:, usable] / values[usable]) @ vectors[:, usable].T)


def _descend(
    problem: WindowedProblem,
    slopes: Sequence[Slopes],
    state: State,
    noise: Noise,
    places: Places,
    change: Array,
) -> State | None:
    """Return the state after the step, shortened until the sum of squares falls; None if it does not."""
    theta, initial, left = state
    now = _cost(noise, left)
    if not math.isfinite(now):
        raise FitFailed("the model has no finite outputs at the start")
    for part in 0.5 ** np.arange(_HALVES_MAX):
        ahead = theta.copy()
        ahead[places] += part * change * problem.scale[places]
        ahead = np.maximum(ahead, problem.lowest)
        taken = (ahead - theta)[places] / problem.scale[places]
        moved = initial + [
            _own(problem, each, part * noise.white(residual)[each.there], taken)
            for each, residual in zip(slopes, left, strict=True)
        ]
        there = _left(problem, ahead, moved)
        if _cost(noise, there) < now:
            return ahead, moved, there
    return None


def _own(problem: WindowedProblem, slopes: Slopes, residual: Array, taken: Array) -> float:
    """Return by how much the initial state of a window moves along."""
    rest = residual - slopes.over_parameters @ taken
    solution, *_ = np.linalg.lstsq(slopes.own, rest, rcond=1e-9)
    return float(solution[0]) * problem.initial_scale


def _left(problem: WindowedProblem, theta: Array, initial: Array) -> list[Array]:
    """Return what is left of each window, (o, n), without the offsets."""
    left = []
    for number, measured in enumerate(problem.measured):
        each = measured - problem.model(number, theta, float(initial[number]))
        for output, free in enumerate(problem.offset):
            known = np.isfinite(each[output])
            if free and known.any():
                each[output] -= each[output][known].mean()
        left.append(each)
    return left


def _noise_of(problem: WindowedProblem, left: Sequence[Array], white: bool) -> Noise:
    outputs = len(problem.floors)
    lags, sigma = np.zeros((outputs, _LAGS if white else 0)), np.empty(outputs)
    for output in range(outputs):
        rows = []
        for each in left:
            shifted = np.lib.stride_tricks.sliding_window_view(each[output], lags.shape[1] + 1)
            rows.append(shifted[np.isfinite(shifted).all(axis=1)])
        table = np.concatenate(rows)
        if white and len(table) > 10 * _LAGS:
            before, now = table[:, -2::-1], table[:, -1]
            lags[output] = np.linalg.lstsq(before, now, rcond=1e-9)[0]
            rest = now - before @ lags[output]
        else:
            rest = table[:, -1]
        square = float(np.mean(rest**2)) if len(rest) else 0.0
        sigma[output] = max(math.sqrt(square), float(problem.floors[output]))
    return Noise(sigma, lags)


def _cost(noise: Noise, left: Sequence[Array]) -> float:
    total = sum(float(np.nansum(noise.white(each) ** 2)) for each in left)
    return total if all(np.isfinite(each).any() for each in left) else math.inf


def _solution(
    problem: WindowedProblem,
    state: State,
    noise: Noise,
    slopes: Sequence[Slopes],
    places: Places,
    steps: int,
    converged: bool,
) -> WindowedFit:
    theta, initial, left = state
    count, scale = len(theta), problem.scale[places]
    matrices = [each.without_own(each.over_parameters) for each in slopes]
    information = sum((each.T @ each for each in matrices), np.zeros((len(places), len(places))))
    inverse, meat = _inverse(information), np.zeros((len(places), len(places)))
    for each, matrix, residual in zip(slopes, matrices, left, strict=True):
        share = np.eye(len(places)) - matrix.T @ matrix @ inverse
        score = matrix.T @ noise.white(residual)[each.there]
        alone = np.linalg.lstsq(share, score, rcond=1e-9)[0]
        meat += np.outer(alone, alone)
    covariance, solving = np.zeros((count, count)), np.zeros((count, count))
    block = np.ix_(places, places)
    covariance[block] = (inverse @ meat @ inverse) * np.outer(scale, scale)
    solving[block] = inverse * scale[:, None]
    values, vectors = np.linalg.eigh(information)
    directions = np.zeros((len(places), count))
    directions[:, places] = vectors.T[::-1]
    return WindowedFit(
        theta,
        initial,
        covariance,
        np.sqrt(np.maximum(values[::-1], 0.0)),
        directions,
        noise,
        np.array([_rms([each[output] for each in left]) for output in range(len(problem.floors))]),
        np.array([[_rms([row]) for row in each] for each in left]),
        tuple(left),
        solving,
        tuple(slopes),
        steps,
        converged,
    )


def _rms(parts: Sequence[Array]) -> float:
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return math.sqrt(float(np.mean(values**2))) if len(values) else 0.0
