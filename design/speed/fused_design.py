"""The predictor on count and speed whose speed peaks least after a load step, within its robustness limits.

search      two poles of the feedback: speed and torque; two walks of the filter's model: load and speed
limits      stable within the delay margin and with 66 % to 135 % of the inertia, as the predictor of
            ``predictor_design``; the torque's noise, by the exact covariance of the rounding
least       the largest peak over its own floor, of the motor and of 70 % and 130 % of its inertia, after the
            step of the load at the worst of some instants between two samples

The gains are constant, so noise, gain and peaks are exact.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.analysis import SampledAnalysis, analyse_loop
from servobench.design.sampled.held_loop import Operation
from servobench.design.sampled.lossy_loop import LossyLoop, LossyPeriods
from servobench.design.speed.fused_filter import FusedWalks, fused_filter
from servobench.design.speed.fused_loop import FusedLoop
from servobench.design.speed.plant_loop import later_s
from servobench.design.speed.predictor_design import WORST, PredictorRequest, largest_quiet_walk, peak_cost
from servobench.design.speed.predictor_loop import Prediction
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
    """``known``: data and limits; ``rounding``: see :func:`servobench.design.speed.fused_filter.rounding`, as
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
    return analyse_loop(LossyLoop(own.model, request.period_s, request.delay_s, periods, own.size - 1))
