"""Matrices that depend on one parameter, as polynomials with a bound of what is left.

sum over i <= m of C_i u^i  +  u^(m + 1) X        |X| <= rest, entry by entry        -1 <= u <= 1
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array


class TaylorMap(NamedTuple):
    """One, or a batch of them."""

    coefficients: Array
    """(m + 1, .., a, b)."""
    rest: Array
    """(.., a, b)."""

    def after(self, first: "TaylorMap") -> "TaylorMap":
        """Return the product of this and ``first``."""
        one, other = self.coefficients, first.coefficients
        order = len(one) - 1
        sizes, first_sizes = np.abs(one), np.abs(other)
        rest = sizes.sum(axis=0) @ first.rest + self.rest @ (first_sizes.sum(axis=0) + first.rest)
        for i in range(order + 1):
            for j in range(order + 1 - i, order + 1):
                rest = rest + sizes[i] @ first_sizes[j]
        return TaylorMap(np.array(products(one, other)[: order + 1]), rest)

    def under(self, J: Array) -> "TaylorMap":
        """Return J times this."""
        return TaylorMap(J @ self.coefficients, np.abs(J) @ self.rest)

    def of(self, part: slice | int) -> "TaylorMap":
        """Return some rows, or one of a batch."""
        return TaylorMap(self.coefficients[:, part], self.rest[part])


def products(one: Array, other: Array) -> list[Array]:
    """Return every coefficient (2 m + 1) of the product of two polynomials with matrices as coefficients."""
    order = len(one) - 1
    return [
        sum((one[i] @ other[n - i] for i in range(max(0, n - order), min(n, order) + 1)), np.zeros(()))
        for n in range(2 * order + 1)
    ]


def constant(M: Array, order: int) -> TaylorMap:
    """Return a matrix that does not depend on u."""
    return TaylorMap(np.array([M] + [np.zeros_like(M)] * order), np.zeros_like(M))


def exponential(G: Array, slope: Array, shares: Array, order: int) -> TaylorMap:
    """Return e^{s (G + u slope)} (q, q) for each s > 0 of ``shares`` (N,).

    Its i-th derivative over i! is an i-fold integral of products of exponentials and slopes: a block of the
    exponential of a larger matrix (Van Loan, IEEE Trans. Autom. Control 23(3), 1978). The same of moduli,
    the diagonal excepted, bounds it for every u.
    """
    q = len(G)
    coefficients = _blocks(G, slope, shares, order)
    largest = np.abs(G) + np.abs(slope)
    np.fill_diagonal(largest, np.diag(G) + np.abs(np.diag(slope)))
    rest = _blocks(largest, np.abs(slope), shares, order + 1)[-1]
    return TaylorMap(coefficients, rest.reshape(len(shares), q, q))


def _blocks(G: Array, slope: Array, shares: Array, order: int) -> Array:
    q = len(G)
    larger = np.kron(np.eye(order + 1), G) + np.kron(np.eye(order + 1, k=1), slope)
    first = expm(shares[:, None, None] * larger)[:, :q]
    return np.asarray(first.reshape(len(shares), q, order + 1, q).transpose(2, 0, 1, 3))


def control_points(order: int) -> Array:
    """Return (m + 1, m + 1): coefficients to Bernstein coefficients on -1 <= u <= 1, whose hull holds every
    value."""
    points = np.zeros((order + 1, order + 1))
    for i in range(order + 1):
        powers = [math.comb(i, k) * 2.0**k * (-1.0) ** (i - k) for k in range(i + 1)]  # of (2 t - 1)^i
        for j in range(order + 1):
            points[j, i] = sum(
                math.comb(j, k) / math.comb(order, k) * powers[k] for k in range(min(i, j) + 1)
            )
    return points
