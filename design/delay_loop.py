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
from numpy.typing import ArrayLike, NDArray

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

    def with_delay(self, delay_s: float) -> "DelayLoop":
        """The same plant and gain with another delay."""
        return DelayLoop(self.A, self.B, self.K, self.E, self.C, delay_s)

    def with_gain(self, K: ArrayLike) -> "DelayLoop":
        """The same plant and delay with another gain."""
        return DelayLoop(self.A, self.B, np.asarray(K, dtype=float), self.E, self.C, self.delay_s)


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
        """|G(j w)| at the frequencies ``w`` in rad per time unit."""
        s = np.asarray(1j * w, dtype=np.complex128)
        turn = np.exp(-s * self.delay)
        values = [
            _value(part.plain, s) - turn * _value(part.delayed, s)
            for part in (self.numerator, self.denominator)
        ]
        return np.asarray(np.abs(values[0] / values[1]))


def _value(coefficients: Array, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
    total = np.full_like(s, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * s + coefficient
    return total


def characteristic_polynomial(M: Array) -> Array:
    """det(s I - M), ascending, by the Faddeev-LeVerrier recursion (exact up to rounding for small n)."""
    n = len(M)
    coefficients = np.zeros(n + 1)
    coefficients[n] = 1.0
    N = np.eye(n)
    for k in range(1, n + 1):
        MN = M @ N
        coefficients[n - k] = -np.trace(MN) / k
        N = MN + coefficients[n - k] * np.eye(n)
    return coefficients


def loop_function(loop: DelayLoop) -> LoopFunction:
    """The transfer function from d to z as quasi-polynomials.

    q is affine in e^{-s eta} because the feedback has rank one; so is
    n(s) = det(s I - A + E C - B K e^{-s eta}) - q(s), the rank of E C being one too.
    """
    unit = time_unit_s(loop)
    A, BK = loop.A * unit, loop.BK * unit
    # E C is made as large as the rest, so that the difference below keeps its digits.
    EC = np.outer(loop.E, loop.C) * unit
    size = float(np.linalg.norm(EC))
    EC = EC / size if size > 0.0 else EC
    denominator = _delay_split(A, BK)
    shifted = _delay_split(A - EC, BK)
    numerator = QuasiPolynomial(
        (shifted.plain - denominator.plain) * size, (shifted.delayed - denominator.delayed) * size
    )
    return LoopFunction(numerator, denominator, loop.delay_s / unit, unit)


def time_unit_s(loop: DelayLoop) -> float:
    """The delay; the inverse of the plant's fastest rate where that is slower or there is no delay."""
    rate = max(float(np.linalg.norm(loop.A, 2)), float(np.max(np.abs(np.linalg.eigvals(loop.A + loop.BK)))))
    unit = 1.0 / rate if rate > 0.0 else 1.0
    return max(unit, loop.delay_s)


def _delay_split(A: Array, BK: Array) -> QuasiPolynomial:
    plain = characteristic_polynomial(A)
    return QuasiPolynomial(plain, plain - characteristic_polynomial(A + BK))
