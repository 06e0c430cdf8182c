"""The ends of uneven periods: values of a quadratic function before the rest of one, on a grid of its length.

After the shortest period the rest is a flow of s = 0 to twice what periods are uneven by. On a cell of s
of width d the value S(s) of a function after it is at most the chord of its neighbours and d^2/8 of the
largest of -S''; where that is within ENDS of both neighbours, S(s) is at most 1 + ENDS of a mean of them.
What comes before is convex in S. The derivatives of S follow from Riccati's equation: S'' on a part of a cell
is a series around its middle, the last term bounded by norms of that equation.
"""

import itertools
import math
from fractions import Fraction

import numpy as np
from flint import arb, arb_mat

from servobench.design.verify.balls import (
    NotProved,
    cut,
    embedded,
    number,
    of_doubles,
    require_positive,
    rounded,
    unit,
    whitening,
)
from servobench.design.verify.loops import RebuiltLoop

ENDS = Fraction(1, 2500)
"""Share of a value that may lie between two ends."""
TURN = 0.015
"""Fastest rate of the plant times the width of a cell."""
PARTS = (1, 8, 64)
"""Parts of a cell, the least that suffices."""
ORDERS = 10
"""Terms of S'' around the middle of a part: the first two count as they are, the others by their norms."""


def ends_us(loop: RebuiltLoop) -> list[Fraction]:
    """Return the grid of s, us."""
    whole = 2 * loop.uneven_us
    rate = max(abs(float(loop.F[i, i].mid())) for i in range(loop.F.nrows()))
    cells = max(1, math.ceil(float(whole) / 1e6 * rate / TURN))
    return [whole * place / cells for place in range(cells + 1)]


class Ends:
    """Of one loop, at one gain; ``squared``: of it, None: no disturbance counts."""

    def __init__(self, loop: RebuiltLoop, squared: arb | None) -> None:
        k, self._m = loop.kept, loop.F.nrows()
        self._F, self._W, self._Q = embedded(loop.F, k), arb_mat(k, k), arb_mat(k, k)
        if squared is not None:
            self._W = embedded(loop.E * loop.E.transpose() / squared, k)
            self._Q = embedded(loop.C * loop.C.transpose(), k)
        self._quadratic = squared is not None
        self._loop, self._grid = loop, [number(each) / 10**6 for each in ends_us(loop)]

    def before(self, P: arb_mat) -> list[arb_mat]:
        """Return bounds of the value of P (k, k) before each end, times 1 + ENDS. Raises NotProved where more
        lies between two ends."""
        values = [self._value(P, each) for each in self._grid]
        for begin, end, *neighbours in zip(self._grid, self._grid[1:], values, values[1:], strict=False):
            for parts in PARTS:
                try:
                    self._bound(P, begin, end, neighbours, parts)
                    break
                except NotProved:
                    if parts == PARTS[-1]:
                        raise
        return [each * (1 + number(ENDS)) for each in values]

    def _bound(self, P: arb_mat, begin: arb, end: arb, neighbours: list[arb_mat], parts: int) -> None:
        """Show that no more lies between two ends. Raises NotProved."""
        F, W, Q = self._F, self._W, self._Q
        X = of_doubles(np.diag(1.0 / np.sqrt(np.diag(rounded(P).mid))))
        white = of_doubles(whitening(rounded(P).mid))
        f, w, q = (
            _size(X.inv() * F * X),
            _size(X.inv() * W * X.inv().transpose()),
            _size(X.transpose() * Q * X),
        )
        width = end - begin
        near = width / (2 * parts)
        for part in range(parts):
            # derivatives of S in the middle of the part, and bounds of their size within it
            S, sizes = [self._value(P, begin + near * (2 * part + 1))], []
            sizes.append(2 * _size(X.transpose() * S[0] * X))
            if not near * (2 * f * sizes[0] + q + w * sizes[0] ** 2) < sizes[0] / 2:
                raise NotProved("a value changes too fast between two ends of a period")
            for n in range(ORDERS + 2):
                following, size = F.transpose() * S[n] + S[n] * F, 2 * f * sizes[n]
                if not n:
                    following, size = following + Q, size + q
                for i in range(n + 1 if self._quadratic else 0):
                    following += S[i] * W * S[n - i] * math.comb(n, i)
                    size += w * sizes[i] * sizes[n - i] * math.comb(n, i)
                S.append(following)
                sizes.append(size)
            told = [_size(X.transpose() * each * X) for each in S[5:-1]] + [sizes[-1]]
            left = sum((near**n * each / math.factorial(n) for n, each in enumerate(told, 3)), arb(0))
            least = S[2] - X.inv().transpose() * X.inv() * left
            for first, second in itertools.product((-near, near), (arb(0), near**2 / 2)):
                bend = least + S[3] * first + S[4] * second
                for neighbour in neighbours:
                    room = neighbour * number(ENDS) + bend * (width**2 / 8)
                    require_positive(
                        rounded(white.transpose() * room * white), "between two ends of a period"
                    )

    def late(self, P: arb_mat, room: arb) -> list[arb_mat]:
        """Return the same where the newest sample begins to act within the rest.

        ``room``: weight of the square of what it adds to the input, where it does so at the very end.
        """
        k, n = P.nrows(), self._m - 1
        J = cut(self._loop.applying[0], k)
        apart = arb_mat([[arb((j == n) - (j == n + 1)) for j in range(k)]])
        values = self.before(J.transpose() * P * J + apart.transpose() * apart * room)
        after = [J.transpose() * each * J for each in self.before(P)]
        for begin in range(1, len(self._grid)):
            for rest in range(1, len(self._grid) - begin):
                values.append(self._value(after[rest], self._grid[begin]))
        return values

    def _value(self, P: arb_mat, length: arb) -> arb_mat:
        """Return the value of P (k, k) before a flow."""
        m, k, own = self._m, P.nrows(), cut(self._F, self._m)
        reach, cost = cut(self._W, m), cut(self._Q, m)
        rows = [[*own.table()[i], *reach.table()[i]] for i in range(m)]
        rows += [[-entry for entry in (*cost.table()[i], *own.transpose().table()[i])] for i in range(m)]
        G = (arb_mat(rows) * length).exp()
        inverse = cut(G, m, m, m).inv()
        Phi = embedded(inverse.transpose(), k, 1)
        reached = embedded(cut(G, m, 0, m) * inverse, k) * P
        if not reached.trace() < 1:
            raise NotProved("a disturbance at a period's end reaches beyond every bound")
        gained = embedded(inverse * cut(G, m, m, 0) * -1, k)
        return gained + Phi.transpose() * P * (arb_mat(unit(k)) - reached).inv() * Phi


def _size(matrix: arb_mat) -> arb:
    """Return an upper bound of the largest singular value."""
    return arb(sum((entry * entry for entry in matrix.entries()), arb(0)).sqrt().upper())
