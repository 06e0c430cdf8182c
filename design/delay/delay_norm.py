"""Exact stability and H-infinity norm of a loop with one constant delay.

Stability: the roots of q(s) = a(s) - b(s) e^{-s eta} cross the imaginary axis only where
W(w^2) = |a(jw)|^2 - |b(jw)|^2 = 0, at delays that repeat every 2 pi/w, all in the direction of
sign W' (Walton and Marshall, IEE Proc. D 134(2), 1987). Counting the crossings from the roots at
no delay gives the number of unstable roots at any delay, and the largest stable delay in closed form.

Norm: |G(jw)| <= gamma is the sign of one real function of w, polynomials times cos and sin of w eta, whose
second derivative is bounded on any interval. Intervals are halved until that bound shows the sign on each; a
point with the wrong sign is climbed to its summit and the search begins anew from there. The result is thus a
supremum up to a stated tolerance, whatever its peaks.

The delay at which the norm first exceeds gamma needs no search over delays: at each w that function is U -
2 |V| cos(w eta + arg V), where U and V do not depend on eta, so the first eta that makes it positive is known
in closed form. The roots of U^2 - 4 |V|^2 bound the frequencies at which there is one at all.

Between two current loops: the rate stands in one row of A and B K, so that n and q are affine in it, and
|n|^2 - gamma^2 |q|^2 departs from its chord between the two by gamma^2 |q_2 - q_1|^2/4 at most.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import Array, DelayLoop, LoopFunction, QuasiPolynomial, loop_function
from servobench.design.statespace import Peak

NORM_TOLERANCE = 1e-8
"""Relative: no frequency has a gain beyond the norm that is returned times one plus this."""
_RAISED = (1e-4, 1e-3, 1e-2, 0.03)
"""Relative: so much above the larger norm of two loops a bound for all between them is tried."""
_ROUGH_LOOK = np.append(0.0, np.geomspace(1e-3, 30.0, 60))
"""In rad per delay, or per time of the fastest rate where that is longer."""
_AT_AXIS = 1e-12
"""Relative distance from the imaginary axis below which a root counts as on it."""
_LOOKS = 0.5 - 0.5 * np.cos(np.linspace(0.0, math.pi, 35)[1:-1])
"""Places between two of those roots, dense at the ends."""
_FOLLOWED = 1.1
"""Multiple of the least delay among them up to which one is followed to its minimum."""
_CELL_MIN = 1e-11
"""Relative width at which a cell is given up to rounding; its values then differ by less than that."""


@dataclass(frozen=True, slots=True)
class Crossing:
    """A pair of roots on the imaginary axis at s = +-j w, at the delays first, first + 2 pi/w, ..."""

    frequency_rad_s: float
    first_delay_s: float
    destabilising: bool


def crossings(loop: DelayLoop) -> list[Crossing]:
    """Return every crossing of the imaginary axis as the delay grows from 0, by frequency."""
    function = loop_function(loop)
    a, b = function.denominator.plain, function.denominator.delayed
    W = _magnitude_squared(a) - _magnitude_squared(b)
    angles = []
    for root in _roots(W):
        if abs(root.imag) > 1e-9 * abs(root) or root.real <= 0.0:
            continue
        w = math.sqrt(root.real)
        ratio = _at(a, 1j * w) / _at(b, 1j * w)
        delay = -cmath.phase(ratio) % (2.0 * math.pi) / w
        slope = _at(W[1:] * np.arange(1.0, len(W)), root.real).real
        angles.append(Crossing(w / function.time_unit_s, delay * function.time_unit_s, slope >= 0.0))
    return sorted(angles, key=lambda crossing: crossing.frequency_rad_s)


def unstable_roots(loop: DelayLoop) -> int:
    """Return the number of characteristic roots with a real part that is not negative."""
    roots = np.linalg.eigvals(loop.A + loop.BK)
    scale = max(float(np.max(np.abs(roots))), float(np.linalg.norm(loop.A)))
    count = int(np.count_nonzero(roots.real >= -_AT_AXIS * scale))
    for crossing in crossings(loop):
        turn_s = 2.0 * math.pi / crossing.frequency_rad_s
        # The first delay may be a rounding error below a whole turn: then it is no delay at all.
        first_s = crossing.first_delay_s
        passed = max(0, math.floor((loop.delay_s - first_s) / turn_s * (1.0 + _AT_AXIS) + _AT_AXIS) + 1)
        count += 2 * passed if crossing.destabilising else -2 * passed
    return count


def is_stable(loop: DelayLoop) -> bool:
    """Return True if every characteristic root is in the open left half-plane."""
    return unstable_roots(loop) == 0


def largest_stable_delay_s(loop: DelayLoop) -> float:
    """Return the delay up to which the loop is stable; inf if it is stable for any, 0 if it is not even
    without."""
    if not is_stable(replace(loop, delay_s=0.0)):
        return 0.0
    firsts = [crossing.first_delay_s for crossing in crossings(loop) if crossing.destabilising]
    return min(firsts, default=math.inf)


def first_delay_beyond_s(loop: DelayLoop, gain: float) -> float:
    """Return the delay at which the norm first exceeds ``gain``, whatever that of ``loop``; inf if none does.

    0 if the norm does so without delay, or the loop is unstable there.
    """
    undelayed = replace(loop, delay_s=0.0)
    if not is_stable(undelayed):
        return 0.0
    function = loop_function(undelayed)
    sign = _SignFunction(function, gain, None)
    # of even powers, those of U times 1 and those of |V|^2 alike
    square = np.convolve(sign.U, sign.U)
    both = np.convolve(sign.V, np.conj(sign.V)).real
    roots = np.polynomial.polynomial.polyroots((square - 4.0 * both)[::2]).astype(complex)
    end = _tail_start(function, gain)
    edges = np.sqrt(np.append(np.abs(roots[(np.abs(roots) > 0.0) & (np.abs(roots) < end * end)]), end**2))
    edges = np.sort(np.concatenate([[1e-9 * end], edges]))
    inside = (edges[:-1, None] + np.diff(edges)[:, None] * _LOOKS).ravel()
    w = np.union1d(np.append(edges, inside), np.geomspace(1e-4 * end, end, 120))
    delays = sign.first_delay(w)
    if sign.on_cells(np.zeros(1), np.zeros(1))[0][0] > 0.0:
        return 0.0
    inner = np.flatnonzero((delays[1:-1] <= delays[:-2]) & (delays[1:-1] <= delays[2:])) + 1
    least = float(np.min(delays))
    inner = inner[delays[inner] <= _FOLLOWED * least]
    if len(inner) and math.isfinite(least) and least > 0.0:
        tops, _ = _summits(lambda w: -sign.first_delay(w), w[inner - 1], w[inner + 1])
        least = min(least, -float(np.max(tops)))
    return least * function.time_unit_s


def hinf_norm(loop: DelayLoop) -> float:
    """Return sup over w of |G(jw)| in units of z per unit of d; inf if the loop is unstable."""
    return hinf_peak(loop).gain


def hinf_peak(loop: DelayLoop) -> Peak:
    """Return the norm and the frequency of the peak (0 for an unstable loop); see :func:`hinf_norm`."""
    if not is_stable(loop):
        return Peak(math.inf, 0.0)
    function = loop_function(loop)
    gain, w = _climb(function, _first_look(function))
    if gain == 0.0:
        return Peak(0.0, 0.0)
    while True:
        above = _point_above(function, gain * (1.0 + NORM_TOLERANCE), _tail_start(function, gain))
        if above is None:
            return Peak(gain, w / function.time_unit_s)
        higher, at = _climb(function, above)
        # A summit that is no higher was a rounding error of the sign; the search may end there.
        if higher <= gain * (1.0 + NORM_TOLERANCE):
            return Peak(max(gain, higher), (at if higher > gain else w) / function.time_unit_s)
        gain, w = higher, at


def norm_between(one: DelayLoop, other: DelayLoop) -> float:
    """Bound the norm of every loop whose current loop has a rate between those of the two.

    inf if no bound was shown, or one of the two is unstable. If it is finite no loop between them is
    unstable: no root can reach the imaginary axis.
    """
    largest = max(hinf_norm(one), hinf_norm(other))
    if math.isinf(largest):
        return math.inf
    unit_s = max(loop_function(loop).time_unit_s for loop in (one, other))
    functions = [loop_function(loop, unit_s) for loop in (one, other)]
    first, second = (function.denominator for function in functions)
    apart = QuasiPolynomial(0.5 * (second.plain - first.plain), 0.5 * (second.delayed - first.delayed))
    for raised in _RAISED:
        gain = largest * (1.0 + raised)
        ends = [_tail_start(function, gain, apart) for function in functions]
        if all(
            _point_above(function, gain, end, apart) is None
            for function, end in zip(functions, ends, strict=True)
        ):
            return gain
    return math.inf


def peaks(loop: DelayLoop, share: float = 0.5) -> list[Peak]:
    """Return local maxima of |G| found by sampling, those above ``share`` of the largest; w = 0 always first.

    Quick, and without the proof of :func:`hinf_peak`: for searches that evaluate many loops.
    """
    function = loop_function(loop)
    w = _first_look(function)
    gains = function.magnitude(w)
    inner = np.flatnonzero((gains[1:-1] >= gains[:-2]) & (gains[1:-1] > gains[2:])) + 1
    inner = inner[gains[inner] >= 0.9 * share * np.max(gains)]
    all_peaks = [Peak(float(gains[0]), 0.0)]
    if len(inner):
        gain, at = _zoom(function, w[inner - 1], w[inner + 1])
        all_peaks += [Peak(float(g), float(x) / function.time_unit_s) for g, x in zip(gain, at, strict=True)]
    return all_peaks


def sampled_norm(loop: DelayLoop) -> float:
    """Return the norm of a loop known to be stable, without the proof: the largest of :func:`peaks`."""
    return max(peak.gain for peak in peaks(loop, share=0.8))


def rough_norm(loop: DelayLoop) -> float:
    """Return the largest of |G| at a few frequencies, none far from the peak: its size is enough for units.

    inf or nan where one of them is a root, as without friction and without feedback of the speed.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.max(loop_function(loop).magnitude(_ROUGH_LOOK)))


def _magnitude_squared(p: Array) -> Array:
    """Return |p(jw)|^2 as a polynomial in w^2, ascending."""
    mirrored = p * (-1.0) ** np.arange(len(p))
    even = np.convolve(p, mirrored)[::2]
    return np.asarray(even * (-1.0) ** np.arange(len(even)))


def _at(p: Array, at: complex) -> complex:
    """Return the polynomial's value; for one place Horner's rule is ten times as fast as an array's."""
    value = 0j
    for coefficient in reversed(p.tolist()):
        value = value * at + coefficient
    return value


def _roots(p: Array) -> list[complex]:
    """Return the roots: those of degree 2, as of a motor's speed loop, in closed form."""
    if len(p) != 3 or p[2] == 0.0:
        return [complex(root) for root in np.atleast_1d(np.polynomial.polynomial.polyroots(p))]
    half, product = -0.5 * complex(p[1] / p[2]), complex(p[0] / p[2])
    apart = cmath.sqrt(half * half - product)
    far = half + apart if (half.conjugate() * apart).real >= 0.0 else half - apart
    return [product / far if far else far, far]


def _first_look(function: LoopFunction) -> Array:
    """Return frequencies, 0 first, that show every ordinary peak: some per turn of the delay, some per
    decade."""
    end = _tail_start(function, 0.02 * max(float(function.magnitude(np.zeros(1))[0]), 1e-300))
    end = min(max(end, 1.0), 1e4)
    turns = np.linspace(0.0, min(end, 30.0), 181)
    decades = np.geomspace(1e-4 * end, end, 160)
    return np.union1d(turns, decades)


def _climb(function: LoopFunction, w: Array) -> tuple[float, float]:
    """Return the highest point around the samples: (gain, w)."""
    gains = function.magnitude(w)
    top = int(np.argmax(gains))
    low, high = w[max(top - 1, 0)], w[min(top + 1, len(w) - 1)]
    gain, at = _zoom(function, np.array([low]), np.array([high]))
    if gains[top] >= gain[0]:
        return float(gains[top]), float(w[top])
    return float(gain[0]), float(at[0])


def _zoom(function: LoopFunction, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the highest point inside each interval [low, high], to some 1e-13 of its gain: (gains,
    frequencies)."""
    return _summits(function.magnitude, low, high)


def _summits(height: Callable[[Array], Array], low: Array, high: Array) -> tuple[Array, Array]:
    steps = np.linspace(0.0, 1.0, 15)
    for _ in range(9):
        w = low[:, None] + (high - low)[:, None] * steps
        gains = height(w)
        top = np.argmax(gains, axis=1)
        rows = np.arange(len(low))
        low, high = w[rows, np.maximum(top - 1, 0)], w[rows, np.minimum(top + 1, 14)]
    return gains[rows, top], w[rows, top]


def _tail_start(function: LoopFunction, gain: float, apart: QuasiPolynomial | None = None) -> float:
    """Return a frequency beyond which |G| stays below ``gain``: there s^n outweighs the rest, ``apart``
    included."""
    top = np.abs(function.numerator.plain) + np.abs(function.numerator.delayed)
    if apart is not None:
        top = top + gain * (np.abs(apart.plain) + np.abs(apart.delayed))
    rest = np.abs(function.denominator.plain) + np.abs(function.denominator.delayed)
    rest[-1] = np.abs(function.denominator.delayed[-1])
    w = 1.0
    for _ in range(200):
        powers = w ** np.arange(len(top), dtype=float)
        slack = powers[-1] - rest @ powers
        if slack > 0.0 and top @ powers <= gain * slack:
            return w
        w *= 1.5
    return w


def _point_above(
    function: LoopFunction, gain: float, end: float, apart: QuasiPolynomial | None = None
) -> Array | None:
    """Return samples around a frequency in [0, end] where |G| > ``gain``; None if there is provably none.

    ``apart``: |n|^2 + gain^2 |apart|^2 > gain^2 |q|^2 instead.
    """
    sign = _SignFunction(function, gain, apart)
    edges = np.linspace(0.0, end, max(16, int(end * 2.0) + 1) if end < 1e5 else 4096)
    centre, radius = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    while len(centre):
        value, largest = sign.on_cells(centre, radius)
        above = np.flatnonzero(value > 0.0)
        if len(above):
            c, r = centre[above[0]], radius[above[0]]
            return np.array([max(c - r, 0.0), c, c + r])
        undecided = (largest > 0.0) & (radius > _CELL_MIN * (1.0 + centre))
        half = 0.5 * radius[undecided]
        centre = np.concatenate([centre[undecided] - half, centre[undecided] + half])
        radius = np.concatenate([half, half])
    return None


class _SignFunction:
    """f(w) = |n(jw)|^2 - gain^2 |q(jw)|^2 = U(w) - 2 Re(e^{j w delay} V(w)), and bounds on a cell.

    ``apart``: gain^2 |apart(jw)|^2 more.
    """

    def __init__(self, function: LoopFunction, gain: float, apart: QuasiPolynomial | None) -> None:
        square = gain * gain
        parts = [(function.numerator, 1.0), (function.denominator, -square)]
        if apart is not None:
            parts.append((apart, square))
        U, V = np.zeros(1), np.zeros(1, dtype=complex)
        for part, weight in parts:
            plain, delayed = _along_axis(part.plain), _along_axis(part.delayed)
            U = U + weight * (_product(plain, plain) + _product(delayed, delayed)).real
            V = V + weight * _product(plain, delayed)
        self._delay = function.delay
        self.U, self.V = U.real, V
        both = [U.astype(complex), V]
        rates = [_derivative(p) for p in both]
        bends = [_derivative(p) for p in rates]
        self._at_centre = np.stack([*both, *rates], axis=1)
        self._within = np.abs(np.stack([bends[0], V, rates[1], bends[1]], axis=1))

    def first_delay(self, w: Array) -> Array:
        """Return the first delay that makes f positive at each frequency; inf if none does."""
        U, V = (np.polynomial.polynomial.polyval(w, part) for part in (self.U, self.V))
        reach, phase = np.abs(V), np.angle(V)
        bound = np.arccos(np.clip(U / np.maximum(2.0 * reach, 1e-300), -1.0, 1.0))
        first = np.where(np.abs(phase) > bound, 0.0, bound - phase)
        return np.asarray(np.where(U + 2.0 * reach <= 0.0, math.inf, first / w))

    def on_cells(self, centre: Array, radius: Array) -> tuple[Array, Array]:
        """Return f at the centres and a bound of f on each cell, from its derivatives there or for any
        phase."""
        powers = np.arange(float(len(self._at_centre)))
        turn, h = np.exp(1j * centre * self._delay), self._delay
        U, V, dU, dV = (centre[:, None] ** powers @ self._at_centre).T
        f = U.real - 2.0 * np.real(turn * V)
        slope = dU.real - 2.0 * np.real(turn * (dV + 1j * h * V))
        U2, V0, V1, V2 = ((centre + radius)[:, None] ** powers @ self._within).T
        bend = U2 + 2.0 * (V2 + 2.0 * h * V1 + h * h * V0)
        at_any_phase = U.real + 2.0 * np.abs(V) + (np.abs(dU) + 2.0 * np.abs(dV)) * radius
        at_any_phase += 0.5 * (U2 + 2.0 * V2) * radius**2
        return f, np.minimum(f + np.abs(slope) * radius + 0.5 * bend * radius**2, at_any_phase)


def _derivative(p: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the derivative with as many coefficients, the last one 0."""
    return np.append(p[1:] * np.arange(1.0, len(p)), 0.0)


def _along_axis(p: Array) -> NDArray[np.complex128]:
    """Return the coefficients of p(jw) in w."""
    return np.asarray(p * 1j ** np.arange(len(p)))


def _product(p: NDArray[np.complex128], q: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return p(w) conj(q(w)) for real w."""
    return np.convolve(p, np.conj(q))
