"""Linear matrix inequalities: built here as data, solved in one place, checked in numpy.

A problem is: minimise c'y over y, subject to F_j(y) = F_j0 + sum_k y_k F_jk >= margin I for each j,
where y holds the free entries of the unknown matrices. Building knows nothing of the solver.
"""

from dataclasses import dataclass, field
from functools import cache

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution

SOLVER = "Clarabel"
SOLVED = "Solved"
_ENDS = (SOLVED, "AlmostSolved", "InsufficientProgress", "NumericalError", "MaxIterations")
"""Statuses that do not say that there is no solution."""


class Unknowns:
    """The unknown matrices of a problem and the places of their entries in y."""

    def __init__(self) -> None:
        self._bases: dict[str, Array] = {}
        self._starts: dict[str, int] = {}
        self.count = 0

    def symmetric(self, name: str, n: int) -> None:
        """Add a symmetric n x n unknown."""
        self._add(name, _symmetric_basis(n))

    def full(self, name: str, rows: int, columns: int) -> None:
        """Add an unstructured unknown."""
        self._add(name, np.eye(rows * columns).reshape(rows * columns, rows, columns))

    def slice_of(self, name: str) -> slice:
        """Return the places of the entries of ``name`` in y."""
        start = self._starts[name]
        return slice(start, start + len(self._bases[name]))

    def basis(self, name: str) -> Array:
        """Return (entries, rows, columns): the matrix of each entry."""
        return self._bases[name]

    def value(self, name: str, y: Array) -> Array:
        """Return the matrix ``name`` at ``y``."""
        return np.asarray(np.tensordot(y[self.slice_of(name)], self._bases[name], axes=1))

    @property
    def last(self) -> Array:
        """The (count,) objective that is the last entry of y."""
        return np.asarray(np.eye(1, self.count, self.count - 1)[0])

    def values(self, y: Array) -> dict[str, Array]:
        """Return every matrix at ``y``."""
        return {name: self.value(name, y) for name in self._bases}

    def _add(self, name: str, basis: Array) -> None:
        self._bases[name] = basis
        self._starts[name] = self.count
        self.count += len(basis)


@dataclass(slots=True, eq=False)
class MatrixInequality:
    """F(y) = constant + sum_k y_k coefficients[k], an (m, m) symmetric matrix affine in the unknowns."""

    constant: Array
    coefficients: Array

    @classmethod
    def zero(cls, unknowns: Unknowns, m: int) -> "MatrixInequality":
        """Return F = 0, to add to."""
        return cls(np.zeros((m, m)), np.zeros((unknowns.count, m, m)))

    @classmethod
    def positive(cls, unknowns: Unknowns, name: str) -> "MatrixInequality":
        """Return F = V, symmetric."""
        m = unknowns.basis(name).shape[-1]
        part = cls.zero(unknowns, m)
        part.add(unknowns, name, np.eye(m))
        return part

    def add_form(self, unknowns: Unknowns, name: str, rows: Array, weight: float) -> None:
        """Add weight rows V rows'; rows is (m, rows of V)."""
        self.coefficients[unknowns.slice_of(name)] += weight * (rows @ unknowns.basis(name) @ rows.T)

    def add(self, unknowns: Unknowns, name: str, left: Array, right: Array | None = None) -> None:
        """Add left V right + its transpose, or left V left' without ``right``; left is (m, rows of V)."""
        part = unknowns.slice_of(name)
        if right is None:
            self.coefficients[part] += left @ unknowns.basis(name) @ left.T
        else:
            product = left @ unknowns.basis(name) @ right
            self.coefficients[part] += product + np.swapaxes(product, 1, 2)

    def at(self, y: Array) -> Array:
        """Return F(y)."""
        return self.constant + _weighted(y, self.coefficients)


@dataclass(frozen=True, slots=True, eq=False)
class LmiProblem:
    """Minimise objective'y subject to every inequality >= margin I."""

    what: str
    unknowns: Unknowns
    inequalities: list[MatrixInequality]
    objective: Array
    margin: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LmiSolution:
    """An optimum: y, and the multiplier of each inequality (positive semidefinite)."""

    y: Array
    duals: list[Array] = field(repr=False)


def solve(problem: LmiProblem, tolerance: float = 1e-9, enough: float = 1e-8) -> LmiSolution:
    """Solve to the relative ``tolerance``, or where the solver stops short of that, to ``enough``.

    Raises NoSolution with the solver's status for anything but an optimum.
    """
    answer = _ask(problem, tolerance, enough)
    if str(answer.status) not in (SOLVED, "AlmostSolved"):
        raise NoSolution(
            problem.what,
            f"{SOLVER} says {answer.status}",
            f"{answer.iterations} iterations, residuals {answer.r_prim:.1e} and {answer.r_dual:.1e}",
        )
    y = np.asarray(answer.x)
    duals, start, z = [], 0, np.asarray(answer.z)
    for inequality in problem.inequalities:
        m = len(inequality.constant)
        length = m * (m + 1) // 2
        duals.append(_matrix(z[start : start + length], m))
        start += length
    return LmiSolution(y, duals)


def last_answer(problem: LmiProblem, tolerance: float) -> Array | None:
    """Return y where the solver ends, at an optimum or short of it, for callers who prove it; None: it
    reports infeasibility."""
    answer = _ask(problem, tolerance, tolerance)
    y = np.asarray(answer.x)
    return y if str(answer.status) in _ENDS and np.all(np.isfinite(y)) else None


def smallest_eigenvalues(problem: LmiProblem, y: Array) -> list[float]:
    """Return the smallest eigenvalue of each inequality at ``y``, in numpy, independent of the solver."""
    return [float(np.linalg.eigvalsh(inequality.at(y))[0]) for inequality in problem.inequalities]


def rounding_of(problem: LmiProblem, y: Array) -> float:
    """Bound the rounding error of those eigenvalues: m eps times the sum of the moduli of all terms."""
    worst = 0.0
    for inequality in problem.inequalities:
        size = np.abs(inequality.constant) + _weighted(np.abs(y), np.abs(inequality.coefficients))
        worst = max(worst, float(np.linalg.norm(size)) * len(size) * np.finfo(float).eps)
    return worst


def _ask(problem: LmiProblem, tolerance: float, enough: float) -> clarabel.DefaultSolution:
    rows, bounds, cones = [], [], []
    for inequality in problem.inequalities:
        m = len(inequality.constant)
        rows.append(-_triangle(inequality.coefficients))
        bounds.append(_triangle(inequality.constant - problem.margin * np.eye(m)))
        cones.append(clarabel.PSDTriangleConeT(m))
    n = problem.unknowns.count
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = enough
    solver = clarabel.DefaultSolver(
        _no_quadratic_cost(n),
        problem.objective,
        _by_unknowns(np.hstack(rows)),
        np.concatenate(bounds),
        cones,
        settings,
    )
    return solver.solve()


def _by_unknowns(rows: Array) -> sparse.csc_matrix:
    """Return the transpose of the (unknowns, entries) given, sparse."""
    places, entries = np.nonzero(rows)
    starts = np.searchsorted(places, np.arange(len(rows) + 1))
    return sparse.csc_matrix((rows[places, entries], entries, starts), shape=rows.shape[::-1])


@cache
def _no_quadratic_cost(n: int) -> sparse.csc_matrix:
    return sparse.csc_matrix((n, n))


def _weighted(y: Array, matrices: Array) -> Array:
    """Return the sum of y_k times the k-th matrix; a product of vectors is several times as fast as a
    tensor's."""
    return np.asarray(y @ matrices.reshape(len(y), -1)).reshape(matrices.shape[1:])


@cache
def _symmetric_basis(n: int) -> Array:
    """Return (n (n + 1)/2, n, n): the matrix of each entry of an upper triangle, by rows."""
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    index = np.arange(len(rows))
    basis[index, rows, columns] = 1.0
    basis[index, columns, rows] = 1.0
    basis.setflags(write=False)
    return basis


@cache
def _triangle_places(m: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return rows and columns of an upper triangle by columns, and weights: sqrt 2 off the diagonal."""
    columns, rows = np.tril_indices(m)
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def _triangle(matrices: Array) -> Array:
    """Return the upper triangle by columns, off-diagonal entries times sqrt 2: the solver's vector of a
    matrix."""
    rows, columns, weights = _triangle_places(matrices.shape[-1])
    return np.asarray(matrices[..., rows, columns] * weights)


def _matrix(vector: Array, m: int) -> Array:
    rows, columns, weights = _triangle_places(m)
    matrix = np.zeros((m, m))
    matrix[rows, columns] = matrix[columns, rows] = vector / weights
    return matrix
