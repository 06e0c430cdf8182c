"""Gain of a sampled loop from a continuous disturbance to a continuous output, by lifting.

Over one period of the loop's pattern the disturbance and the output are functions; the loop maps the
one to the other and xi to xi. On each piece between two switchings all is analytic, so d and z are
represented there by their values at Gauss-Legendre nodes, weighted so that sums of squares are
integrals of squares, and the flow by the collocation method on the same nodes (order 2 x nodes).
What remains is an ordinary discrete-time system; its H-infinity norm is the sampled loop's gain, up to
an error that falls geometrically with the number of nodes.
(Lifting: Chen and Francis, Optimal Sampled-Data Control Systems, 1995, ch. 10.)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigvals

from design.delay.delay_loop import Array
from design.delay.delay_response import integrals_to
from design.errors import NoSolution
from design.sampled.held_loop import HeldInput, Jump, Operation

NODES = 5
_PIECE_TURN = 2.0
"""A piece is cut until the fastest rate of the plant times its length is at most this."""
NORM_TOLERANCE = 1e-7
"""Relative: it is shown that the norm of the lifted system exceeds the one returned by no more."""


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteSystem:
    """x+ = A x + B d, z = C x + D d."""

    A: Array
    B: Array
    C: Array
    D: Array


def lifted(loop: HeldInput, chain: Sequence[Operation], nodes: int = NODES) -> DiscreteSystem:
    """The loop over one period of a pattern, from weighted disturbance to weighted output."""
    collocation = _Collocation(loop, nodes)
    A, B = np.eye(loop.size), np.zeros((loop.size, 0))
    C, D = np.zeros((0, loop.size)), np.zeros((0, 0))
    for operation in chain:
        if isinstance(operation, Jump):
            A, B = operation.J @ A, operation.J @ B
            continue
        pieces = max(1, math.ceil(operation.length_s * collocation.rate / _PIECE_TURN))
        for _ in range(pieces if operation.length_s > 0.0 else 0):
            piece = collocation.piece(operation.length_s / pieces)
            C = np.vstack([C, piece.C @ A])
            D = np.block([[D, np.zeros((len(D), nodes))], [piece.C @ B, piece.D]])
            A, B = piece.A @ A, np.hstack([piece.A @ B, piece.B])
    kept = loop.kept
    return DiscreteSystem(A[:kept, :kept], B[:kept], C[:, :kept], D)


def discrete_norm(system: DiscreteSystem, tolerance: float = NORM_TOLERANCE) -> float:
    """sup over theta of the largest singular value at e^{j theta}; inf if the system is unstable.

    Of a :func:`lifted` loop: its gain. Raises NoSolution if the norm found cannot be shown to be one.
    """
    poles = np.linalg.eigvals(system.A)
    if len(poles) and np.max(np.abs(poles)) >= 1.0:
        return math.inf
    angles = np.union1d(np.linspace(0.0, math.pi, 25), np.abs(np.angle(poles[np.abs(poles) > 0.1])))
    norm = _climb(system, angles)
    for _ in range(30):
        above = _angles_at(system, norm * (1.0 + tolerance))
        if len(above) == 0:
            return norm * (1.0 + 0.5 * tolerance)
        middles = 0.5 * (above[1:] + above[:-1])
        higher = max(norm, _climb(system, np.union1d(above, middles)))
        if higher <= norm * (1.0 + 0.1 * tolerance):
            return norm * (1.0 + tolerance)
        norm = higher
    raise NoSolution("norm of the lifted loop", "the search did not end", f"last value {norm:.9g}")


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """Map of xi and weighted d over a piece: to xi at its end (A, B) and to weighted z (C, D)."""

    A: Array
    B: Array
    C: Array
    D: Array


class _Collocation:
    """Flows of one plant by Gauss-Legendre collocation."""

    def __init__(self, loop: HeldInput, nodes: int) -> None:
        self._model = loop.model
        self._size = loop.size
        x, w = np.polynomial.legendre.leggauss(nodes)
        self._times = 0.5 * (x + 1.0)
        self._weights = 0.5 * w
        self._integral = integrals_to(x)
        self._pieces: dict[float, _Piece] = {}
        self.rate = float(np.linalg.norm(self._balanced(), 2))

    def piece(self, length_s: float) -> _Piece:
        """The map over ``length_s``, kept for the next time."""
        known = self._pieces.get(length_s)
        if known is None:
            known = self._pieces[length_s] = self._solve(length_s)
        return known

    def _balanced(self) -> Array:
        scale = self._model.state_scale
        return np.asarray(self._model.A * scale / scale[:, None])

    def _solve(self, length_s: float) -> _Piece:
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
        return _Piece(A, B, C, select @ X_d)


def _gains(system: DiscreteSystem, angles: Array) -> Array:
    n = len(system.A)
    z = np.exp(1j * angles)[:, None, None]
    inner = np.linalg.solve(
        z * np.eye(n) - system.A, np.broadcast_to(system.B, (len(angles), *system.B.shape))
    )
    return np.asarray(np.linalg.norm(system.C @ inner + system.D, 2, axis=(1, 2)))


def _climb(system: DiscreteSystem, angles: Array) -> float:
    """The highest gain near the best of ``angles``."""
    gains = _gains(system, angles)
    top = int(np.argmax(gains))
    low, high = angles[max(top - 1, 0)], angles[min(top + 1, len(angles) - 1)]
    best = float(gains[top])
    for _ in range(7):
        inner = np.linspace(low, high, 7)
        gains = _gains(system, inner)
        top = int(np.argmax(gains))
        best = max(best, float(gains[top]))
        low, high = inner[max(top - 1, 0)], inner[min(top + 1, 6)]
    return best


def _angles_at(system: DiscreteSystem, gain: float) -> Array:
    """Angles in [0, pi] at which a singular value is ``gain``: unit eigenvalues of the symplectic pencil.

    (Hinrichsen and Son, Int. J. Robust Nonlinear Control 1(2), 1991.)
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    n = len(A)
    R = gain**2 * np.eye(D.shape[1]) - D.T @ D
    E = A + B @ np.linalg.solve(R, D.T @ C)
    G = B @ np.linalg.solve(R, B.T)
    Q = C.T @ C + C.T @ D @ np.linalg.solve(R, D.T @ C)
    size = math.sqrt(np.linalg.norm(Q) / max(float(np.linalg.norm(G)), 1e-300))
    left = np.block([[E, np.zeros((n, n))], [-Q / size, np.eye(n)]])
    right = np.block([[np.eye(n), -G * size], [np.zeros((n, n)), E.T]])
    roots = eigvals(left, right)
    roots = roots[np.isfinite(roots)]
    on_circle = roots[np.abs(np.abs(roots) - 1.0) < 1e-8]
    return np.unique(np.abs(np.angle(on_circle)))
