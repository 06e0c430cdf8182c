"""The predictor on count and speed whose speed peaks least after a load step, within its robustness limits.

search      two poles of the feedback: speed and torque; two walks of the filter's model: load and speed
limits      stable within the delay margin and with 66 % to 135 % of the inertia, as the predictor of
            ``predictor_design``; the torque's noise, by the exact covariance of the rounding
least       the largest peak over its own floor, of the motor and of 70 % and 130 % of its inertia, after the
            step of the load at the worst of some instants between two samples

The gains are constant, so noise, gain and peaks are exact.

The Kalman filter on count and filtered speed of one sample: speed, filtered speed, angle and load torque.

    606Ch = f (6064h - m)      m: an exponential mean of past counts      f: see :func:`rounding`

A count is rounded to a whole one, and so is each in m: the mean has a smaller rounding, independent of that
of the newest count. The filter knows both of each sample, and their covariance. Its gains are constant, but
that a sample behind lost ones counts for more.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.analysis import SampledAnalysis, analyse_loop
from servobench.design.sampled.held_loop import LossyLoop, LossyPeriods, Operation
from servobench.design.speed.fused_loop import FusedLoop
from servobench.design.speed.plant_loop import later_s
from servobench.design.speed.predictor_design import WORST, PredictorRequest, largest_quiet_walk, peak_cost
from servobench.design.speed.predictor_loop import Prediction
from servobench.design.speed.predictor_plant import FILTERED, LOAD, SPEED, PredictorPlant
from servobench.design.speed.speed_robustness import (
    CHANGES,
    LoopRobustness,
    peaks_over_floor,
    stable_bandwidths,
)

PHASES = np.array([0.0, 0.2, 0.35, 0.5, 0.7, 0.9])
"""Instants of the load step, in periods after a sample."""
_RINGING = 10.0
"""Time constant, of the time until a command can act, of what may ring with another inertia or delay. Twice
as much lets no peak fall by 1 %, and doubles the gain at 70 % of the inertia."""
_SIGMAS = 1.5
"""Standard deviations of the speed's own noise that count as a part of the peak: what a step meets of it."""
_EXCESS = 50.0
"""Cost of a torque noise beyond its limit, for each multiple of it: more than any peak gains by it."""
_EVALUATIONS, _ROUNDS = 180, 2
_POLES = (0.15, 0.4, 0.9)
"""Speed poles that are tried first, over the inverse of the time until a command can act."""
_TORQUE_POLE = 0.8
"""Torque pole that is tried first, of the current loop's rate: the search moves it either way."""
_SPEED_WALK = 0.1
"""First walk of the speed, of what the walk of the load makes within a period."""
_TABLE = 20
"""Losses in a row up to which a sample has a gain of its own. A gain that is made for few losses corrects
the speed too far after many: with five, bursts of ten periods on average diverge in mean square."""
_WALKS = (0.05, 0.3, 2.0)
"""First walks of the load, rated torques per root of s."""


@dataclass(frozen=True, slots=True)
class FusedRequest:
    """``known``: data and limits; ``rounding``: see :func:`servobench.design.speed.fused_design.rounding`, as
    rows."""

    known: PredictorRequest
    rounding: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, eq=False)
class FusedDesign:
    """Gains of a filter, a feedback, and their loops."""

    asked: FusedRequest
    F: Array
    """(4,): u = -F x^."""
    gains: list[Array]
    """L (4, 2) of [omega, w, angle, T_L], for count and filtered speed, after 0, 1 .. lost samples."""
    spread_rad: float
    """Standard deviation of a count from the expected one."""

    @property
    def request(self) -> PredictorRequest:
        """Data and limits."""
        return self.asked.known

    @property
    def prediction(self) -> Prediction:
        """The model in its loop."""
        request = self.request
        return Prediction(request.plant, request.period_s, request.delay_s, self.F)

    def speed_gains(self) -> Array:
        """Return L (3,) of [omega, w, T_L] of a sample without a count: the fastest that keep the limits."""
        return self.request.kalman.observer(largest_quiet_walk(self.request, self.F))[1:]

    def loop(self, inertia: float = 1.0, current: float = 1.0, more_s: float = 0.0) -> FusedLoop:
        """Return the loop with another plant or a longer delay."""
        request = self.request
        return FusedLoop(self.prediction, request.plant.changed(inertia, current), request.delay_s + more_s)

    def ratio(self, inertia: float = 1.0, lost: int = 0) -> float:
        """Return the peak after the step over the floor of that inertia."""
        request = self.request
        periods = math.ceil(3.0 * (request.delay_s / request.period_s + 1.0)) + 15 + 2 * lost
        peaks = self.loop(inertia).peaks(self.gains, request.load_nm, PHASES, periods, lost)
        return float(np.max(peaks)) / request.floor_rad_s(inertia, lost)

    def noise(self) -> tuple[float, float]:
        """Return the rms of command, N m, and speed, rad/s, by the rounding; inf if unstable."""
        return self.loop().noise(self.gains[0], np.array(self.asked.rounding))


def design_fused(asked: FusedRequest) -> FusedDesign:
    """Design it. Raises InfeasibleDesign if none keeps the limits."""
    request = asked.known
    filtering = fused_filter(
        request.plant, request.period_s, np.array(asked.rounding), request.torque_noise_nm
    )
    around_s, rated_nm = request.period_s + request.delay_s, request.motor.rated_torque_nm
    of_load = request.period_s / request.motor.inertia_kg_m2
    damped = math.exp(-request.period_s / (_RINGING * around_s))

    def made(point: Array, losses_max: int = 0) -> FusedDesign:
        load, speed, first, second = np.exp(point)
        F, walks = request.plant.feedback(first, second), FusedWalks(load, speed)
        return FusedDesign(asked, F, filtering.gains(walks, losses_max), filtering.spread_rad(walks))

    def cost(point: Array) -> float:
        try:
            found = made(point)
        except (np.linalg.LinAlgError, ValueError):  # a walk that the equation's solver cannot resolve
            return 2.0 * WORST
        radii = [found.loop(inertia, 1.0, more_s).radius(found.gains[0]) for inertia, more_s in request.borne]
        if not max(radii) < damped:
            return WORST + max(radii)
        torque_nm, speed_rad_s = found.noise()
        excess = max(0.0, torque_nm / request.command_noise_nm - 1.0)
        seen = _SIGMAS * speed_rad_s / request.floor_rad_s()
        return peak_cost(found.ratio) + seen + _EXCESS * excess

    fast = _TORQUE_POLE * request.current_rate_rad_s
    starts = [
        np.log([walk * rated_nm, _SPEED_WALK * walk * rated_nm * of_load, pole / around_s, fast])
        for walk in _WALKS
        for pole in _POLES
    ]
    best = min(starts, key=cost)
    for _ in range(_ROUNDS):
        simplex = best + np.vstack([np.zeros(4), 0.4 * np.eye(4)])
        options = {"maxfev": _EVALUATIONS, "initial_simplex": simplex, "xatol": 1e-2, "fatol": 1e-3}
        best = scipy.optimize.minimize(cost, best, method="Nelder-Mead", options=options).x
    if cost(best) >= WORST or made(best).noise()[0] > 1.01 * request.command_noise_nm:
        raise request.unkept("predictor on count and speed")
    return made(best, _TABLE)


def fused_robustness(made: FusedDesign) -> LoopRobustness:
    """Return its figures, all of them exact."""
    request, L = made.request, made.gains[0]
    own = made.loop()

    def stable(share: float) -> bool:
        return made.loop(current=share).is_stable(L)

    return LoopRobustness(
        peaks_over_floor(made.ratio),
        own.gain(L),
        {name: made.loop(*change).gain(L) for name, change in CHANGES.items()},
        stable_bandwidths(stable),
        own.margins(L),
        later_s(
            lambda delay_s: made.loop(more_s=delay_s - request.delay_s).is_stable(L),
            request.delay_s,
            request.period_s,
        ),
        made.noise()[0],
    )


def fused_losses(made: FusedDesign, losses_max: int) -> SampledAnalysis:
    """Analyse it with at most so many samples lost in a row: one gain for each number of them."""
    own, request = made.loop(), made.request

    def period(L: Array | None) -> tuple[Operation, ...]:
        return tuple(own.chain(L))

    came = tuple(map(period, made.gains[: losses_max + 1]))
    periods = LossyPeriods(period(None), came, tuple((each,) for each in came))
    times_s = request.period_s, request.delay_s, 0.0
    return analyse_loop(LossyLoop(own.model, times_s, periods, own.size - 1))


UNSURE = 4
"""States of the filter: [omega, w, angle, T_L]. The torque follows from the commands."""
_ANGLE, _LOAD = 2, 3
READ = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
"""Count and filtered speed."""


def rounding(counts_per_revolution: int, filter_hz: float, rate_hz: float, jitter_rad: float = 0.0) -> Array:
    """Return the covariance (2, 2) that rounding adds to a count, rad, and to 606Ch, rad/s.

    The filter is a (1 - z^-1)/(1 - (1 - a) z^-1) of the count times the rate: the newest count has the share
    f = a rate, the mean m of the past ones a rounding of a/(2 - a) of a count's variance. ``jitter_rad``: rms
    angle by which the shaft turns within what the instant of a sample is unsure by.
    """
    a = 1.0 / (1.0 + rate_hz / (math.tau * filter_hz))
    f, of_count = a * rate_hz, (math.tau / counts_per_revolution) ** 2 / 12.0
    both = of_count * np.array([[1.0, f], [f, 2.0 * f * f / (2.0 - a)]])
    both[0, 0] += jitter_rad**2
    return both


@dataclass(frozen=True, slots=True)
class FusedWalks:
    """What drives the filter's model."""

    load_nm_sqrt_s: float
    """Random walk of the load."""
    speed_rad_s_sqrt_s: float
    """Random walk of the speed itself."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedFilter:
    """P+ = Phi P Phi' + Q between two samples, over [omega, w, angle, T_L]."""

    Phi: Array
    Q_torque: Array
    Q_load: Array
    Q_speed: Array
    R: Array
    """(2, 2) covariance of the noise on count and filtered speed."""

    def stationary(self, walks: FusedWalks) -> Array:
        """Return P (4, 4) before each correction, where every sample comes."""
        from scipy.linalg import solve_discrete_are

        return np.asarray(solve_discrete_are(self.Phi.T, READ.T, self._process(walks), self.R))

    def gain(self, P: Array) -> Array:
        """Return L (4, 2) of a correction from P."""
        return np.asarray(np.linalg.solve(READ @ P @ READ.T + self.R, READ @ P).T)

    def gains(self, walks: FusedWalks, losses_max: int) -> list[Array]:
        """Return L (4, 2) of the sample after 0, 1 .. lost ones, before which every one came."""
        P = self.stationary(walks)
        gains = [self.gain(P)]
        P = P - gains[0] @ READ @ P
        P = self._predicted(P, walks)
        for _ in range(losses_max):
            P = self._predicted(P, walks)
            gains.append(self.gain(P))
        return gains

    def spread_rad(self, walks: FusedWalks) -> float:
        """Return the standard deviation of a count from the expected one."""
        return math.sqrt(self.stationary(walks)[_ANGLE, _ANGLE] + self.R[0, 0])

    def _process(self, walks: FusedWalks) -> Array:
        load, speed = walks.load_nm_sqrt_s, walks.speed_rad_s_sqrt_s
        return np.asarray(self.Q_torque + load * load * self.Q_load + speed * speed * self.Q_speed)

    def _predicted(self, P: Array, walks: FusedWalks) -> Array:
        return np.asarray(self.Phi @ P @ self.Phi.T + self._process(walks))


def fused_filter(plant: PredictorPlant, period_s: float, R: Array, torque_noise_nm: float) -> FusedFilter:
    """Make the filter. ``R``: see :func:`rounding`; ``torque_noise_nm``: rms difference between the torque of
    a period and its command."""
    from scipy.linalg import expm

    A = np.zeros((UNSURE, UNSURE))
    places = (SPEED, FILTERED, LOAD)
    own = (0, 1, _LOAD)
    A[np.ix_(own, own)] = plant.A[np.ix_(places, places)]
    A[_ANGLE, 0] = 1.0

    def within(place: int) -> tuple[Array, Array]:
        """Return Phi and Q for white noise of 1 per root of s on a state (Van Loan, 1978)."""
        noise = np.zeros((UNSURE, UNSURE))
        noise[place, place] = 1.0
        total = expm(np.block([[-A, noise], [np.zeros_like(A), A.T]]) * period_s)
        Phi = total[UNSURE:, UNSURE:].T
        added = Phi @ total[:UNSURE, UNSURE:]
        return Phi, 0.5 * (added + added.T)

    Phi, of_load = within(_LOAD)
    _, of_speed = within(0)
    held = torque_noise_nm * Phi[:, _LOAD]
    held[_LOAD] = 0.0
    return FusedFilter(Phi, np.outer(held, held), of_load, of_speed, R)
