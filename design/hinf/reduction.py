"""Fewer states: balanced truncation, residualisation, and [Azaiz2007] 3.5's own rule.

A controller with a slow pole at -0.01 rad/s is stable, so its Hankel singular values are defined; they are
computed with square-root factors of the Gramians (Laub 1980, Safonov and Chiang 1989).
"""

from enum import Enum

import numpy as np
import scipy.linalg

from servobench.design.statespace import Array, StateSpace, Zpk, balanced, from_zpk, zpk


class Method(Enum):
    """Ways to drop states."""

    TRUNCATE = "truncate"
    """Balanced truncation: exact at infinite frequency."""
    RESIDUALISE = "residualise"
    """Balanced residualisation: exact at rest."""
    PAPER = "paper"
    """[Azaiz2007] (71), (72): the fastest pole and zero cancel, the slowest pole becomes an integrator."""


def _factor(A: Array, B: Array) -> Array:
    """Return R (n, n) with R R' the solution W of A W + W A' + B B' = 0, without forming W (Hammarling 1982).

    W of a controller whose modes lie eight decades apart has lost its small part to rounding.
    """
    T, Q = scipy.linalg.schur(A, output="complex")
    rows = Q.conj().T @ B
    n = len(A)
    R = np.zeros((n, n), dtype=complex)
    for k in range(n - 1, -1, -1):
        rate = -2.0 * T[k, k].real
        R[k, k] = np.linalg.norm(rows[k]) / np.sqrt(rate)
        if R[k, k] == 0.0:
            continue
        direction = rows[k] / R[k, k]
        pencil = T[:k, :k] + np.conj(T[k, k]) * np.eye(k)
        R[:k, k] = -np.linalg.solve(pencil, T[:k, k] * R[k, k] + rows[:k] @ direction.conj())
        rows[:k] -= np.outer(R[:k, k], direction)
    full = Q @ R
    return np.array(np.linalg.qr(np.hstack([full.real, full.imag]).T)[1], dtype=float).T


def _balancing(system: StateSpace) -> tuple[Array, Array, Array]:
    """Return Hankel singular values (n,), and the maps V (n, n), W (n, n) with W' V = I into balanced
    states."""
    R, S = _factor(system.A, system.B), _factor(system.A.T, system.C.T)
    U, sigma, Vt = np.linalg.svd(S.T @ R)
    root = np.sqrt(np.maximum(sigma, sigma.max(initial=0.0) * 1e-300 + 1e-300))
    return sigma, R @ Vt.T / root, S @ U / root


def hankel_singular_values(system: StateSpace) -> Array:
    """Return the (n,) values in falling order. Error: ValueError for an unstable system."""
    if not system.is_stable():
        raise ValueError("Hankel singular values are those of a stable system: split off the unstable part")
    return _balancing(balanced(system))[0]


def reduce(system: StateSpace, order: int, method: Method = Method.TRUNCATE) -> StateSpace:
    """Return ``system`` with ``order`` states. Error: ValueError for an unstable system or an order out of
    range."""
    if not 0 < order < system.order:
        raise ValueError(f"fewer states than the {system.order} of the controller, and one at least")
    if method is Method.PAPER:
        return _paper(system, order)
    even = balanced(system)
    if not even.is_stable():
        raise ValueError("only a stable system is balanced: split off the unstable part")
    _, V, W = _balancing(even)
    if method is Method.TRUNCATE:
        V, W = V[:, :order], W[:, :order]
        return StateSpace(W.T @ even.A @ V, W.T @ even.B, even.C @ V, even.D, even.period_s)
    A, B, C = W.T @ even.A @ V, W.T @ even.B, even.C @ V
    kept, gone = slice(0, order), slice(order, None)
    to_kept = np.linalg.solve(A[gone, gone].T, A[kept, gone].T).T
    from_gone = np.linalg.solve(A[gone, gone].T, C[:, gone].T).T
    return StateSpace(
        A[kept, kept] - to_kept @ A[gone, kept],
        B[kept] - to_kept @ B[gone],
        C[:, kept] - from_gone @ A[gone, kept],
        even.D - from_gone @ B[gone],
    )


def paper_rule(system: StateSpace) -> Zpk:
    """Return the third-order form of (71): the fastest pole and zero cancel, the slowest pole moves to 0.

    The gain stays as it is, although pole and zero differ by 0.14 %: so does the printed one.
    """
    full = zpk(system)
    if not len(full.zeros) or len(full.poles) < 2:
        raise ValueError("the paper's rule needs a zero and two poles")
    poles = full.poles[:-1].copy()
    poles[0] = 0.0
    return Zpk(full.zeros[:-1], poles, full.gain)


def _paper(system: StateSpace, order: int) -> StateSpace:
    if order != system.order - 1:
        raise ValueError(f"{system.order - 1} states: the paper's rule takes one away")
    reduced = paper_rule(system)
    return from_zpk(reduced.zeros, reduced.poles, reduced.gain)
