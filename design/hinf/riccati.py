"""Stabilising solutions of algebraic Riccati equations with indefinite quadratic terms.

    E' X + X E - X W X + Q = 0        H = [E, -W; -Q, -E']        E - W X stable

[Azaiz2007] (16) to (19). The stable invariant subspace [X1; X2] of H comes from its ordered real Schur
form, after a symplectic scaling diag(T, T^-1) with T of powers of two, and X = X2 X1^-1. Newton's steps
then refine X, the residual being computed in extended precision where the machine has it: with modes eight
decades apart the Schur form alone leaves X with few true digits.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from servobench.design.statespace import Array, ComplexArray, balancing_scales

LongArray = NDArray[np.longdouble]

_SKEW_MAX = 1e-5
"""The basis of a stable subspace has X1' X2 symmetric; more asymmetry than this part of it means that
eigenvalues sit on the imaginary axis and the split was arbitrary."""
_SKEW_NOISE = 1e-9
"""The basis is orthonormal, so entries are accurate to 1e-16: an X close to 0 is asymmetric by rounding."""
_AXIS = 1e-12
"""Share of an eigenvalue's magnitude: 0 to 1e-10 decide alike on 80 random plants, 1e-8 moves a gamma by
1e-9."""
_RECIPROCAL_CONDITION = 1e-15
"""Below this X1 counts as singular."""
_STEPS_MAX = 4
"""Steps at most. On 80 random plants one step loses one and moves gammas by 3e-3, two by 9e-4; eight change
nothing more."""
_ROUGH = 1e-9
"""Relative size of the last step of Newton above which others are tried, in better coordinates."""
_DERIVATIVE_HOLDS = 1e-3
"""A step of Newton that leaves less of the residual had a derivative that is as good for the next one."""
_LOOSE = 1e-6
"""Relative: 1e-9 to 1e-2 decide alike on 80 random plants."""
_PRECISION = 16.0 * float(np.finfo(np.longdouble).eps)
"""Relative error of an entry of the equation's terms, in extended precision."""


@dataclass(frozen=True, slots=True, eq=False)
class RiccatiSolution:
    """X (n, n), symmetric, with the results of its check."""

    X: LongArray
    noise: Array
    """(n,) diagonal of a matrix S >= 0: the most that the rounding errors of Q alone move X by."""
    is_nonnegative: bool
    """True if X >= 0."""
    closed_loop: ComplexArray
    """Eigenvalues of E - W X."""
    error: float
    """Norm of the last Newton step relative to that of X: the possible error of X."""
    moved: float
    """Distance of the X found in double precision alone: the effect of rounding the plant's figures."""


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """X in double precision, the eigenvalues of E - W X, and the sign of X where it is known."""

    X: Array
    modes: ComplexArray
    is_nonnegative: bool | None = None


@dataclass(frozen=True, slots=True)
class NoRiccatiSolution:
    """No X: H has no stable subspace of n dimensions that yields one, or could not be formed."""

    centre: complex
    """Middle of the two eigenvalues of H that met on the imaginary axis."""
    half_gap: float
    """Half of their distance since, along the axis."""


def stabilising_solution(
    E: LongArray, W: LongArray, Q: LongArray, terms: Array, thorough: bool = True
) -> RiccatiSolution | NoRiccatiSolution:
    """Return the stabilising X, if it exists (no eigenvalue of H on the axis, and X1 regular).

    ``terms``: (n, n) magnitudes of the terms whose difference is Q; they may cancel. ``thorough``: to the
    last digit even where X is nearly infinite.
    """
    if len(E) == 0:
        empty = np.zeros((0, 0))
        return RiccatiSolution(_long(empty), np.zeros(0), True, np.zeros(0, dtype=complex), 0.0, 0.0)
    if (np.abs(Q) <= _PRECISION * terms).all():
        start = _without_constant(_double(E), _double(W))
    else:
        start = _by_schur(_double(E), _double(W), _double(Q))
    if isinstance(start, NoRiccatiSolution):
        return start
    if not start.X.any():
        return RiccatiSolution(_long(start.X), np.zeros(len(E)), True, start.modes, 0.0, 0.0)
    X, schur, step = _refined(E, W, Q, _long(start.X))
    if thorough and _norm(step) > _ROUGH * _norm(X):
        X, step = _refined_in_own_axes(E, W, Q, X)
    S = _lyapunov(schur, _PRECISION * np.diag(terms.sum(axis=1)))
    noise = np.zeros(len(X)) if S is None else np.abs(np.diag(S))
    size = max(_norm(X), 4e6 * _norm(noise), 1e-300)
    moved = _norm(X - start.X) / size
    is_nonnegative = _is_nonnegative(X, noise) if start.is_nonnegative is None else start.is_nonnegative
    return RiccatiSolution(X, noise, is_nonnegative, start.modes, _norm(step) / size, moved)


def _long(matrix: Array) -> LongArray:
    return np.asarray(matrix, dtype=np.longdouble)


def _double(matrix: LongArray) -> Array:
    return np.asarray(matrix, dtype=float)


def _norm(matrix: Array | LongArray) -> float:
    return math.sqrt(np.vdot(matrix, matrix))


def _lyapunov(schur: tuple[Array, Array], Q: Array) -> Array | None:
    """Return S with C' S + S C + Q = 0, Q symmetric (Bartels and Stewart 1972); None where that overflows.

    ``schur``: T and U of C' = U T U'.
    """
    T, U = schur
    Y, scale, _ = lapack.dtrsyl(T, T, -U.T @ Q @ U, tranb="T")
    S = U @ (Y * scale) @ U.T
    return np.asarray(0.5 * (S + S.T), dtype=float) if np.isfinite(S).all() else None


def _refined(
    E: LongArray, W: LongArray, Q: LongArray, X: LongArray
) -> tuple[LongArray, tuple[Array, Array], LongArray]:
    """Return X after Newton's steps in double precision, the last Schur form of (E - W X)', and the last
    step.

    A step is taken while it halves the residual at least. After one that nearly removes it the derivative
    still holds: the next step needs no other Schur form.
    """
    C = E - W @ X
    residual, last, shrunk = E.T @ X + X @ C + Q, np.full_like(X, np.inf), 1.0
    for _ in range(_STEPS_MAX):
        if shrunk > _DERIVATIVE_HOLDS:
            T, _, _, _, U, *_ = lapack.dgees(_is_left, _double(C.T))
        step = _lyapunov((T, U), _double(residual))
        if step is None:
            break
        last = _long(step)
        next_X = X + step
        C = E - W @ next_X
        next_residual = E.T @ next_X + next_X @ C + Q
        before, after = _norm(residual), _norm(next_residual)
        if not after < 0.5 * before:
            break
        X, residual, shrunk = next_X, next_residual, after / before
    return X, (T, U), last


def _refined_in_own_axes(
    E: LongArray, W: LongArray, Q: LongArray, X: LongArray
) -> tuple[LongArray, LongArray]:
    """Return X after Newton's steps in the states of its eigenvectors, scaled, and the last step.

    Near the gamma at which X is infinite E - W X is large in that direction and its eigenvalues are not:
    only in these states has its Schur form true digits.
    """
    _, vectors = np.linalg.eigh(_double(X))
    axes = _long(vectors)
    back = axes.T @ (2.0 * np.eye(len(X)) - axes @ axes.T)
    scale = _long(balancing_scales(_double(back @ (E - W @ X) @ axes)))
    axes, back = axes * scale, back / scale[:, None]
    own, _, step = _refined(back @ E @ axes, back @ W @ back.T, axes.T @ Q @ axes, axes.T @ X @ axes)
    return back.T @ own @ back, back.T @ step @ back


def _is_right(real: float, _imaginary: float) -> bool:
    return real > 0.0


def _is_left(real: float, _imaginary: float) -> bool:
    return real < 0.0


def _without_constant(E: Array, W: Array) -> _Start | NoRiccatiSolution:
    """Return X and the eigenvalues of E - W X where Q = 0, in double precision.

    X = V P^-1 V' with V a basis of the unstable modes of E', E' V = V T, and P T + T' P = V' W V: linear, and
    X >= 0 where P > 0. The Schur form of H would have to separate its eigenvalues from their mirror images,
    which is impossible for a mode fourteen decades slower than another.
    """
    values = np.linalg.eigvals(E).astype(complex)
    if np.any(np.abs(values.real) <= _AXIS * np.abs(values)):
        return _meeting(np.concatenate([values, -values.conj()]))
    modes = np.where(values.real > 0.0, -values.conj(), values)
    unstable = int(np.sum(values.real > 0.0))
    if not unstable:
        return _Start(np.zeros_like(E), modes, True)
    scale = balancing_scales(E)
    T, stable, _, _, U, *_ = lapack.dgees(_is_right, (E * scale / scale[:, None]).T, sort_t=1)
    if stable != unstable:
        return _meeting(np.concatenate([values, -values.conj()]))
    T, V = T[:unstable, :unstable], U[:, :unstable] / scale[:, None]
    Y, factor, _ = lapack.dtrsyl(T, T, V.T @ W @ V, trana="T")
    P = 0.5 * (Y + Y.T) * factor
    size = np.sqrt(np.maximum(np.abs(np.diag(P)), 1e-300))
    values, vectors = np.linalg.eigh(P / size[:, None] / size)
    if not np.abs(values).min() > 0.0:
        return NoRiccatiSolution(0.0, 0.0)
    half = V / size @ vectors
    return _Start((half / values) @ half.T, modes, bool(values.min() > 0.0))


def _by_schur(E: Array, W: Array, Q: Array) -> _Start | NoRiccatiSolution:
    """Return X and the eigenvalues of E - W X in double precision."""
    n = len(E)
    H = np.empty((2 * n, 2 * n))
    H[:n, :n], H[:n, n:], H[n:, :n], H[n:, n:] = E, -W, -Q, -E.T
    scale = _symplectic_scale(H)
    both = np.concatenate([scale, 1.0 / scale])
    _, stable, real, imaginary, U, _, info = lapack.dgees(_is_left, H * both / both[:, None], sort_t=1)
    values = real + 1j * imaginary
    X1, X2 = U[:n, :n], U[n:, :n]
    product = X1.T @ X2
    LU, pivots, singular = lapack.dgetrf(X1)
    if (
        info
        or stable != n
        or np.any(-real[:n] <= _AXIS * np.abs(values[:n]))
        or _norm(product - product.T) > _SKEW_MAX * _norm(product) + _SKEW_NOISE
        or singular
        or lapack.dgecon(LU, np.abs(X1).sum(axis=0).max())[0] < _RECIPROCAL_CONDITION
    ):
        return _meeting(values)
    X = lapack.dgetrs(LU, pivots, X2.T, trans=1)[0].T
    return _Start(0.5 * (X + X.T) / scale[:, None] / scale, values[:n])


def _meeting(values: ComplexArray) -> NoRiccatiSolution:
    """Return the place where the eigenvalue of H nearest to the axis, by its own size, met its neighbour."""
    nearest = np.argmin(np.abs(values.real) / np.maximum(np.abs(values), 1e-300))
    gaps = np.abs(values - values[nearest])
    gaps[nearest] = np.inf
    other = np.argmin(gaps)
    return NoRiccatiSolution(0.5 * (values[nearest] + values[other]), 0.5 * float(gaps[other]))


def _symplectic_scale(H: Array) -> Array:
    """Return (n,) powers of two t: H in the coordinates diag(t, 1/t) has rows and columns of like size."""
    n = len(H) // 2
    magnitude = np.abs(H)
    np.fill_diagonal(magnitude, 0.0)
    logs = np.log2(balancing_scales(magnitude))
    return np.asarray(2.0 ** np.round((logs[:n] - logs[n:]) / 2.0), dtype=float)


def _is_nonnegative(X: LongArray, noise: Array) -> bool:
    """Return True if X >= 0 up to :data:`_LOOSE`, each state measured by its own size.

    An entry below the rounding errors counts as zero. An X that stops being >= 0 does so through
    infinity, so a loose tolerance does not hide it.
    """
    size = np.sqrt(np.maximum(np.abs(np.diag(_double(X))), 4.0 / _LOOSE * noise + 1e-300))
    scaled = _double(X / _long(np.outer(size, size)))
    return bool(np.linalg.eigvalsh(scaled).min() >= -_LOOSE)
