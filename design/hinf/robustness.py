"""Robustness of a current loop when r_s, L_d and L_q lie within a box about their nominal values.

Two questions, answered apart: does every motor of the box give a stable loop, and how large does the
weighted sensitivity get. For one axis both have exact answers, here; the coupled axes are in
:mod:`servobench.design.current.coupled_robustness`.

The largest |w S| of any motor in a box: exact at a frequency, bounded between frequencies.

One axis, z = r + j omega L anywhere in a rectangle, S = z/(z + K). At one frequency |S| is largest on an edge
of the rectangle, where its stationary points solve a quadratic equation. Every pair of a frequency and a
point of the rectangle is a motor of the box, so the supremum over frequency is the worst case itself, no
mere bound.

Between frequencies, for any motor, with u = log omega and T = 1 - S,

    d log S/du = -T (d log K/du - d log z/du)        |d log K/du - d log z/du| <= c

and so y = log(1 + 1/|S|) falls by no more than c |u - u0|. c comes from K's zeros and poles. Intervals are
halved until this bound is as near to what is reached as wanted: no peak can hide. A finite bound also says
that no pole crosses the imaginary axis, so if one motor of the box has a stable loop, all have.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from servobench.design.hinf.margins import highest
from servobench.design.hinf.mixed_sensitivity import Weight, Weights, axis_plant
from servobench.design.statespace import Array, ComplexArray, StateSpace, Zpk, connect, series, zpk

RELATIVE = 5e-4
"""Relative gap between the bound and the value reached."""
_EQUAL = 1e-9
"""Motors whose sensitivities differ by less are equally bad: the first is told, on every machine."""
_INTERVALS = 600
"""Intervals of the first pass. Any number from 10 to 2400 ends at the same bound in the same time: they are
halved until they close."""
_INTERVALS_MAX = 2_000_000
"""Limit of intervals open at once; beyond it the bound is infinite: true, but not close."""


@dataclass(frozen=True, slots=True)
class AxisBox:
    """r and L of one axis, each within +-``spread`` of nominal, ohm and H."""

    resistance_ohm: float
    inductance_h: float
    spread: float

    @property
    def resistances_ohm(self) -> tuple[float, float]:
        """Smallest and largest resistance."""
        return self.resistance_ohm * (1.0 - self.spread), self.resistance_ohm * (1.0 + self.spread)

    @property
    def inductances_h(self) -> tuple[float, float]:
        """Smallest and largest inductance."""
        return self.inductance_h * (1.0 - self.spread), self.inductance_h * (1.0 + self.spread)


@dataclass(frozen=True, slots=True)
class Worst:
    """The largest |w S|: reached by a motor of the box, and never exceeded by any."""

    reached: float
    bound: float
    resistance_ohm: float
    inductance_h: float
    frequency_rad_s: float


def worst_over_box(box: AxisBox, K: StateSpace, weight: Weight | None = None) -> Worst:
    """Find the worst motor of ``box`` for the continuous controller ``K``; ``weight`` None: 1.

    The bound is infinite where some motor's loop may be unstable.
    """
    form = zpk(K)
    rates = np.abs(np.concatenate([form.zeros, form.poles, [box.resistance_ohm / box.inductance_h]]))
    rates = rates[rates > 0.0]
    if weight is not None:
        rates = np.append(rates, [weight.pole_rad_s, weight.zero_rad_s])
    ends = np.log(np.array([rates.min() * 1e-4, rates.max() * 1e4]))
    edges = np.linspace(ends[0], ends[1], _INTERVALS + 1)
    low, high = edges[:-1], edges[1:]
    reached, worst = -math.inf, (math.nan, math.nan, math.nan)
    settled = max(_low_tail(box, form, weight, float(ends[0])), _high_tail(box, form, weight, float(ends[1])))
    while len(low):
        middle = np.exp(0.5 * (low + high))
        S, r, L = _largest(box, form, middle)
        gain = _gain(weight, middle) * S
        k = int(np.argmax(gain))
        if gain[k] > reached:
            reached, worst = float(gain[k]), (float(r[k]), float(L[k]), float(middle[k]))
        above = np.maximum(_gain(weight, np.exp(low)), _gain(weight, np.exp(high))) * _grown(
            box, form, low, high, S
        )
        if math.isinf(reached) or len(low) > _INTERVALS_MAX:
            return Worst(reached, math.inf, *worst)
        open_still = above > reached * (1.0 + RELATIVE)
        settled = max(settled, float(above[~open_still].max(initial=0.0)))
        low, high, half = low[open_still], high[open_still], 0.5 * (low + high)[open_still]
        low, high = np.concatenate([low, half]), np.concatenate([half, high])
    reached, worst = _polished(box, form, weight, reached, worst)
    return Worst(reached, max(settled, reached), *worst)


def _gain(weight: Weight | None, omega: Array) -> Array:
    if weight is None:
        return np.ones(len(omega))
    return weight.high * np.hypot(omega, weight.zero_rad_s) / np.hypot(omega, weight.pole_rad_s)


def _controller(form: Zpk, omega: Array) -> ComplexArray:
    s = 1j * omega
    value = np.full(len(omega), form.gain, dtype=complex)
    for k, pole in enumerate(form.poles):  # in turn, so that no product leaves the range of numbers
        value = value / (s - pole) if k >= len(form.zeros) else value * (s - form.zeros[k]) / (s - pole)
    return value


def _largest(box: AxisBox, form: Zpk, omega: Array) -> tuple[Array, Array, Array]:
    """Return the (k,) largest |S| over the box at the k frequencies, and its r and L."""
    k = _controller(form, omega)
    (x1, x2), (L1, L2) = box.resistances_ohm, box.inductances_h
    y1, y2 = omega * L1, omega * L2
    one = np.ones(len(omega))
    points = [(x * one, y) for x in (x1, x2) for y in (y1, y2)]
    for y in (y1, y2):
        points += [(np.clip(x, x1, x2), y) for x in _stationary(k.real, k.imag, y)]
    for x in (x1, x2):
        points += [(x * one, np.clip(y, y1, y2)) for y in _stationary(k.imag, k.real, x * one)]
    candidates = np.array([x + 1j * y for x, y in points])
    with np.errstate(divide="ignore"):
        S = np.abs(candidates / (candidates + k))
    best = np.argmax((1.0 - _EQUAL) * S.max(axis=0) <= S, axis=0)
    at = candidates[best, np.arange(len(omega))]
    pole_inside = (x1 <= -k.real) & (-k.real <= x2) & (y1 <= -k.imag) & (-k.imag <= y2)
    return np.where(pole_inside, math.inf, S.max(axis=0)), at.real, at.imag / omega


def _stationary(a: Array, b: Array, y: Array) -> tuple[Array, Array]:
    """Return x where (x^2 + y^2)/((x + a)^2 + (y + b)^2) is stationary: a x^2 + (a^2 + b^2 + 2 y b) x = a
    y^2."""
    half = 0.5 * (a * a + b * b + 2.0 * y * b)
    root = np.hypot(half, a * y)
    larger = -(half + np.copysign(root, half))
    safe = np.where(larger == 0.0, 1.0, larger)
    return larger / np.where(a == 0.0, 1e-300, a), -a * y * y / safe


def _grown(box: AxisBox, form: Zpk, low: Array, high: Array, S: Array) -> Array:
    """Return the (k,) bound of |S| over each interval from its largest value at the middle."""
    a, b = np.exp(low), np.exp(high)
    slope = _slope(form, a, b)
    r1, L2 = box.resistances_ohm[0], box.inductances_h[1]
    slope += b * L2 / np.hypot(b * L2, r1)
    left = np.log1p(1.0 / S) - slope * 0.5 * (high - low)
    return np.where(left > 0.0, 1.0 / np.expm1(np.maximum(left, 1e-300)), math.inf)


def _slope(form: Zpk, a: Array, b: Array) -> Array:
    """Bound |d log K/d log omega| between a and b: the sum of omega/|j omega - root| of all roots."""
    total = np.zeros(len(a))
    for root in np.concatenate([form.zeros, form.poles]):
        if root == 0.0:
            total += 1.0
            continue
        beside = np.maximum(np.maximum(a - root.imag, root.imag - b), 0.0)
        total += b / np.hypot(beside, root.real)
    return total


def _low_tail(box: AxisBox, form: Zpk, weight: Weight | None, end: float) -> float:
    """Bound |w S| below exp(``end``)."""
    a = np.exp(np.array([end]))
    w = float(max(_gain(weight, a)[0], _gain(weight, np.zeros(1))[0]))
    if np.any(form.poles == 0.0):  # |K| is as small as at the end, z as large
        k = 0.999 * abs(complex(_controller(form, a)[0]))
        z = math.hypot(box.resistances_ohm[1], float(a[0]) * box.inductances_h[1])
        return w * z / (k - z) if k > z else math.inf
    S = _largest(box, form, a)[0]
    # the slopes' sum falls with omega at least as omega itself: their integral is their value at the end
    change = _slope(form, a * 1e-300, a)[0] + float(a[0]) * box.inductances_h[1] / box.resistances_ohm[0]
    left = math.log1p(1.0 / float(S[0])) - change
    return w / math.expm1(left) if left > 0.0 else math.inf


def _high_tail(box: AxisBox, form: Zpk, weight: Weight | None, end: float) -> float:
    """Bound |w S| above exp(``end``), where z outgrows K."""
    b = math.exp(end)
    k = abs(form.gain) * b ** (len(form.zeros) - len(form.poles))
    k *= float(np.prod(1.0 + np.abs(form.zeros) / b) / np.prod(1.0 - np.abs(form.poles) / b))
    ratio = k / (b * box.inductances_h[0])
    w = 1.0 if weight is None else max(weight.high, weight.gain(b))
    return w / (1.0 - ratio) if ratio < 1.0 else math.inf


def _polished(
    box: AxisBox, form: Zpk, weight: Weight | None, reached: float, worst: tuple[float, float, float]
) -> tuple[float, tuple[float, float, float]]:
    """Climb to the top of the peak at the best frequency so far."""

    def depth(log_omega: float) -> float:
        omega = np.array([math.exp(log_omega)])
        return -float((_gain(weight, omega) * _largest(box, form, omega)[0])[0])

    at = math.log(worst[2])
    optimum = scipy.optimize.minimize_scalar(
        depth, bounds=(at - 0.1, at + 0.1), method="bounded", options={"xatol": 1e-10}
    )
    if -optimum.fun <= reached:
        return reached, worst
    omega = np.array([math.exp(optimum.x)])
    _, r, L = _largest(box, form, omega)
    return -float(optimum.fun), (float(r[0]), float(L[0]), float(omega[0]))


@dataclass(frozen=True, slots=True)
class AxisRobustness:
    """One axis over resistance and inductance, each within a box about nominal."""

    stable: bool
    """True if every motor of the box is stable, by the bound of the sensitivity."""
    real_mu_peak: float
    """Below 1: every motor of the box gives a stable loop; the box may grow by 1/mu."""
    real_mu_rad_s: float
    sensitivity: Worst
    """max |S|; 1 over it is the worst modulus margin."""
    weighted: Worst
    """max |w1 S|; 1 is the demand (41)."""

    @property
    def worst_modulus_margin(self) -> float:
        """Worst over all motors of the box; 0 if one is unstable."""
        return 1.0 / self.sensitivity.reached if self.stable else 0.0


def axis_robustness(
    resistance_ohm: float, inductance_h: float, K: StateSpace, weights: Weights, spread: float = 0.5
) -> AxisRobustness:
    """Return worst cases and mu for the continuous controller ``K`` of one axis."""
    box = AxisBox(resistance_ohm, inductance_h, spread)
    sensitivity, weighted = worst_over_box(box, K), worst_over_box(box, K, weights.error)
    nominal = connect(series(axis_plant(resistance_ohm, inductance_h), K), [[-1.0]], [[1.0]], [[1.0]])
    omega = _grid(K, resistance_ohm / inductance_h, weights.error.pole_rad_s)

    def mu(at: Array) -> Array:
        return axis_real_mu(resistance_ohm, inductance_h, K, at, spread)

    peak, at = highest(mu, omega, mu(omega), 1e-10)
    stable = nominal.is_stable() and math.isfinite(sensitivity.bound)
    return AxisRobustness(stable, peak, at, sensitivity, weighted)


def _grid(K: StateSpace, corner: float, slowest: float) -> Array:
    rates = np.abs(K.poles())
    high = math.log10(max(rates.max(), corner)) + 1.0
    return np.logspace(math.log10(slowest) - 2.0, high, 2400)


def axis_real_mu(
    resistance_ohm: float, inductance_h: float, K: StateSpace, omega: Array, spread: float
) -> Array:
    """Return the (k,) exact mu of one axis: 1 over the smallest box factor that puts a pole at j omega.

    1 + (a + j b) (x r + j w y L) = 0 with G S = a + j b has one real solution (x, y).
    """
    g = axis_plant(resistance_ohm, inductance_h).response(omega)[:, 0, 0]
    closed = g / (1.0 + g * K.response(omega)[:, 0, 0])
    target = -1.0 / closed
    x, y = target.real / (spread * resistance_ohm), target.imag / (spread * inductance_h * omega)
    return np.asarray(1.0 / np.maximum(np.abs(x), np.abs(y)), dtype=float)
