"""The conditions of theorem 1 of [Azaiz2007] for one gamma: two Riccati equations, (18) to (22).

gamma is feasible exactly if (a) it is above what the direct gain from w to z leaves out of the controls'
reach, and (b) both equations have stabilising solutions X >= 0 and Y >= 0, the spectral radius of X Y below
gamma^2.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servobench.design.hinf.mixed_sensitivity import NormalPlant
from servobench.design.hinf.riccati import LongArray, NoRiccatiSolution, RiccatiSolution, stabilising_solution
from servobench.design.statespace import Array

DIRECT_GAIN = "condition (a): the direct gain from w to z"
COUPLING = "condition (b): the spectral radius of X Y"
_COUPLING_MIN = 1e-12
"""Below this I - Y X/gamma^2 has no accurate inverse."""
_TWO = np.longdouble(2)


def _double(matrix: LongArray) -> Array:
    return np.asarray(matrix, dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One of the two Riccati equations, as far as it is the same for every gamma: :func:`_side`."""

    E: LongArray
    G: LongArray
    B2: LongArray
    free: LongArray
    """Rows of C1 that no control reaches directly."""
    direct: LongArray
    """The other rows, less the part cancelled by u = -direct x."""
    free_gain: LongArray
    """Rows of D11 in the same way."""
    direct_gain: LongArray
    sizes: Array
    """(n, n) |C1'| |C1|, of which Q is a part."""
    nothing: tuple[RiccatiSolution, LongArray] | None
    """X = 0 and its F, if they hold for every gamma."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The equations of X and Y, and condition (a)."""

    control: _Side
    observer: _Side
    direct_gain: float


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Solutions for one gamma: X, Y, and F and L of (20) to (22)."""

    X: RiccatiSolution
    Y: RiccatiSolution
    F: LongArray
    L: LongArray
    coupling: float
    """gamma^2 over the spectral radius of X Y, less 1."""


@dataclass(frozen=True, slots=True)
class Fails:
    """The condition of theorem 1 that fails.

    ``distance``: below 0 and nearly straight in gamma near the limit that the condition sets; ``before``
    continues it at a gamma that is feasible. 0 and infinity where they are not known.
    """

    condition: str
    distance: float = 0.0
    before: Callable[[Solved], float] = lambda _: math.inf


def direct_gain_bound(D11: Array, controls: int, measurements: int) -> float:
    """Return condition (a) of theorem 1: the direct gain from w to z out of the controls' reach."""
    rows, columns = D11[:-controls], D11[:, :-measurements]
    sizes = [float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in (rows, columns)]
    return max(sizes)


def problem_of(normal: NormalPlant) -> Problem:
    """Compute everything that does not depend on gamma."""
    m2, p2 = normal.B2.shape[1], normal.C2.shape[0]
    return Problem(
        _side(normal.A, normal.B1, normal.B2, normal.C1, normal.D11),
        _side(normal.A.T, normal.C1.T, normal.C2.T, normal.B1.T, normal.D11.T),
        direct_gain_bound(normal.D11, m2, p2),
    )


def _side(A: Array, B1: Array, B2: Array, C1: Array, D11: Array) -> _Side:
    """Prepare the equation of X (18), after u = -direct x - direct_gain w + v; of Y (19), with the
    transposes.

    X is unchanged, but nothing has to cancel: Q is a sum of squares, and 0 if every error has its own
    control.
    """
    a, b1, b2, c, d = (np.asarray(part, dtype=np.longdouble) for part in (A, B1, B2, C1, D11))
    m2 = b2.shape[1]
    free, direct, free_gain, direct_gain = c[:-m2], c[-m2:], d[:-m2], d[-m2:]
    sizes = np.abs(C1.T) @ np.abs(C1)
    E, nothing = a - b2 @ direct, None
    if not free.any():
        solution = stabilising_solution(E, np.zeros_like(E), np.zeros_like(E), sizes)
        if isinstance(solution, RiccatiSolution):
            nothing = solution, np.vstack([np.zeros_like(b1.T), -direct])
    return _Side(E, b1 - b2 @ direct_gain, b2, free, direct, free_gain, direct_gain, sizes, nothing)


def evaluated(problem: Problem, gamma: float, thorough: bool = True) -> Solved | Fails:
    """Return X, Y, F and L for ``gamma``, or the condition of theorem 1 that fails.

    Feasibility is decided by the signs of X and Y and by the radius of their product; eigenvalues near the
    imaginary axis are no safe sign when modes lie eight decades apart. Less than ``thorough``: for a search,
    which needs the signs alone.
    """
    if gamma <= problem.direct_gain:
        return Fails(DIRECT_GAIN)
    X, F = _solution(problem.control, gamma, thorough)
    if not isinstance(X, RiccatiSolution) or not X.is_nonnegative:
        return _no_solution("X", X, lambda solved: solved.X)
    Y, Lt = _solution(problem.observer, gamma, thorough)
    if not isinstance(Y, RiccatiSolution) or not Y.is_nonnegative:
        return _no_solution("Y", Y, lambda solved: solved.Y)
    product = np.asarray(X.X @ Y.X, dtype=float)
    radius = float(np.abs(np.linalg.eigvals(product)).max(initial=0.0))
    solved = Solved(X, Y, F, Lt.T, gamma**2 / radius - 1.0 if radius > 0.0 else math.inf)
    if solved.coupling > _COUPLING_MIN:
        return solved
    return Fails(COUPLING, min(solved.coupling, 0.0), lambda each: each.coupling)


def _no_solution(
    name: str, end: RiccatiSolution | NoRiccatiSolution, of: Callable[[Solved], RiccatiSolution]
) -> Fails:
    """Describe the failure. X (or Y) loses X >= 0 through infinity, so that 1 over the eigenvalue concerned
    is straight. It ceases to exist where two eigenvalues of H meet on the axis, approaching and leaving like
    square roots."""
    condition = f"condition (b): no stabilising {name} >= 0"
    if isinstance(end, RiccatiSolution):
        least = np.linalg.eigvalsh(_double(end.X))[0]
        return Fails(
            condition,
            1.0 / min(least, -1e-300),
            lambda each: 1.0 / max(np.linalg.eigvalsh(_double(of(each).X))[-1], 1e-300),
        )

    def off_axis(solved: Solved) -> float:
        modes = of(solved).closed_loop
        return float(modes[np.argmin(np.abs(modes - end.centre))].real ** 2)

    return Fails(condition, -(end.half_gap**2), off_axis)


def _solution(
    side: _Side, gamma: float, thorough: bool
) -> tuple[RiccatiSolution | NoRiccatiSolution, LongArray]:
    """Solve for X and F of (20); or Y and L' of (21)."""
    if side.nothing is not None:
        return side.nothing
    R = -side.free_gain.T @ side.free_gain
    R[np.diag_indices_from(R)] += np.longdouble(gamma) ** 2
    try:
        N = inverse(R)
    except np.linalg.LinAlgError:
        return NoRiccatiSolution(0.0, 0.0), side.E[:0]
    back = side.free_gain.T @ side.free
    cross = N @ back
    W: LongArray = side.B2 @ side.B2.T - side.G @ N @ side.G.T
    Q: LongArray = side.free.T @ side.free + back.T @ cross
    W, Q = (W + W.T) / _TWO, (Q + Q.T) / _TWO
    solution = stabilising_solution(side.E + side.G @ cross, W, Q, side.sizes, thorough)
    if not isinstance(solution, RiccatiSolution):
        return solution, side.E[:0]
    worst = cross + N @ side.G.T @ solution.X
    control = -(side.direct + side.direct_gain @ worst + side.B2.T @ solution.X)
    return solution, np.vstack([worst, control])


def inverse(R: LongArray) -> LongArray:
    """Return R^-1 in extended precision: the double-precision inverse and two steps of Newton and Schulz."""
    inverse = np.asarray(np.linalg.inv(np.asarray(R, dtype=float)), dtype=np.longdouble)
    for _ in range(2):
        inverse = inverse @ (2.0 * np.eye(len(R)) - R @ inverse)
    return inverse
