"""Certified figures of a loop with constant delay: solved, then proved again in numpy.

A certificate counts only after its matrices have been put into the inequalities again: each must have a
smallest eigenvalue above the bound of the rounding error of its entries. The figure returned is the one for
which this holds.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from servobench.design.delay.delay_lmi import gain_problem, ordinary_gain_problem, scaled, stability_problem
from servobench.design.delay.delay_loop import Array, DelayLoop
from servobench.design.delay.delay_norm import hinf_norm, is_stable, largest_stable_delay_s, rough_norm
from servobench.design.delay.lmi import LmiProblem, rounding_of, smallest_eigenvalues, solve
from servobench.design.delay.speed_loop import SpeedModel
from servobench.design.errors import NoSolution

ORDER_MAX = 6
"""0.99 of the largest stable delay needs order 3 for CLOSE_ENOUGH, 0.999 order 4; above that the solver takes
seconds, or fails."""
CLOSE_ENOUGH = 1.001
"""Certified over exact gain at which no higher order is tried."""
_DELAY_TOLERANCE_S = 1e-7
"""A tenth of a bit time at 1 Mbit/s: no delay of a bus is known as well."""
STABLE_MARGIN = 1e-9
"""For loops beyond their limit the solver finds margins of at most 3e-11; provable ones have 7e-6 and
more."""


_SHARES = (1.2, 1.0, 2.0)
"""Units of the disturbance to try, as shares of the gain."""
_CURRENT_FACTORS = (1.0, 0.2, 5.0)
"""Units of the current to try where the usual ones fail, as multiples of the feedback's response to 1
rad/s."""


@dataclass(frozen=True, slots=True)
class CertifiedGain:
    """A gain, rad/s per N m, that the loop provably does not exceed."""

    gain: float
    order: int
    min_margin: float
    """Smallest eigenvalue of all inequalities in the scaled problem, less the bound of its rounding error."""


def certified_gain(model: SpeedModel, loop: DelayLoop, order: int) -> CertifiedGain:
    """Return the least gain that the functional of ``order`` certifies; order 0 is [Ling2012] Theorem 3.3.

    Raises NoSolution if there is none, or if it fails its check.
    """
    unstable = NoSolution(f"certificate of the gain at order {order}", "the loop is unstable")
    norm = rough_norm(loop)
    if not math.isfinite(norm):
        raise unstable
    failure: NoSolution | None = None
    # the solver's luck turns with the units; whatever it says, the proof decides
    for state_scale in _state_scales(model, loop):
        for share in _SHARES:
            try:
                return _certified_in(state_scale, loop, order, share * norm)
            except NoSolution as error:
                # what is proved is stable: to ask first would cost every proof what only a failure needs
                if failure is None and not is_stable(loop):
                    raise unstable from None
                failure = failure or error
    assert failure is not None
    raise failure


def _state_scales(model: SpeedModel, loop: DelayLoop) -> list[Array]:
    """Return the state scales: the model's own units, then currents as fed back for 1 rad/s."""
    own = float(abs(loop.K[1])) or float(model.state_scale[0])
    changed = []
    for factor in _CURRENT_FACTORS:
        scale = model.state_scale.copy()
        scale[0] = factor * own
        changed.append(scale)
    return [model.state_scale, *changed]


def _certified_in(state_scale: Array, loop: DelayLoop, order: int, scale: float) -> CertifiedGain:
    # A first answer that is far from 1 in these units is asked for again, in units of its own.
    for _ in range(3):
        if loop.delay_s == 0.0:
            problem = ordinary_gain_problem(loop, state_scale, scale)
        else:
            problem = gain_problem(scaled(loop, state_scale, scale), order)
        y = solve(problem).y
        gain = scale * math.sqrt(max(float(y[-1]), 0.0))
        if 0.5 < gain / scale < 2.0:
            break
        scale = gain
    return CertifiedGain(gain, order, proved(problem, y))


def certified_gain_auto(model: SpeedModel, loop: DelayLoop) -> CertifiedGain:
    """Return the certificate of the lowest order that comes within :data:`CLOSE_ENOUGH` of the exact gain.

    If none does up to :data:`ORDER_MAX`, or the solver fails at a higher order: the best one found.
    """
    exact = hinf_norm(loop)
    best: CertifiedGain | None = None
    failure: NoSolution | None = None
    for order in range(ORDER_MAX + 1):
        try:
            certified = certified_gain(model, loop, order)
        except NoSolution as error:
            failure = error
            continue
        if best is None or certified.gain < best.gain:
            best = certified
        if best.gain <= CLOSE_ENOUGH * exact:
            break
    if best is None:
        assert failure is not None
        raise failure
    return best


def certified_stable(model: SpeedModel, loop: DelayLoop, order: int) -> bool:
    """Return True if the functional of ``order`` proves the loop stable; order 0 is [Ling2012] Theorem
    3.1."""
    problem = stability_problem(scaled(loop, model.state_scale, 1.0), order)
    try:
        y = solve(problem).y
    except NoSolution:
        return False
    proof = y.copy()
    proof[-1] = 0.0
    # the last inequality only bounds the traces
    return min(smallest_eigenvalues(problem, proof)[:-1]) > STABLE_MARGIN


def certified_delay_s(model: SpeedModel, loop: DelayLoop, order: int) -> float:
    """Return the largest delay, s, up to the exact limit, at which the functional of ``order`` proves
    stability."""
    high = largest_stable_delay_s(loop)
    if high == 0.0:
        return 0.0
    low = 0.0
    if math.isinf(high):
        high = 1.0 / min(abs(np.linalg.eigvals(loop.A + loop.BK).real))
        while high < 1e3 and certified_stable(model, replace(loop, delay_s=high), order):
            low, high = high, 2.0 * high
        if low == high:
            return math.inf
    while high - low > _DELAY_TOLERANCE_S:
        middle = 0.5 * (low + high)
        # a higher order proves all that a lower one does, but a solver may fail at it
        if any(
            certified_stable(model, replace(loop, delay_s=middle), lower) for lower in range(order, -1, -1)
        ):
            low = middle
        else:
            high = middle
    return low


def proved(problem: LmiProblem, y: Array) -> float:
    """Return the margin, checked in numpy. Raises NoSolution if an inequality does not hold beyond
    rounding."""
    margin = float(min(smallest_eigenvalues(problem, y)) - rounding_of(problem, y))
    if not margin > 0.0:
        raise NoSolution(problem.what, "the answer fails its check", f"smallest eigenvalue {margin:.2e}")
    return margin
