"""Linear time-invariant systems in state space, continuous or sampled, and their connections.

    x' = A x + B u (or x[k+1] = A x[k] + B u[k])        y = C x + D u

Every connection uses the parts' own matrices, without minimal realisation: states are never dropped silently.
Systems whose poles lie many decades apart keep their accuracy through :func:`balanced`.

The bilinear map between sampled and continuous systems: s = 2/T (z - 1)/(z + 1).

It keeps the norm, so a sampled plant has its H-infinity design in the bilinear plane.
"""

import math
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_DIRECT = 1e-14
"""A direct gain below this part of the gain through the states is a rounding error of zero."""


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace:
    """A: (n, n), B: (n, m), C: (p, n), D: (p, m); ``period_s``: sampling period, None if continuous."""

    A: Array
    B: Array
    C: Array
    D: Array
    period_s: float | None = None

    def __post_init__(self) -> None:
        """Error: ValueError if the shapes do not fit or a value is not finite."""
        n, (p, m) = len(self.A), self.D.shape
        shapes = (self.A.shape, self.B.shape, self.C.shape)
        if shapes != ((n, n), (n, m), (p, n)):
            raise ValueError(f"A, B, C of shapes {shapes} do not fit D {self.D.shape}")
        if not all(np.isfinite(part).all() for part in (self.A, self.B, self.C, self.D)):
            raise ValueError("a matrix of the system holds a value that is not finite")

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    def poles(self) -> ComplexArray:
        """Return the (n,) eigenvalues of A, by magnitude."""
        values = np.linalg.eigvals(balanced(self).A) if self.order else np.zeros(0)
        return np.asarray(values[np.argsort(np.abs(values), kind="stable")], dtype=complex)

    def is_stable(self) -> bool:
        """Return True if every pole lies in the open left half plane (sampled: the open unit disc)."""
        poles = self.poles()
        if self.period_s is None:
            return bool(np.all(poles.real < 0.0))
        return bool(np.all(np.abs(poles) < 1.0))

    def response(self, frequency_rad_s: ArrayLike) -> ComplexArray:
        """Return the (k, p, m) response at the k frequencies, rad/s; infinity gives D of a continuous
        system."""
        omega = np.atleast_1d(np.asarray(frequency_rad_s, dtype=float))
        result = np.empty((len(omega), *self.D.shape), dtype=complex)
        finite = np.isfinite(omega)
        result[~finite] = self.D
        points = 1j * omega[finite]
        if self.period_s is not None:
            points = np.exp(points * self.period_s)
        result[finite] = self.at(points)
        return result

    def at(self, points: ArrayLike) -> ComplexArray:
        """Return the (k, p, m) transfer matrix C (s I - A)^-1 B + D at the k complex ``points``."""
        s = np.atleast_1d(np.asarray(points, dtype=complex))
        if not self.order:
            return np.broadcast_to(self.D.astype(complex), (len(s), *self.D.shape)).copy()
        pencil = s[:, None, None] * np.eye(self.order) - self.A
        states = np.linalg.solve(pencil, np.broadcast_to(self.B, (len(s), *self.B.shape)).astype(complex))
        return np.asarray(self.C @ states + self.D, dtype=complex)

    def steady_gain(self) -> Array:
        """Return the (p, m) gain at rest: s = 0, or z = 1 of a sampled system; infinite with a pole there."""
        point = 0.0 if self.period_s is None else 1.0
        try:
            return np.asarray(self.at(point)[0].real, dtype=float)
        except np.linalg.LinAlgError:
            return np.full(self.D.shape, math.inf)

    def part(self, outputs: slice, inputs: slice) -> "StateSpace":
        """Return the same states seen through some ``outputs`` and ``inputs`` only."""
        return StateSpace(self.A, self.B[:, inputs], self.C[outputs], self.D[outputs, inputs], self.period_s)

    def scaled(self, left: ArrayLike, right: ArrayLike = 1.0) -> "StateSpace":
        """Return ``left`` times the system times ``right``; numbers or constant matrices."""
        p, m = self.D.shape
        L, R = _matrix(left, p), _matrix(right, m)
        return StateSpace(self.A, self.B @ R, L @ self.C, L @ self.D @ R, self.period_s)


@dataclass(frozen=True, slots=True)
class Peak:
    """The largest gain over frequency, and its place: rad/s, 0 and infinity included."""

    gain: float
    frequency_rad_s: float


def _matrix(factor: ArrayLike, size: int) -> Array:
    value: Array = np.asarray(factor, dtype=float)
    return value * np.eye(size) if value.ndim == 0 else np.atleast_2d(value)


def state_space(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, period_s: float | None = None
) -> StateSpace:
    """Make a system from matrix-like arguments; an empty A gives a static gain."""
    d = np.atleast_2d(np.asarray(D, dtype=float))
    a = np.asarray(A, dtype=float).reshape((round(math.sqrt(np.size(A))),) * 2)
    n = len(a)
    b = np.asarray(B, dtype=float).reshape(n, d.shape[1])
    return StateSpace(a, b, np.asarray(C, dtype=float).reshape(d.shape[0], n), d, period_s)


def first_order(high: float, zero: float, pole: float) -> StateSpace:
    """Return high (s + zero)/(s + pole)."""
    return state_space([[-pole]], [[1.0]], [[high * (zero - pole)]], [[high]])


def from_zpk(zeros: ArrayLike, poles: ArrayLike, gain: float, period_s: float | None = None) -> StateSpace:
    """Make the real SISO system gain * prod(s - zeros)/prod(s - poles): a cascade of sections of order 2 at
    most.

    Error: ValueError for more zeros than poles or a complex number without its conjugate.
    """
    pole_sections, zero_sections = _sections(poles), _sections(zeros)
    if sum(map(len, zero_sections)) - len(zero_sections) > sum(map(len, pole_sections)) - len(pole_sections):
        raise ValueError("more zeros than poles: the system would differentiate")
    sections = []
    for denominator in pole_sections:
        numerator: NDArray[Any] = np.ones(1)
        for candidate in list(zero_sections):
            if len(numerator) + len(candidate) - 1 <= len(denominator):
                numerator = np.polymul(numerator, candidate)
                zero_sections.remove(candidate)
        sections.append(_section(numerator, denominator, period_s))
    if zero_sections:  # a complex pair of zeros over two real poles
        return _companion(zeros, poles, gain, period_s)
    return reduce(lambda left, right: series(right, left), sections, _static(period_s)).scaled(gain)


def _companion(zeros: ArrayLike, poles: ArrayLike, gain: float, period_s: float | None) -> StateSpace:
    numerator = gain * np.real(np.poly(np.asarray(zeros)))
    return _section(np.atleast_1d(numerator), np.real(np.poly(np.asarray(poles))), period_s)


def _static(period_s: float | None) -> StateSpace:
    return state_space([], [], [], [[1.0]], period_s)


def _sections(roots: ArrayLike) -> list[list[float]]:
    """Return monic polynomials of real roots and conjugate pairs, the pairs first, then by magnitude."""
    values = np.atleast_1d(np.asarray(roots, dtype=complex))
    pairs = sorted((v for v in values if v.imag > 0.0), key=abs, reverse=True)
    below = [v for v in values if v.imag < 0.0]
    if len(pairs) != len(below):
        raise ValueError("a complex pole or zero without its conjugate")
    reals = sorted((float(v.real) for v in values if v.imag == 0.0), key=abs, reverse=True)
    return [[1.0, -2.0 * v.real, abs(v) ** 2] for v in pairs] + [[1.0, -v] for v in reals]


def _section(numerator: ArrayLike, denominator: ArrayLike, period_s: float | None) -> StateSpace:
    """Return the controllable companion form of numerator/denominator, the latter monic."""
    den = np.asarray(denominator, dtype=float)
    n = len(den) - 1
    num = np.concatenate([np.zeros(n + 1 - np.size(numerator)), np.atleast_1d(numerator)])
    A = np.vstack([-den[1:], np.eye(n)[:-1]])
    B = np.eye(n)[:, :1]
    return StateSpace(A, B, (num[1:] - num[0] * den[1:])[None, :], np.array([[num[0]]]), period_s)


def _period(*systems: StateSpace) -> float | None:
    periods = {system.period_s for system in systems}
    if len(periods) != 1:
        raise ValueError(f"systems of different sampling periods cannot be joined: {periods}")
    return periods.pop()


def series(last: StateSpace, first: StateSpace) -> StateSpace:
    """Return last(first(u))."""
    A = np.block([[first.A, np.zeros((first.order, last.order))], [last.B @ first.C, last.A]])
    B = np.vstack([first.B, last.B @ first.D])
    C = np.hstack([last.D @ first.C, last.C])
    return StateSpace(A, B, C, last.D @ first.D, _period(last, first))


def append(*systems: StateSpace) -> StateSpace:
    """Put the systems side by side: block diagonal."""
    from scipy.linalg import block_diag  # a third of a second, and an extra, that a run does without

    A, B, C, D = (block_diag(*(getattr(each, name) for each in systems)) for name in "ABCD")
    return StateSpace(A, B, C, D, _period(*systems))


def connect(system: StateSpace, feedback: ArrayLike, enter: ArrayLike, leave: ArrayLike) -> StateSpace:
    """Close constant links around ``system``: u = feedback y + enter r; the output is leave y.

    Error: ValueError if the links make an algebraic loop without solution.
    """
    K, E, L = (np.atleast_2d(np.asarray(part, dtype=float)) for part in (feedback, enter, leave))
    loop = np.eye(len(K)) - K @ system.D
    if np.linalg.cond(loop) > 1.0 / np.finfo(float).eps:
        raise ValueError("the algebraic loop through the direct gains has no solution")
    KC, KE = np.linalg.solve(loop, K @ system.C), np.linalg.solve(loop, E)
    C, D = system.C + system.D @ KC, system.D @ KE
    return StateSpace(system.A + system.B @ KC, system.B @ KE, L @ C, L @ D, system.period_s)


def lower_lft(plant: StateSpace, controller: StateSpace) -> StateSpace:
    """Return F_l(P, K): the last outputs of ``plant`` drive ``controller``, which drives its last inputs."""
    m2, p2 = controller.D.shape
    (p, m), joined = plant.D.shape, append(plant, controller)
    p1, m1 = p - p2, m - m2
    feedback = np.zeros((m + p2, p + m2))
    feedback[m1:m, p:] = np.eye(m2)
    feedback[m:, p1:p] = np.eye(p2)
    enter = np.eye(m + p2)[:, :m1]
    return connect(joined, feedback, enter, np.eye(p + m2)[:p1])


def state_scales(system: StateSpace) -> Array:
    """Return (n,) powers of two that balance rows and columns of A, B and C; inputs and outputs are
    unchanged."""
    n = system.order
    if not n:
        return np.ones(0)
    column = np.max(np.abs(system.B), axis=1, initial=0.0)
    row = np.max(np.abs(system.C), axis=0, initial=0.0)
    framed = np.zeros((n + 1, n + 1))
    framed[:n, :n], framed[:n, n], framed[n, :n] = np.abs(system.A), column, row
    scale = balancing_scales(framed)
    return np.asarray(scale[:n] / scale[n], dtype=float)


def balancing_scales(matrix: Array) -> Array:
    """Return (n,) powers of two t for which diag(1/t) ``matrix`` diag(t) has rows and columns of like
    size."""
    from scipy.linalg import lapack  # as above

    _, _, _, scale, _ = lapack.dgebal(matrix, scale=1, permute=0)
    return np.asarray(scale, dtype=float)


def balanced(system: StateSpace) -> StateSpace:
    """Return the same system with its states scaled by :func:`state_scales`."""
    scale = state_scales(system)
    return StateSpace(
        system.A * scale / scale[:, None],
        system.B / scale[:, None],
        system.C * scale,
        system.D,
        system.period_s,
    )


def zeros(system: StateSpace) -> ComplexArray:
    """Return the finite zeros of a SISO system, by magnitude; none of a system that is zero itself.

    An output without direct gain is held at zero by the states in the null space of C, whose derivative
    C (A x + B u) takes the output's place: one state fewer a turn, until the input acts directly.
    """
    from scipy.linalg import null_space  # as above

    even = balanced(system)
    A, B, C, D = even.A, even.B, even.C, even.D
    while len(A):
        through_states = np.linalg.norm(B) * np.linalg.norm(C) / (np.linalg.norm(A) or math.inf)
        if abs(D[0, 0]) > _DIRECT * through_states:
            values = np.linalg.eigvals(rebalanced(A - B @ C / D[0, 0]))
            return np.asarray(values[np.argsort(np.abs(values), kind="stable")], dtype=complex)
        if not np.any(C):
            break
        N = null_space(C)
        A, B, C, D = N.T @ A @ N, N.T @ B, C @ A @ N, C @ B
    return np.zeros(0, dtype=complex)


def rebalanced(A: Array) -> Array:
    """Scale ``A`` by :func:`balancing_scales`: the same eigenvalues, more exact."""
    scale = balancing_scales(A)
    return np.asarray(A * scale / scale[:, None], dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class Zpk:
    """gain * prod(s - zeros)/prod(s - poles) of a SISO system."""

    zeros: ComplexArray
    poles: ComplexArray
    gain: float


def zpk(system: StateSpace) -> Zpk:
    """Return zeros, poles and gain of a SISO system; the gain is read at a point away from both."""
    finite, poles = zeros(system), system.poles()
    everything = np.concatenate([finite, poles, [1.0]])
    point = 1.7 * np.abs(everything).max()
    ratio = np.prod((point - poles) / point) / np.prod((point - finite) / point)
    gain = system.at(point)[0, 0, 0] * ratio * point ** (len(poles) - len(finite))
    return Zpk(finite, poles, float(gain.real))


def tustin(system: StateSpace, rate_hz: float, exact_at_rad_s: float = 0.0) -> StateSpace:
    """Return the bilinear image of ``system``; its response is kept exactly at ``exact_at_rad_s``
    (prewarping).

    Error: ValueError for a prewarping frequency at or above half of the sampling rate.
    """
    period_s = 1.0 / rate_hz
    if not 0.0 <= exact_at_rad_s * period_s < math.pi:
        raise ValueError(
            f"more than {exact_at_rad_s / math.pi:.3g} Hz, for the loop crosses at {exact_at_rad_s:.4g} "
            "rad/s; sample faster, or lower the crossing of w1"
        )
    half = 0.5 * period_s
    if exact_at_rad_s > 0.0:
        half = math.tan(exact_at_rad_s * half) / exact_at_rad_s
    even = balanced(system)
    inverse = np.linalg.inv(np.eye(even.order) - half * even.A)
    A = inverse @ (np.eye(even.order) + half * even.A)
    root = math.sqrt(2.0 * half)
    return StateSpace(
        A,
        root * inverse @ even.B,
        root * even.C @ inverse,
        even.D + half * even.C @ inverse @ even.B,
        period_s,
    )


def from_bilinear(system: StateSpace, period_s: float) -> StateSpace:
    """Return the sampled system of a ``system`` in the bilinear plane: Tustin's rule without prewarping."""
    return tustin(system, 1.0 / period_s)


def to_bilinear(system: StateSpace) -> StateSpace:
    """Invert :func:`from_bilinear`. Error: ValueError for a pole at z = -1."""
    period_s = system.period_s
    if period_s is None:
        raise ValueError("a sampled system is expected")
    half, n = 0.5 * period_s, system.order
    inverse = np.linalg.inv(system.A + np.eye(n))
    root = math.sqrt(2.0 / half)
    return StateSpace(
        (system.A - np.eye(n)) @ inverse / half,
        root * inverse @ system.B,
        root * system.C @ inverse,
        system.D - system.C @ inverse @ system.B,
    )
