"""Certified figures of a loop with constant delay: solved, then proved again in numpy.

A certificate counts only after its matrices have been put into the inequalities again: each must have a
smallest eigenvalue above the bound of the rounding error of its entries. The figure returned is the one for
which this holds.

Matrix inequalities that certify a loop with constant delay: [Ling2012] Theorems 3.1 and 3.3, and beyond.

The functional of order N (Seuret and Gouaisbaut, Systems & Control Letters 81, 2015) holds the state
and the first N Legendre moments of its past,

    xi = [x(t), Omega_0, ..., Omega_{N-1}]      Omega_k = integral over the last delay of L_k(s) x(t + s)
    V = xi' P xi + int x' Q x + eta int int x'' Z x'

and bounds its last term by the Bessel-Legendre inequality. N = 0 is the paper's functional with
Jensen's inequality, that is Theorem 3.3 with Y = -Z/eta and W = Z/eta eliminated. As N grows the
certificate closes in on the exact limit.

Time is counted in delays, so that Omega, Q and Z are of like size; the states in ``state_scale``
and the disturbance so that the wanted gain is 1.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from servobench.design.delay.delay_loop import Array, DelayLoop, SpeedModel
from servobench.design.delay.delay_norm import hinf_norm, is_stable, largest_stable_delay_s, rough_norm
from servobench.design.delay.lmi import (
    LmiProblem,
    LmiSolution,
    MatrixInequality,
    Unknowns,
    rounding_of,
    smallest_eigenvalues,
    solve,
)
from servobench.design.errors import NoSolution

STRICT = 1e-8
"""Margin I demanded of every inequality, in the scaled problem, so that the check has something to find."""


@dataclass(frozen=True, slots=True, eq=False)
class ScaledLoop:
    """A loop in the units of the module's head: x' = A x + D x(t-1) + E d."""

    A: Array
    D: Array
    E: Array
    C: Array


def scaled(loop: DelayLoop, state_scale: Array, gain_scale: float) -> ScaledLoop:
    """Convert the loop to the units of the module's head.

    ``state_scale``: (n,) size of each state at one unit of z; a few per cent for e_q beside e.
    """
    T = state_scale * gain_scale
    h = loop.delay_s
    return ScaledLoop(
        A=h * loop.A * T / T[:, None],
        D=h * loop.BK * T / T[:, None],
        E=h * loop.E / T,
        C=loop.C * T / gain_scale,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Signals:
    """Rows that pick each signal from [x, x(t-1), Omega_0 .. Omega_{N-1}, d], transposed: (m, rows)."""

    m: int
    moments: Array
    """xi: (m, (N+1) n)."""
    moments_rate: Array
    """xi': (m, (N+1) n)."""
    now: Array
    then: Array
    rate: Array
    """x'."""
    projections: list[Array]
    """Integral of L_k x' for k = 0..N, each (m, n)."""


def _signals(loop: ScaledLoop, order: int, with_disturbance: bool) -> _Signals:
    n = len(loop.A)
    m = (2 + order) * n + (1 if with_disturbance else 0)
    rows = np.eye(m)
    now, then = rows[:, :n], rows[:, n : 2 * n]
    Omega = [rows[:, (2 + k) * n : (3 + k) * n] for k in range(order)]
    rate = now @ loop.A.T + then @ loop.D.T
    if with_disturbance:
        rate = rate + np.outer(rows[:, -1], loop.E)
    projections = []
    for k in range(order + 1):
        sum_ = now - (-1.0) ** k * then
        for i in range(k):
            # L_k' is a sum of the lower L_i of other parity, on an interval of length 1.
            sum_ = sum_ - (2 * i + 1) * (1.0 - (-1.0) ** (k + i)) * Omega[i]
        projections.append(sum_)
    return _Signals(
        m,
        moments=np.hstack([now, *Omega]),
        moments_rate=np.hstack([rate, *projections[:order]]),
        now=now,
        then=then,
        rate=rate,
        projections=projections,
    )


def _unknowns(n: int, order: int) -> Unknowns:
    unknowns = Unknowns()
    unknowns.symmetric("P", (order + 1) * n)
    unknowns.symmetric("Q", n)
    unknowns.symmetric("Z", n)
    return unknowns


def _positivity(unknowns: Unknowns, n: int, order: int) -> list[MatrixInequality]:
    """P + diag(0, Q, 3 Q, 5 Q ...) > 0, Q > 0, Z > 0."""
    moments = MatrixInequality.zero(unknowns, (order + 1) * n)
    identity = np.eye((order + 1) * n)
    moments.add(unknowns, "P", identity)
    for k in range(order):
        moments.add(unknowns, "Q", np.sqrt(2.0 * k + 1.0) * identity[:, (k + 1) * n : (k + 2) * n])
    return [moments, *(MatrixInequality.positive(unknowns, name) for name in ("Q", "Z"))]


def _decrease(unknowns: Unknowns, signals: _Signals) -> MatrixInequality:
    """Return -V' as a form of the signals, without the performance terms."""
    inequality = MatrixInequality.zero(unknowns, signals.m)
    inequality.add(unknowns, "P", -signals.moments, signals.moments_rate.T)
    inequality.add_form(unknowns, "Q", signals.now, -1.0)
    inequality.add_form(unknowns, "Q", signals.then, 1.0)
    inequality.add_form(unknowns, "Z", signals.rate, -1.0)
    for k, projection in enumerate(signals.projections):
        inequality.add_form(unknowns, "Z", projection, 2.0 * k + 1.0)
    return inequality


def gain_problem(loop: ScaledLoop, order: int) -> LmiProblem:
    """Pose the least squared gain that the functional of ``order`` certifies; the last unknown is that
    square.

    Order 0: [Ling2012] Theorem 3.3, (3.10), after Schur complements and with Y and W eliminated.
    """
    n = len(loop.A)
    unknowns = _unknowns(n, order)
    unknowns.symmetric("gain_squared", 1)
    signals = _signals(loop, order, with_disturbance=True)
    decrease = _decrease(unknowns, signals)
    _count_gain(decrease, signals.now @ loop.C)
    what = f"certificate of the gain at order {order}"
    return LmiProblem(what, unknowns, [*_positivity(unknowns, n, order), decrease], unknowns.last, STRICT)


def gain_slope(loop: ScaledLoop, problem: LmiProblem, answer: LmiSolution) -> Array:
    """Return the slope of the least squared gain of order 0 by [A, D, E], (n, 2 n + 1).

    By the multiplier of the last inequality, in which they stand as the rows of x'.
    """
    signals = _signals(loop, 0, with_disturbance=True)
    P, Z = (problem.unknowns.value(name, answer.y) for name in ("P", "Z"))
    return np.asarray(2.0 * (answer.duals[-1] @ (signals.now @ P + signals.rate @ Z)).T)


def _count_gain(decrease: MatrixInequality, output: Array) -> None:
    """Subtract z'z and add gain_squared d'd; ``output``: (m,), of the signals, the last of which is d."""
    decrease.constant -= np.outer(output, output)
    decrease.coefficients[-1, -1, -1] += 1.0


def ordinary_gain_problem(loop: DelayLoop, state_scale: Array, gain_scale: float) -> LmiProblem:
    """Pose the least squared gain of a loop without delay: the bounded real lemma, with x' P x alone."""
    T = state_scale * gain_scale
    unit_s = 1.0 / float(np.max(np.abs(np.linalg.eigvals(loop.A + loop.BK))))
    A, E, C = unit_s * (loop.A + loop.BK) * T / T[:, None], unit_s * loop.E / T, loop.C * T / gain_scale
    n = len(A)
    unknowns = Unknowns()
    unknowns.symmetric("P", n)
    unknowns.symmetric("gain_squared", 1)
    rows = np.eye(n + 1)
    now, rate = rows[:, :n], rows[:, :n] @ A.T + np.outer(rows[:, n], E)
    decrease = MatrixInequality.zero(unknowns, n + 1)
    decrease.add(unknowns, "P", -now, rate.T)
    _count_gain(decrease, now @ C)
    inequalities = [MatrixInequality.positive(unknowns, "P"), decrease]
    return LmiProblem("certificate of the gain without delay", unknowns, inequalities, unknowns.last, STRICT)


def stability_problem(loop: ScaledLoop, order: int) -> LmiProblem:
    """Pose the largest margin of stability; order 0 is [Ling2012] Theorem 3.1, (3.1), with Y and W
    eliminated.

    The last unknown is minus the margin: every inequality >= margin I, with the traces of the positive
    matrices bounded by 1.
    """
    n = len(loop.A)
    unknowns = _unknowns(n, order)
    unknowns.symmetric("minus_margin", 1)
    positive = _positivity(unknowns, n, order)
    decrease = _decrease(unknowns, _signals(loop, order, with_disturbance=False))
    bound = MatrixInequality(np.ones((1, 1)), np.zeros((unknowns.count, 1, 1)))
    for inequality in positive:
        bound.coefficients[:, 0, 0] -= np.trace(inequality.coefficients, axis1=1, axis2=2)
    inequalities = [*positive, decrease]
    for inequality in inequalities:
        inequality.coefficients[-1] += np.eye(len(inequality.constant))
    inequalities.append(bound)
    return LmiProblem(f"certificate of stability at order {order}", unknowns, inequalities, unknowns.last)


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
