"""A model of the losses on one path: memoryless, or the chain of Gilbert (1960) and Elliott (1963).

    frame      1    2    3    4    5    6    7
    state      good good bad  bad  bad  good good     moves before each frame: p_good_to_bad, p_bad_to_good
    lost       -    -    x    x    -    -    -        with the probability loss_good, or loss_bad

The states are hidden. Parameters are those of the largest likelihood of the whole sequence (a hidden Markov
chain), in which a frame of unknown fate leaves the chain to move unseen. Four models are fitted, from
independent losses to all four parameters free; the one of the least Bayesian information criterion is taken
(Schwarz 1978), so that a burst is not claimed where chance does as well.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit

from servobench.design.confidence import Interval, clopper_pearson
from servobench.hil.reviewing.network_meter import runs_of

CAME: Final = 0
LOST: Final = 1
UNKNOWN: Final = 2
RUNS_MIN: Final = 10
"""Fewer runs of losses say nothing about bursts: ten events give a rate to a factor of two."""
_SIGMAS: Final = 1.959964
"""Half of a 95 % interval of a normal distribution, in standard deviations."""
_STEP: Final = 1e-3
"""For the curvature of the likelihood, in logits: the rounding of its logarithm (1e-9) is far below."""
_FLAT: Final = 0.01
"""Slope of the logarithm of the likelihood, in logits, that counts as none. Of ten bursts the curvature is
about ten, so that the maximum is a thousandth of a logit away."""
_NEAR: Final = 9.0
"""Logits: a parameter within 1e-4 of 0 or 1 counts as that, and the model with fewer parameters says as
much."""

Outcomes = NDArray[np.int8]
"""(n,) of CAME, LOST and UNKNOWN, in the order of sending."""


class Parameters(NamedTuple):
    """Parameters of the chain, each a probability; in the form of a fault plan's [[burst]]."""

    p_good_to_bad: float
    p_bad_to_good: float
    loss_bad: float = 1.0
    loss_good: float = 0.0

    @property
    def share_bad(self) -> float:
        """Long-run share of frames that find the chain bad."""
        moving = self.p_good_to_bad + self.p_bad_to_good
        return self.p_good_to_bad / moving if moving > 0.0 else 0.0

    @property
    def loss(self) -> float:
        """Long-run share of lost frames."""
        return self.share_bad * self.loss_bad + (1.0 - self.share_bad) * self.loss_good

    @property
    def inflation(self) -> float:
        """Variance of the number of losses among many, as a multiple of that of independent ones.

        The autocovariance at lag m is (loss_bad - loss_good)^2 share_bad (1 - share_bad) memory^m.
        """
        loss, bad = self.loss, self.share_bad
        if not 0.0 < loss < 1.0:
            return 1.0
        memory = 1.0 - self.p_good_to_bad - self.p_bad_to_good
        covariance = (self.loss_bad - self.loss_good) ** 2 * bad * (1.0 - bad)
        return 1.0 + 2.0 * covariance / (loss * (1.0 - loss)) * memory / (1.0 - memory)


@dataclass(frozen=True, slots=True)
class LossModel:
    """The fitted model."""

    independent: bool
    """True: every frame is lost with the same probability: ``parameters.loss``."""
    parameters: Parameters
    intervals: dict[str, Interval]
    """Interval of each fitted parameter; for independent losses of ``probability``."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Losses on one path."""

    known: int
    """Frames of known fate."""
    lost: int
    runs: tuple[int, ...]
    """How often exactly 1, 2, ... were lost in a row."""
    interval: Interval | None
    """Interval of the loss rate; None if no fate is known."""
    model: LossModel | None
    why_none: str = ""
    """Reason if there is no model."""


def losses_of(outcomes: Outcomes) -> Losses:
    """Return counts, rate and model of a sequence."""
    known, lost = int((outcomes != UNKNOWN).sum()), int((outcomes == LOST).sum())
    runs = runs_of(outcomes == LOST)
    if not known:
        return Losses(0, 0, runs, None, None, "not measured")
    count = sum(runs)
    if count < RUNS_MIN:
        mean_length = lost / count if count else 1.0
        interval = clopper_pearson(lost, known, _geometric_inflation(mean_length))
        return Losses(known, lost, runs, interval, None, f"not identifiable: {count} runs of losses")
    model = fit(outcomes)
    inflation = 1.0 if model.independent else max(1.0, model.parameters.inflation)
    return Losses(known, lost, runs, clopper_pearson(lost, known, inflation), model)


def fit(outcomes: Outcomes) -> LossModel:
    """Fit the likeliest model; ``outcomes`` with at least one loss and one frame that came."""
    known, lost = int((outcomes != UNKNOWN).sum()), int((outcomes == LOST).sum())
    rate = lost / known
    runs = Runs(outcomes)
    best = LossModel(True, Parameters(0.0, 1.0, 1.0, rate), {"probability": clopper_pearson(lost, known)})
    penalty = np.log(known)
    least = -2.0 * (lost * np.log(rate) + (known - lost) * np.log1p(-rate)) + penalty
    start = _markov_chain(outcomes)
    for free in (2, 3, 4):
        fitted = _likeliest(runs, start, free)
        if fitted is None:
            continue
        parameters, intervals, log_likelihood = fitted
        criterion = -2.0 * log_likelihood + free * penalty
        if criterion < least:
            least, best = criterion, LossModel(False, parameters, intervals)
    return best


class Runs:
    """A sequence as stretches of equal outcomes: a likelihood costs as much as there are stretches."""

    def __init__(self, outcomes: Outcomes) -> None:
        starts = np.flatnonzero(np.diff(outcomes, prepend=np.int8(-1)))
        self._outcome = outcomes[starts]
        self._length = np.diff(np.append(starts, outcomes.size))

    def log_likelihood(self, parameters: Parameters) -> float:
        up, down, bad, good = parameters
        moves = np.array([[1.0 - up, up], [down, 1.0 - down]])
        # Rows: from good, from bad; columns: to.
        seen = {CAME: [1.0 - good, 1.0 - bad], LOST: [good, bad], UNKNOWN: [1.0, 1.0]}
        stretches = np.empty((self._length.size, 2, 2))
        logs = 0.0
        for outcome, probabilities in seen.items():
            mine = self._outcome == outcome
            stretches[mine], grown = _powers(moves * probabilities, self._length[mine])
            logs += grown
        whole, grown = _product(stretches)
        share_bad = parameters.share_bad
        total = (np.array([1.0 - share_bad, share_bad]) @ whole).sum()
        with np.errstate(divide="ignore"):
            return float(logs + grown + np.log(total))


def _powers(matrix: NDArray[np.float64], exponents: NDArray[np.int64]) -> tuple[NDArray[np.float64], float]:
    """Return ``matrix`` to each exponent, (m, 2, 2), each scaled; and the sum of the logarithms of the
    scales."""
    distinct, place, count = np.unique(exponents, return_inverse=True, return_counts=True)
    powers = np.broadcast_to(np.eye(2), (distinct.size, 2, 2)).copy()
    logs = np.zeros(distinct.size)
    square, log_square, left = matrix, 0.0, distinct.copy()
    while left.any():
        odd = left % 2 == 1
        powers[odd], grown = _scaled(powers[odd] @ square)
        logs[odd] += grown + log_square
        square, grown = _scaled((square @ square)[None])
        square, log_square = square[0], 2.0 * log_square + float(grown[0])
        left //= 2
    return powers[place], float(logs @ count)


def _product(matrices: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the product of (n, 2, 2) in their order, scaled, by pairs; and the logarithm of the scale."""
    logs = 0.0
    while len(matrices) > 1:
        if len(matrices) % 2:
            matrices = np.concatenate([matrices, np.eye(2)[None]])
        matrices, grown = _scaled(matrices[0::2] @ matrices[1::2])
        logs += float(grown.sum())
    return matrices[0], logs


def _scaled(matrices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Divide each by its largest element, and return the logarithms of those; products would vanish
    otherwise."""
    largest = matrices.max(axis=(1, 2))
    largest[largest <= 0.0] = 1.0
    return matrices / largest[:, None, None], np.log(largest)


def _markov_chain(outcomes: Outcomes) -> Parameters:
    """Fit the chain whose states are visible: lost or not. Its likeliest parameters have a closed form."""
    before, after = outcomes[:-1], outcomes[1:]
    moved = {(a, b): int(((before == a) & (after == b)).sum()) for a in (CAME, LOST) for b in (CAME, LOST)}
    up, down = moved[CAME, LOST], moved[LOST, CAME]
    return Parameters(
        (up + 0.5) / (up + moved[CAME, CAME] + 1.0), (down + 0.5) / (down + moved[LOST, LOST] + 1.0)
    )


def _likeliest(
    runs: Runs, start: Parameters, free: int
) -> tuple[Parameters, dict[str, Interval], float] | None:
    """Return the first ``free`` parameters of the largest likelihood, their intervals, and the likelihood's
    logarithm; None if the data leave one of them open.

    The intervals are from the curvature at the maximum, in logits.
    """
    begin = logit(np.array([*start[:2], 0.8, 1e-3])[:free])

    def cost(logits: NDArray[np.float64]) -> float:
        return -runs.log_likelihood(_parameters(logits))

    optimum = minimize(cost, begin, method="BFGS", options={"gtol": _FLAT, "eps": 1e-4, "maxiter": 200})
    at = np.asarray(optimum.x, dtype=float)
    parameters = _parameters(at)
    if (
        np.abs(optimum.jac).max() > 10 * _FLAT
        or np.abs(at).max() > _NEAR
        or parameters.loss_bad <= parameters.loss_good
    ):
        return None
    curvature = _curvature(cost, at)
    if np.linalg.eigvalsh(curvature)[0] <= 0.0:
        return None
    half = _SIGMAS * np.sqrt(np.diag(np.linalg.inv(curvature)))
    intervals = {
        name: Interval(float(expit(x - d)), float(expit(x + d)))
        for name, x, d in zip(Parameters._fields, at, half, strict=False)
    }
    return parameters, intervals, -float(optimum.fun)


def _parameters(logits: Sequence[float] | NDArray[np.float64]) -> Parameters:
    return Parameters(*(float(expit(value)) for value in logits))


def _curvature(cost: Callable[[NDArray[np.float64]], float], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return second derivatives by central differences: (p, p)."""
    size = at.size
    steps = _STEP * np.eye(size)
    curvature = np.empty((size, size))
    for i in range(size):
        for j in range(i, size):
            corners = [
                cost(at + a * steps[i] + b * steps[j]) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            curvature[i, j] = curvature[j, i] = (corners[0] - corners[1] - corners[2] + corners[3]) / (
                4 * _STEP**2
            )
    return curvature


def _geometric_inflation(mean_length: float) -> float:
    """Return :attr:`Parameters.inflation` of rare bursts of that mean length, in which everything is lost."""
    return 2.0 * mean_length - 1.0
