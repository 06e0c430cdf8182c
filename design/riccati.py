"""Stabilising solutions of algebraic Riccati equations with indefinite quadratic terms.

    E' X + X E - X W X + Q = 0        H = [E, -W; -Q, -E']        E - W X stable

[Azaiz2007] (16) to (19). The stable invariant subspace [X1; X2] of H comes from its ordered real Schur
form, after a symplectic scaling diag(T, T^-1) with T of powers of two, and X = X2 X1^-1.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from design.statespace import Array

_SKEW_MAX = 1e-5
"""The basis of a stable subspace has X1' X2 symmetric; more asymmetry than this part of it means that
eigenvalues sit on the imaginary axis and the split was arbitrary."""
_AXIS = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class RiccatiSolution:
    """X (n, n), symmetric, and what the check of it said."""

    X: Array
    closed_loop: Array
    """Eigenvalues of E - W X."""
    residual: float
    """Norm of the equation's left side beside the norms of its terms."""


def stabilising_solution(E: Array, W: Array, Q: Array) -> RiccatiSolution | None:
    """The stabilising X; None if there is none (eigenvalues of H on the axis, or X1 singular)."""
    n = len(E)
    if n == 0:
        return RiccatiSolution(np.zeros((0, 0)), np.zeros(0), 0.0)
    H = np.block([[E, -W], [-Q, -E.T]])
    scale = _symplectic_scale(H)
    both = np.concatenate([scale, 1.0 / scale])
    H = H * both / both[:, None]
    try:
        T, U, stable = scipy.linalg.schur(H, output="real", sort="lhp")
    except scipy.linalg.LinAlgError:
        return None
    values = np.asarray(scipy.linalg.eigvals(T))[:n] if stable == n else None
    if values is None or np.any(-values.real <= _AXIS * np.abs(values)):
        return None
    X1, X2 = U[:n, :n], U[n:, :n]
    product = X1.T @ X2
    size = np.linalg.norm(product)
    if np.linalg.norm(product - product.T) > _SKEW_MAX * size + 1e-12:
        return None
    if np.linalg.cond(X1) > 1e15:
        return None
    X = scipy.linalg.solve(X1.T, X2.T).T
    X = 0.5 * (X + X.T) / scale[:, None] / scale
    residual = E.T @ X + X @ E - X @ W @ X + Q
    terms = 2.0 * np.linalg.norm(E.T @ X) + np.linalg.norm(X @ W @ X) + np.linalg.norm(Q)
    return RiccatiSolution(X, values, float(np.linalg.norm(residual)) / max(float(terms), 1e-300))


def _symplectic_scale(H: Array) -> Array:
    """(n,) powers of two t: H in the coordinates diag(t, 1/t) has rows and columns of like size."""
    n = len(H) // 2
    magnitude = np.abs(H)
    np.fill_diagonal(magnitude, 0.0)
    _, (scale, _) = scipy.linalg.matrix_balance(magnitude, permute=False, separate=True)
    logs = np.log2(scale)
    return np.asarray(2.0 ** np.round((logs[:n] - logs[n:]) / 2.0), dtype=float)


def is_positive_semidefinite(X: Array, noise: float, tolerance: float = 1e-8) -> bool:
    """Whether the symmetric X is >= 0 up to ``tolerance``, each state measured by its own size.

    ``noise``: the size below which an entry of X is a rounding error. An X that stops being >= 0 does so
    through infinity, so a loose tolerance does not hide it.
    """
    if not len(X):
        return True
    size = np.sqrt(np.abs(np.diag(X)))
    size = np.maximum(size, max(size.max(initial=0.0) * 1e-8, np.sqrt(noise / tolerance), 1e-150))
    return bool(np.linalg.eigvalsh(X / size[:, None] / size).min() >= -tolerance)
