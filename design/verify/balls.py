"""Matrices that are known up to rounding: balls of many bits, and doubles with a radius.

Exponentials and inverses come from ball arithmetic (python-flint). Where thousands of small matrices are
needed, midpoint and radius go through numpy, each product with the bound of its own rounding. A matrix is
positive definite if its Cholesky factorisation succeeds after its radius and the bound of the
factorisation's own rounding have been taken off (Rump, BIT Numerical Mathematics 46, 2006).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx, fmpq

ctx.prec = 192
"""Bits of the ball arithmetic: a period of the stiffest loop loses some sixty of them."""
UNIT = 2.0**-53
GREATER = 1.0 + 1e-12
"""Makes up for the rounding of radii, which are sums of a few hundred terms."""


class NotProved(Exception):
    """An inequality that could not be shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Ball:
    """Matrices (..., n, m) that lie within ``rad`` of ``mid``, entry by entry."""

    mid: np.ndarray
    rad: np.ndarray

    def __matmul__(self, other: "Ball") -> "Ball":
        one, two = np.abs(self.mid), np.abs(other.mid)
        rounding = (self.mid.shape[-1] + 2) * UNIT * (one @ two)
        rad = one @ other.rad + self.rad @ (two + other.rad) + rounding
        return Ball(self.mid @ other.mid, GREATER * rad + 1e-300)

    def __add__(self, other: "Ball") -> "Ball":
        mid = self.mid + other.mid
        return Ball(mid, GREATER * (self.rad + other.rad + UNIT * np.abs(mid)))

    def __sub__(self, other: "Ball") -> "Ball":
        return self + Ball(-other.mid, other.rad)

    def __getitem__(self, part: Any) -> "Ball":
        return Ball(self.mid[part], self.rad[part])

    @property
    def T(self) -> "Ball":
        """The transposed matrices."""
        return Ball(np.swapaxes(self.mid, -1, -2), np.swapaxes(self.rad, -1, -2))

    @property
    def above(self) -> np.ndarray:
        """An upper bound of each magnitude."""
        return np.asarray(GREATER * (np.abs(self.mid) + self.rad))

    def times(self, factor: np.ndarray | float) -> "Ball":
        """Return the product with exact positive numbers."""
        mid = self.mid * factor
        return Ball(mid, GREATER * (self.rad * factor + UNIT * np.abs(mid)))

    def inverse(self) -> "Ball":
        """Return the inverses: of I - E, E what an approximate inverse leaves, the Neumann series."""
        near = np.linalg.inv(self.mid)
        left = (exact(np.eye(near.shape[-1])) - Ball(near, np.zeros_like(near)) @ self).above
        size = left.sum(axis=-1, keepdims=True).max(axis=-2, keepdims=True)
        if not np.all(size < 0.5):
            raise NotProved("a matrix is too near to a singular one")
        rest = size / (1.0 - size) * np.abs(near).max(axis=-2, keepdims=True)
        return Ball(near, GREATER * (left @ (np.abs(near) + rest)))


def exact(matrix: np.ndarray) -> Ball:
    """Return exact doubles."""
    return Ball(matrix, np.zeros_like(matrix))


def joined(parts: Sequence[Ball], axis: int = 0) -> Ball:
    """Return all of them along an axis."""
    return Ball(*(np.concatenate([getattr(each, part) for each in parts], axis) for part in ("mid", "rad")))


def rounded(matrix: arb_mat) -> Ball:
    """Return doubles around balls of many bits."""
    rows = matrix.tolist()
    mid = np.array([[float(entry.mid()) for entry in row] for row in rows])
    far = [
        [float(abs(entry - arb(middle)).upper()) for entry, middle in zip(row, middles, strict=True)]
        for row, middles in zip(rows, mid.tolist(), strict=True)
    ]
    return Ball(mid, GREATER * np.array(far) + 1e-300)


def number(entry: Any) -> arb:
    """Return the ball of a number: a decimal of the file, a fraction, or a double."""
    return arb(fmpq(*entry.as_integer_ratio()))


def of_rows(rows: Sequence[Sequence[Any]]) -> arb_mat:
    """Return a matrix of the file, or of doubles."""
    return arb_mat([[each if isinstance(each, arb) else number(each) for each in row] for row in rows])


def of_doubles(matrix: np.ndarray) -> arb_mat:
    """Return exact doubles as balls."""
    return of_rows(matrix.tolist())


def require_positive(matrix: Ball, where: str) -> None:
    """Show that all symmetric matrices (..., n, n) are positive definite. Raises NotProved."""
    n = matrix.mid.shape[-1]
    mid = 0.5 * (matrix.mid + np.swapaxes(matrix.mid, -1, -2))
    off = (matrix.rad.sum(axis=-1).max(axis=-1) + (n + 4) * UNIT * np.abs(mid).sum(axis=(-2, -1))) * GREATER
    try:
        np.linalg.cholesky(mid - 2.0 * off[..., None, None] * np.eye(n))
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(mid).min())
        raise NotProved(f"{where}: smallest eigenvalue {least:.3g}, radius {float(off.max()):.1g}") from None


def whitening(matrix: np.ndarray) -> np.ndarray:
    """Return X with X' matrix X = I, nearly. Raises NotProved for a matrix that is not positive definite."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(matrix)).T)
    except np.linalg.LinAlgError:
        raise NotProved("a matrix is not positive definite") from None


def unit(size: int, *places: tuple[int, int]) -> list[list[arb]]:
    """Return the rows of the identity, each row of ``places`` another one of it."""
    rows = [[arb(i == j) for j in range(size)] for i in range(size)]
    for row, column in places:
        rows[row] = [arb(column == j) for j in range(size)]
    return rows


def cut(matrix: arb_mat, size: int, row: int = 0, column: int = 0) -> arb_mat:
    """Return the square of ``size`` from a row and a column on."""
    return arb_mat([[matrix[row + i, column + j] for j in range(size)] for i in range(size)])


def embedded(part: arb_mat, size: int, diagonal: int = 0) -> arb_mat:
    """Return ``part`` as the first entries of a matrix, with ``diagonal`` on the rest of its diagonal."""
    rows = [[arb(diagonal * (i == j)) for j in range(size)] for i in range(size)]
    for row, entries in zip(rows, part.tolist(), strict=False):
        row[: len(entries)] = entries
    return arb_mat(rows)
