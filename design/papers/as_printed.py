"""[Ling2012] Theorems 3.1 and 3.3 with all their matrices, written in cvxpy.

A second, slower formulation of what :mod:`servobench.design.delay.certificate` builds at order 0: there Y
and W are eliminated and the problem goes to the solver as plain data; here both stay, the last block row is
multiplied by eta Z (the correction that makes (3.1) and (3.10) linear), and cvxpy does the rest. ``hil
analyse speed --as-printed`` and the reproduction show both, the tests compare them, the benchmark times them.
"""

import importlib
import math
from typing import Any

import numpy as np

from servobench.design.delay.certificate import STABLE_MARGIN, STRICT, scaled
from servobench.design.delay.delay_loop import Array, DelayLoop
from servobench.design.errors import NoSolution


def theorem_3_3(loop: DelayLoop, state_scale: Array, gain_scale: float) -> float:
    """Return the least gamma of Theorem 3.3, rad/s per N m, at the loop's delay.

    ``gain_scale``: about the gain expected, for scaling. Raises NoSolution.
    """
    cp = _cvxpy()
    unit = scaled(loop, state_scale, gain_scale)
    n = len(unit.A)
    square = cp.Variable((1, 1))
    P, Q, Z, M = _blocks(cp, unit.A, unit.D, unit.E[:, None], np.outer(unit.C, unit.C), square)
    constraints = [X >> STRICT * np.eye(n) for X in (P, Q, Z)] + [M << -STRICT * np.eye(M.shape[0])]
    problem = cp.Problem(cp.Minimize(square[0, 0]), constraints)
    problem.solve(solver=cp.CLARABEL)
    if problem.status != "optimal":
        raise NoSolution("Theorem 3.3 as printed", f"cvxpy says {problem.status}")
    return gain_scale * math.sqrt(float(problem.value))


def theorem_3_1(loop: DelayLoop, state_scale: Array) -> bool:
    """Return True if Theorem 3.1 proves the loop stable at its delay."""
    cp = _cvxpy()
    unit = scaled(loop, state_scale, 1.0)
    n = len(unit.A)
    P, Q, Z, M = _blocks(cp, unit.A, unit.D, np.zeros((n, 0)), np.zeros((n, n)), np.zeros((0, 0)))
    margin = cp.Variable()
    constraints = [X >> margin * np.eye(n) for X in (P, Q, Z)]
    constraints += [M << -margin * np.eye(M.shape[0]), cp.trace(P) + cp.trace(Q) + cp.trace(Z) <= 1.0]
    problem = cp.Problem(cp.Maximize(margin), constraints)
    problem.solve(solver=cp.CLARABEL)
    return bool(problem.status == "optimal" and problem.value > STABLE_MARGIN)


def _cvxpy() -> Any:
    """Import cvxpy on demand: it takes a second, and its own types say less than they promise."""
    return importlib.import_module("cvxpy")


def _blocks(cp: Any, A: Array, D: Array, E: Array, CC: Array, square: Any) -> tuple[Any, Any, Any, Any]:
    """Return P, Q, Z and the matrix of (3.10), whose (4, 4) entry is -square, with eta = 1."""
    n, m = E.shape
    P, Q, Z = (cp.Variable((n, n), symmetric=True) for _ in range(3))
    Y, W = cp.Variable((n, n)), cp.Variable((n, n))
    corner = P @ D - Y + W.T
    rows = [
        [A.T @ P + P @ A + Y + Y.T + Q + CC, corner, -Y, P @ E, A.T @ Z],
        [corner.T, -Q - W - W.T, -W, np.zeros((n, m)), D.T @ Z],
        [-Y.T, -W.T, -Z, np.zeros((n, m)), np.zeros((n, n))],
        [E.T @ P, np.zeros((m, n)), np.zeros((m, n)), -square, E.T @ Z],
        [Z @ A, Z @ D, np.zeros((n, n)), Z @ E, -Z],
    ]
    if m == 0:
        rows = [[row[k] for k in (0, 1, 2, 4)] for row in (rows[k] for k in (0, 1, 2, 4))]
    M = cp.bmat(rows)
    return P, Q, Z, 0.5 * (M + M.T)
