"""A linear loop with one constant delay in its feedback, and its characteristic function.

    x'(t) = A x(t) + B K x(t - eta) + E d(t)        z(t) = C x(t)

with one control input and one disturbance, [Ling2012] (2.15). Its transfer function from d to z is
a ratio of quasi-polynomials, which are found once, without forming matrix inverses:

    G(s) = n(s)/q(s),   q(s) = det(s I - A - B K e^{-s eta}) = a(s) - b(s) e^{-s eta}

Time is counted in ``time_unit_s`` inside the quasi-polynomials, so that their coefficients are of
like size whatever the plant's rates.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class DelayLoop:
    """The loop above: A (n, n), B, K, E and C (n,), delay eta in s."""

    A: Array
    B: Array
    K: Array
    E: Array
    C: Array
    delay_s: float

    def __post_init__(self) -> None:
        n = len(self.A)
        if self.A.shape != (n, n) or any(v.shape != (n,) for v in (self.B, self.K, self.E, self.C)):
            raise ValueError(f"A is {self.A.shape}; B, K, E and C must be vectors of its size")
        if not (self.delay_s >= 0.0 and np.isfinite(self.delay_s)):
            raise ValueError(f"a delay of {self.delay_s} s")

    @property
    def BK(self) -> Array:
        """Matrix of the delayed state, (n, n)."""
        return np.outer(self.B, self.K)


@dataclass(frozen=True, slots=True, eq=False)
class QuasiPolynomial:
    """p(s) - r(s) e^{-s delay}; coefficients in ascending powers of s, (n + 1,) each."""

    plain: Array
    delayed: Array


@dataclass(frozen=True, slots=True, eq=False)
class LoopFunction:
    """G = numerator/denominator of a :class:`DelayLoop`, with time counted in ``time_unit_s``.

    ``delay``: the loop's delay in that unit. The denominator's plain part is monic of degree n.
    """

    numerator: QuasiPolynomial
    denominator: QuasiPolynomial
    delay: float
    time_unit_s: float

    def magnitude(self, w: Array) -> Array:
        """Return |G(j w)| at the frequencies ``w`` in rad per time unit."""
        s = np.asarray(1j * w, dtype=np.complex128)
        parts = [each for part in (self.numerator, self.denominator) for each in (part.plain, part.delayed)]
        coefficients = np.array(parts).reshape(2, 2, -1, *[1] * s.ndim)
        values = np.zeros((2, 2, *s.shape), dtype=np.complex128)
        for place in range(coefficients.shape[2] - 1, -1, -1):
            values = values * s + coefficients[:, :, place]
        n, q = values[:, 0] - np.exp(-s * self.delay) * values[:, 1]
        return np.asarray(np.abs(n / q))


def _resolvent(M: Array) -> tuple[Array, Array]:
    """Return det(s I - M), (m, n + 1), and adj(s I - M), (n, m, n, n), ascending, for each of M (m, n, n).

    By the recursion of Faddeev and LeVerrier, exact up to rounding for small n.
    """
    n = M.shape[-1]
    determinant, adjugate = np.ones((len(M), n + 1)), np.zeros((n, *M.shape))
    N = np.broadcast_to(np.eye(n), M.shape)
    for k in range(1, n + 1):
        adjugate[n - k] = N
        MN = M @ N
        determinant[:, n - k] = -np.trace(MN, axis1=1, axis2=2) / k
        N = MN + determinant[:, n - k, None, None] * np.eye(n)
    return determinant, adjugate


def loop_function(loop: DelayLoop, unit_s: float | None = None) -> LoopFunction:
    """Return the transfer function from d to z as quasi-polynomials; ``unit_s``: unit of time, if not the
    loop's own.

    q = det(s I - A) - K adj(s I - A) B e^{-s eta} is affine in e^{-s eta} because the feedback has rank one,
    and so is n = C adj(s I - A - B K e^{-s eta}) E: its value without delay gives the delayed part.
    """
    n = len(loop.A)
    determinant, adjugate = _resolvent(np.stack([loop.A, loop.A + loop.BK]))
    unit = unit_s or _time_unit_s(determinant, loop.delay_s)
    scale = unit ** np.arange(n, -1.0, -1.0)
    numerator = np.vstack([adjugate @ loop.E @ loop.C, np.zeros(2)]) * scale[:, None]
    returned = np.append(adjugate[:, 0] @ loop.B @ loop.K, 0.0) * scale
    return LoopFunction(
        QuasiPolynomial(numerator[:, 0], numerator[:, 0] - numerator[:, 1]),
        QuasiPolynomial(determinant[0] * scale, returned),
        loop.delay_s / unit,
        unit,
    )


def _time_unit_s(determinant: Array, delay_s: float) -> float:
    """Return the delay; the inverse of the fastest rate, within a small factor, where that is slower.

    ``determinant``: (m, n + 1) characteristic polynomials.
    """
    n = determinant.shape[1] - 1
    rate = float(np.max(np.abs(determinant[:, :n]) ** (1.0 / np.arange(n, 0.0, -1.0)), initial=0.0))
    return max(1.0 / rate if rate > 0.0 else 1.0, delay_s)
