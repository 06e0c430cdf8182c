"""Gain of a sampled loop from a continuous disturbance to a continuous output, by lifting.

Over one period of the loop's pattern the disturbance and the output are functions; the loop maps the one to
the other and xi to xi. On each piece between two switchings all is analytic, so d and z are represented there
by their values at Gauss-Legendre nodes, weighted so that sums of squares are integrals of squares, and the
flow by the collocation method on the same nodes (order 2 x nodes). The result is an ordinary discrete-time
system; its norm (:mod:`servobench.design.hinf.system_norm`) is the sampled loop's gain, up to an error that
falls geometrically with the number of nodes. (Lifting: Chen and Francis, Optimal Sampled-Data Control
Systems, 1995, ch. 10.)
"""

import math
from collections.abc import Sequence

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.delay_response import integrals_to
from servobench.design.hinf.system_norm import hinf_norm
from servobench.design.sampled.held_loop import HeldInput, Jump, Operation
from servobench.design.statespace import StateSpace

NODES = 5
"""Three leave 3e-9 of the gain, four 1e-12, five rounding errors."""
_PIECE_TURN = 2.0
"""A piece is cut until the fastest rate of the plant times its length is at most this."""


def lifted_gain(loop: HeldInput, chain: Sequence[Operation]) -> float:
    """Return the L2 gain of the loop that repeats ``chain``, output per disturbance; inf if it is
    unstable."""
    return hinf_norm(_lifted(loop, chain)).gain


def _lifted(loop: HeldInput, chain: Sequence[Operation]) -> StateSpace:
    """Return the loop over one period of a pattern, from weighted disturbance to weighted output."""
    collocation = _Collocation(loop)
    A, B = np.eye(loop.size), np.zeros((loop.size, 0))
    C, D = np.zeros((0, loop.size)), np.zeros((0, 0))
    period_s = 0.0
    for operation in chain:
        if isinstance(operation, Jump):
            A, B = operation.J @ A, operation.J @ B
            continue
        period_s += operation.length_s
        pieces = max(1, math.ceil(operation.length_s * collocation.rate / _PIECE_TURN))
        for _ in range(pieces if operation.length_s > 0.0 else 0):
            piece = collocation.piece(operation.length_s / pieces)
            C = np.vstack([C, piece.C @ A])
            D = np.block([[D, np.zeros((len(D), NODES))], [piece.C @ B, piece.D]])
            A, B = piece.A @ A, np.hstack([piece.A @ B, piece.B])
    kept = loop.kept
    return StateSpace(A[:kept, :kept], B[:kept], C[:, :kept], D, period_s)


class _Collocation:
    """Flows of one plant by Gauss-Legendre collocation."""

    def __init__(self, loop: HeldInput) -> None:
        self._model = loop.model
        self._size = loop.size
        x, w = np.polynomial.legendre.leggauss(NODES)
        self._times = 0.5 * (x + 1.0)
        self._weights = 0.5 * w
        self._integral = integrals_to(x)
        self._pieces: dict[float, StateSpace] = {}
        self.rate = float(np.linalg.norm(self._balanced(), 2))

    def piece(self, length_s: float) -> StateSpace:
        """Return the map of xi and weighted d over ``length_s`` to xi at its end and to weighted z, kept."""
        known = self._pieces.get(length_s)
        if known is None:
            known = self._pieces[length_s] = self._solve(length_s)
        return known

    def _balanced(self) -> Array:
        scale = self._model.state_scale
        return np.asarray(self._model.A * scale / scale[:, None])

    def _solve(self, length_s: float) -> StateSpace:
        model, p, n = self._model, len(self._times), len(self._model.A)
        root = np.sqrt(self._weights * length_s)
        # x_i = x_0 + length sum_j a_ij (A x_j + B1 u + B2 d_j)
        G = np.eye(p * n) - length_s * np.kron(self._integral, model.A)
        from_x = np.kron(np.ones((p, 1)), np.eye(n))
        from_u = length_s * np.kron(self._integral.sum(axis=1)[:, None], model.B1[:, None])
        from_d = length_s * np.kron(self._integral, model.B2[:, None]) / root
        X = np.linalg.solve(G, np.hstack([from_x, from_u, from_d]))
        X_x, X_u, X_d = X[:, :n], X[:, n : n + 1], X[:, n + 1 :]
        quadrature = length_s * np.kron(self._weights, model.A)
        A = np.eye(self._size)
        A[:n, :n] += quadrature @ X_x
        A[:n, n : n + 1] += quadrature @ X_u + length_s * model.B1[:, None]
        B = np.zeros((self._size, p))
        B[:n] = quadrature @ X_d + length_s * np.outer(model.B2, self._weights / root)
        select = root[:, None] * np.kron(np.eye(p), model.C)
        C = np.zeros((p, self._size))
        C[:, :n], C[:, n : n + 1] = select @ X_x, select @ X_u
        return StateSpace(A, B, C, select @ X_d)
