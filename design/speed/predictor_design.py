"""The predictor whose speed peaks least after a load step, within its robustness limits.

search      two poles of the feedback: speed and torque
for each    the fastest walk of the load that is stable within the delay margin and +-30 % of the inertia
            and keeps the torque's noise: of the quiet filter, and of the bold one that follows steps
least       the largest peak over its own floor, of the motor and of +-30 % of its inertia, after the step
            of the load at the worst of some instants between two samples
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache

import numpy as np
import scipy.optimize

from servobench.design.delay.delay_loop import Array, peak_floor_rad_s
from servobench.design.errors import InfeasibleDesign
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.held_loop import Operation
from servobench.design.speed.predictor_loop import (
    AdaptiveFilter,
    Prediction,
    PredictorLoop,
    Walks,
    delay_margin_s,
    load_step,
    together,
)
from servobench.design.speed.predictor_plant import (
    KalmanModel,
    PredictorPlant,
    kalman_model,
    of_state,
    plant_of,
)
from servobench.design.speed.speed_robustness import (
    CHANGES,
    LoopRobustness,
    peaks_over_floor,
    stable_bandwidths,
)

_INERTIAS = (1.0, 0.7, 1.3)
"""The motor's own inertia, and +-30 %: the usual uncertainty of the load on a shaft."""
PHASES = (0.0, 0.2, 0.35, 0.5)
"""Instants of the load step, in periods after a sample; later ones are nearer to that of the next sample."""
DELAY_MARGIN_S = 0.5e-3
DELAY_MARGIN_SHARE = 0.1
"""Share of the delay: the required margin is the larger of the two."""
_MARGIN_STEP = 0.1
"""Step, in periods, at which the loop must be stable within the delay margin. Between stable delays lie
unstable ones, half a period wide."""
_MARGIN_REACH = 1.1
"""Multiple of the delay margin: the last instant of the grid lies at its end or beyond."""
_INERTIAS_BORNE = (0.66, 0.7, 1.3, 1.35)
"""Inertias with which it must be stable: a little beyond +-30 %, so that there it is well damped."""
_QUIET_SHARE = 0.75
"""Share of the torque noise for the quiet filter."""
_FALSE_STEPS = 0.45
"""Share of the variance due to the bold filter where only noise comes, by long trials: one sample in seven is
taken for a step, and the gains calm down within a few."""
_SLOWEST, _FASTEST = 1e-2, 3e2
"""Range of walks, in rated torques per root of s; they are the ends of a bisection."""
_ROUNDS, _HALVINGS = 2, 5
"""Rounds of as many halvings of the ratio, 3e4: they leave 1 % of a walk."""
_ALLOWED, _TIE = 0.1, 0.1
"""Ratio that another inertia may cost beyond the motor's own, and the weight of the latter alone."""
WORST = 1e3
"""Ratio for weights that stabilise nothing: beyond all stable ones, and finite for a search."""


@dataclass(frozen=True, slots=True)
class PredictorRequest:
    """Known data and required limits."""

    motor: PmsmParameters
    current_bandwidth_hz: float
    """Bandwidth of the drive's current loop."""
    speed_filter_hz: float
    """Bandwidth of the filter behind the drive's speed."""
    speed_noise_rad_s: float
    """Rms on each sample."""
    torque_noise_nm: float
    """Difference between the torque of a period and its command, rms."""
    period_s: float
    delay_max_s: float
    """From a sample to its command's instant."""
    load_nm: float
    """The step of the load."""
    command_noise_nm: float
    """Rms of the command that the samples' noise may cause."""
    dead_time_s: float = 0.0
    """Dead time of the drive: from a command's instant to its voltage, and from a sample's to that of its
    count."""
    uneven_s: float = 0.0
    """Largest departure of the distance of two samples from the period, for the certificate."""

    @property
    def delay_s(self) -> float:
        """From a sample to the voltage of its command."""
        return self.delay_max_s + self.dead_time_s

    @property
    def current_rate_rad_s(self) -> float:
        """Rate of the drive's current loop."""
        return math.tau * self.current_bandwidth_hz

    @property
    def plant(self) -> PredictorPlant:
        """The motor's plant."""
        return plant_of(self.motor, self.current_rate_rad_s, self.speed_filter_hz)

    @property
    def kalman(self) -> KalmanModel:
        """The model of its filter."""
        return _kalman(self)

    @property
    def delay_margin_s(self) -> float:
        """The required margin."""
        return max(DELAY_MARGIN_S, DELAY_MARGIN_SHARE * self.delay_s)

    @property
    def borne(self) -> list[tuple[float, float]]:
        """Multiples of the inertia, and extra delays, s: with each pair the loop must be stable."""
        later = np.arange(0.0, _MARGIN_REACH * self.delay_margin_s, _MARGIN_STEP * self.period_s)
        return [(1.0, float(more_s)) for more_s in later] + [(inertia, 0.0) for inertia in _INERTIAS_BORNE]

    def unkept(self, kind: str) -> InfeasibleDesign:
        """Return the error if no controller of a ``kind`` keeps the limits."""
        return InfeasibleDesign(
            f"a delay margin of {1e3 * self.delay_margin_s:g} ms and a torque noise of "
            f"{self.command_noise_nm:g} N m",
            f"no {kind} that was tried keeps both",
            "allow more noise of the torque, or shorten the delay",
        )

    def floor_rad_s(self, inertia: float = 1.0, lost: int = 0) -> float:
        """Return the peak that no controller beats after the step, with so many samples lost in a row."""
        motor = replace(self.motor, inertia_kg_m2=self.motor.inertia_kg_m2 * inertia)
        return self.load_nm * peak_floor_rad_s(motor, (1 + lost) * self.period_s + self.delay_s)


@cache
def _kalman(request: PredictorRequest) -> KalmanModel:
    return kalman_model(request.plant, request.period_s, request.speed_noise_rad_s, request.torque_noise_nm)


@dataclass(frozen=True, eq=False)
class PredictorDesign:
    """A predictor and its figures."""

    request: PredictorRequest
    F: Array
    walks: Walks

    @cached_property
    def _filtering(self) -> AdaptiveFilter:
        return AdaptiveFilter(self.request.kalman, self.walks)

    @property
    def prediction(self) -> Prediction:
        """The model in its loop."""
        request = self.request
        return Prediction(request.plant, request.period_s, request.delay_s, self.F)

    def ratio(self, inertia: float, lost: int = 0) -> float:
        """Return the peak after the step over the floor of that inertia, both without noise."""
        request = self.request
        periods = math.ceil(3.0 * (request.delay_s / request.period_s + 1.0)) + 10 + 2 * lost
        largest = 0.0
        for phase in PHASES:
            self._filtering.begin()
            trial = load_step(
                self.prediction,
                self._filtering,
                request.load_nm,
                periods,
                phase=phase,
                plant=request.plant.changed(inertia),
                lost=frozenset(range(lost)),
            )
            largest = max(largest, trial.peak_rad_s)
        return largest / request.floor_rad_s(inertia, lost)


def design_predictor(request: PredictorRequest) -> PredictorDesign:
    """Design the predictor. Raises InfeasibleDesign if none keeps the limits."""
    around_s = request.period_s + request.delay_s

    def design(poles: Array) -> PredictorDesign | None:
        F = request.plant.feedback(*np.exp(poles))
        return _with_walks(request, np.asarray(F))

    def cost(poles: Array) -> float:
        made = design(poles)
        if made is None:
            return WORST
        return peak_cost(made.ratio)

    starts = [np.log([share / around_s, 1.2 * request.current_rate_rad_s]) for share in (0.9, 0.3)]
    start = min(starts, key=cost)
    best = scipy.optimize.minimize(
        cost, start, method="Nelder-Mead", options={"maxiter": 40, "xatol": 2e-2, "fatol": 1e-3}
    )
    made = design(best.x)
    if made is None:
        raise request.unkept("predictor")
    return made


def peak_cost(ratio: Callable[[float], float]) -> float:
    """Return the cost of a search: the largest ``ratio`` of three inertias, the motor's own favoured."""
    own, less, more = (ratio(inertia) for inertia in _INERTIAS)
    return max(own + _ALLOWED, less, more) + _TIE * own


class _Limits:
    """The loops with a feedback that must be stable, and the torque's noise of the first."""

    def __init__(self, request: PredictorRequest, F: Array) -> None:
        prediction = Prediction(request.plant, request.period_s, request.delay_s, F)
        self._loops = [
            PredictorLoop(prediction, request.plant.changed(inertia), request.delay_s + more_s)
            for inertia, more_s in request.borne
        ]
        self._together = together(self._loops)
        self._noise_rad_s = request.speed_noise_rad_s

    def robust(self, L: Array) -> bool:
        """Return True if every loop is stable with the gain L (4,)."""
        return all(loops.are_stable(L) for loops in self._together)

    def noise_nm(self, L: Array) -> float:
        """Return the rms of the command that the samples' noise causes; inf if unstable."""
        return self._loops[0].torque_noise_nm(L, self._noise_rad_s)


def _with_walks(request: PredictorRequest, F: Array) -> PredictorDesign | None:
    limits, kalman, most_nm = _Limits(request, F), request.kalman, request.command_noise_nm

    def quiet(L: Array) -> bool:
        return limits.noise_nm(L) <= _QUIET_SHARE * most_nm and limits.robust(L)

    rated = request.motor.rated_torque_nm
    slow = _largest(quiet, kalman, _SLOWEST * rated, _FASTEST * rated)
    if slow is None:
        return None
    calm_nm = limits.noise_nm(kalman.observer(slow))

    def bold(L: Array) -> bool:
        mixed = (1.0 - _FALSE_STEPS) * calm_nm**2 + _FALSE_STEPS * limits.noise_nm(L) ** 2
        return mixed <= most_nm**2 and limits.robust(L)

    fast = _largest(bold, kalman, slow, _FASTEST * rated)
    return PredictorDesign(request, F, Walks(slow, fast or slow))


def largest_quiet_walk(request: PredictorRequest, F: Array) -> float:
    """Return the fastest walk of the load whose constant gains keep the limits; the slowest if none does."""
    limits = _Limits(request, F)

    def quiet(L: Array) -> bool:
        return limits.noise_nm(L) <= request.command_noise_nm and limits.robust(L)

    rated = request.motor.rated_torque_nm
    return _largest(quiet, request.kalman, _SLOWEST * rated, _FASTEST * rated) or _SLOWEST * rated


def _largest(keeps: Callable[[Array], bool], kalman: KalmanModel, low: float, high: float) -> float | None:
    """Return the largest walk between two whose gains are kept, by bisection; None: not even the low one's.

    The gains of all points that a round may ask for are found together.
    """
    if not keeps(_observers(kalman, low, low, 1)[1][0]):
        return None
    for _ in range(_ROUNDS):
        walks, gains = _observers(kalman, low, high, 2**_HALVINGS)
        first, last = 0, len(walks) - 1
        while last - first > 1:
            middle = (first + last) // 2
            first, last = (middle, last) if keeps(gains[middle]) else (first, middle)
        low, high = float(walks[first]), float(walks[last])
    return low


@lru_cache(maxsize=256)
def _observers(kalman: KalmanModel, low: float, high: float, parts: int) -> tuple[Array, Array]:
    """Return (N,) walks between two, evenly in their logarithm, and their gains (N, 4)."""
    walks = np.geomspace(low, high, parts + 1)
    return walks, kalman.observers(walks)


_SETTLED = 300
"""Samples after which the covariance repeats itself."""


def predictor_robustness(made: PredictorDesign) -> LoopRobustness:
    """Return the figures for the constant gains of the quiet filter.

    The loop is stable, and has its delay margin, with those of both filters.
    """
    request, prediction = made.request, made.prediction
    kalman = request.kalman
    L = kalman.observer(made.walks.quiet)
    own = PredictorLoop(prediction)

    def gain(inertia: float = 1.0, current: float = 1.0) -> float:
        loop = PredictorLoop(prediction, request.plant.changed(inertia, current))
        return loop.gain(loop.chain(L))

    filters = [kalman.observer(walk) for walk in (made.walks.quiet, made.walks.bold)]

    def stable(share: float) -> bool:
        loop = PredictorLoop(prediction, request.plant.changed(current=share))
        return all(map(loop.is_stable, filters))

    return LoopRobustness(
        peaks_over_floor(made.ratio),
        gain(),
        {name: gain(*change) for name, change in CHANGES.items()},
        stable_bandwidths(stable),
        own.margins(L),
        min(delay_margin_s(prediction, gains) for gains in filters),
        own.torque_noise_nm(L, request.speed_noise_rad_s),
    )


Sample = tuple[int, bool]
"""A received one: losses before it, and whether it counts as a step of the load."""


def losses_gain(made: PredictorDesign, losses: Sequence[int]) -> float:
    """Return the L2 gain if so many samples are lost before each received one, again and again, rad/s per N
    m.

    The gains are the quiet filter's steady ones; inf: unstable.
    """
    return samples_gain(made, [(lost, False) for lost in losses])


def samples_gain(made: PredictorDesign, samples: Sequence[Sample]) -> float:
    """Return the L2 gain if ``samples`` come again and again, rad/s per N m; inf: unstable."""
    kalman, walks = made.request.kalman, made.walks
    quiet, bold = kalman.settled(walks.quiet), kalman.settled(walks.bold)
    gains: list[Array] = []
    for _ in range(math.ceil(_SETTLED / len(samples))):
        gains.clear()
        for lost, step in samples:
            for _ in range(lost + 1):
                quiet, bold = kalman.predicted(quiet, walks.quiet), kalman.predicted(bold, walks.bold)
            quiet = bold if step else quiet
            gains.append(of_state(kalman.gain(quiet)))
            quiet, bold = kalman.corrected(quiet), kalman.corrected(bold)
    loop = PredictorLoop(made.prediction)
    lost_period = loop.chain(None)
    chain: list[Operation] = []
    for (lost, _), L in zip(samples, gains, strict=True):
        chain += lost_period * lost + loop.chain(L)
    return loop.gain(chain)
