"""Stabilising solutions of algebraic Riccati equations with indefinite quadratic terms.

    E' X + X E - X W X + Q = 0        H = [E, -W; -Q, -E']        E - W X stable

[Azaiz2007] (16) to (19). The stable invariant subspace [X1; X2] of H comes from its ordered real Schur
form, after a symplectic scaling diag(T, T^-1) with T of powers of two, and X = X2 X1^-1. Newton's steps
then refine X, the residual being computed in extended precision where the machine has it: with modes eight
decades apart the Schur form alone leaves X with few true digits.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from design.statespace import Array, balancing_scales

LongArray = NDArray[np.longdouble]

_SKEW_MAX = 1e-5
"""The basis of a stable subspace has X1' X2 symmetric; more asymmetry than this part of it means that
eigenvalues sit on the imaginary axis and the split was arbitrary."""
_SKEW_NOISE = 1e-9
_AXIS = 1e-12
_STEPS_MAX = 4
_PRECISION = 16.0 * float(np.finfo(np.longdouble).eps)
"""Relative error of an entry of the equation's terms, in extended precision."""


@dataclass(frozen=True, slots=True, eq=False)
class RiccatiSolution:
    """X (n, n), symmetric, and what the check of it said."""

    X: LongArray
    noise: Array
    """(n,) diagonal of a matrix S >= 0 that the rounding errors of Q alone move X by, at most."""
    closed_loop: Array
    """Eigenvalues of E - W X."""
    residual: float
    """Norm of the equation's left side beside the norms of its terms."""
    error: float
    """Norm of the last Newton step beside that of X: how far X may be off, relative."""


def stabilising_solution(E: LongArray, W: LongArray, Q: LongArray, terms: Array) -> RiccatiSolution | None:
    """The stabilising X; None if there is none (eigenvalues of H on the axis, or X1 singular).

    ``terms``: (n, n) magnitudes of the terms that Q is the difference of; they may cancel.
    """
    if len(E) == 0:
        empty = np.zeros((0, 0))
        return RiccatiSolution(_long(empty), np.zeros(0), np.zeros(0), 0.0, 0.0)
    found = _nothing(_double(E), _double(Q), terms) or _by_schur(_double(E), _double(W), _double(Q))
    if found is None:
        return None
    X, residual, step = _refined(E, W, Q, _long(found[0]))
    moved = _lyapunov(_double(E - W @ X), _PRECISION * np.diag(terms.sum(axis=1)))
    noise = np.zeros(len(X)) if moved is None else np.abs(np.diag(moved))
    sizes = (
        2.0 * np.linalg.norm(_double(E.T @ X)) + np.linalg.norm(_double(X @ W @ X)) + np.linalg.norm(terms)
    )
    relative = float(np.linalg.norm(_double(residual)) / max(float(sizes), 1e-300))
    size = max(float(np.linalg.norm(_double(X))), 4e6 * float(np.linalg.norm(noise)), 1e-300)
    return RiccatiSolution(X, noise, found[1], relative, step / size)


def _long(matrix: Array) -> LongArray:
    return np.asarray(matrix, dtype=np.longdouble)


def _double(matrix: LongArray) -> Array:
    return np.asarray(matrix, dtype=float)


def _lyapunov(C: Array, Q: Array) -> Array | None:
    """S with C' S + S C + Q = 0, Q symmetric (Bartels and Stewart 1972); None where that overflows."""
    T, U = scipy.linalg.schur(C.T, output="real")
    Y, scale, _ = scipy.linalg.lapack.dtrsyl(T, T, -U.T @ Q @ U, tranb="T")
    S = U @ (Y * scale) @ U.T
    return np.asarray(0.5 * (S + S.T), dtype=float) if np.isfinite(S).all() else None


def _refined(E: LongArray, W: LongArray, Q: LongArray, X: LongArray) -> tuple[LongArray, LongArray, float]:
    """X after Newton's steps, each found in double precision, its residual, and the size of the last step.

    A step is taken while it halves the residual at least.
    """
    residual, size = E.T @ X + X @ E - X @ W @ X + Q, np.inf
    for _ in range(_STEPS_MAX):
        step = _lyapunov(_double(E - W @ X), _double(residual))
        if step is None:
            break
        size = float(np.linalg.norm(step))
        next_X = X + step
        next_residual = E.T @ next_X + next_X @ E - next_X @ W @ next_X + Q
        if not np.linalg.norm(_double(next_residual)) < 0.5 * np.linalg.norm(_double(residual)):
            break
        X, residual = next_X, next_residual
    return X, residual, size


def _nothing(E: Array, Q: Array, terms: Array) -> tuple[Array, Array] | None:
    """X = 0 and the eigenvalues of E where Q is nothing but rounding and E stable.

    The Schur form would have to tell H's eigenvalues from their mirror images, which for a mode fourteen
    decades slower than another it cannot.
    """
    if np.any(np.abs(Q) > _PRECISION * terms):
        return None
    values = np.asarray(scipy.linalg.eigvals(E))
    return (np.zeros_like(E), values) if np.all(-values.real > _AXIS * np.abs(values)) else None


def _by_schur(E: Array, W: Array, Q: Array) -> tuple[Array, Array] | None:
    """X and the eigenvalues of E - W X in double precision, or None."""
    n = len(E)
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
    if np.linalg.norm(product - product.T) > _SKEW_MAX * size + _SKEW_NOISE:
        return None
    if np.linalg.cond(X1) > 1e15:
        return None
    X = scipy.linalg.solve(X1.T, X2.T).T
    return 0.5 * (X + X.T) / scale[:, None] / scale, values


def _symplectic_scale(H: Array) -> Array:
    """(n,) powers of two t: H in the coordinates diag(t, 1/t) has rows and columns of like size."""
    n = len(H) // 2
    magnitude = np.abs(H)
    np.fill_diagonal(magnitude, 0.0)
    logs = np.log2(balancing_scales(magnitude))
    return np.asarray(2.0 ** np.round((logs[:n] - logs[n:]) / 2.0), dtype=float)


def is_positive_semidefinite(solution: RiccatiSolution, tolerance: float = 1e-6) -> bool:
    """Whether X >= 0 up to ``tolerance``, each state measured by its own size.

    An entry below the rounding errors counts as zero. An X that stops being >= 0 does so through
    infinity, so a loose tolerance does not hide it.
    """
    if not len(solution.X):
        return True
    X = solution.X
    size = np.sqrt(np.maximum(np.abs(np.diag(_double(X))), 4.0 / tolerance * solution.noise + 1e-300))
    scaled = _double(X / _long(np.outer(size, size)))
    return bool(np.linalg.eigvalsh(scaled).min() >= -tolerance)
