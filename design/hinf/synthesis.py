"""H-infinity output feedback by the formulae of Glover and Doyle, [Azaiz2007] (10) to (32) as corrected.

The printed formulae have slips; used here are (17) with the second row [-B1 B1', -A], (21) with + Y C' and
R_nj^-1, (24) with D1111', (25) with D1121 on both sides, (28) with D21hat, and (30) with the scaling of
the inputs undone (Zhou, Doyle, Glover, Robust and Optimal Control, 1996, theorem 17.1, says the same).

Partitions in the normal form: D11 = [D1111 D1112; D1121 D1122], the last rows as many as controls, the
last columns as many as measurements.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from design.errors import InfeasibleDesign, SingularPlant
from design.hinf.plant import GeneralisedPlant, NormalPlant, normal_form
from design.hinf.riccati import (
    LongArray,
    NoRiccatiSolution,
    RiccatiSolution,
    is_positive_semidefinite,
    stabilising_solution,
)
from design.hinf.system_norm import hinf_norm
from design.statespace import Array, ComplexArray, StateSpace, connect, lower_lft

GAMMA_MIN_RELATIVE = 1e-10
"""How far apart, relative, the last feasible and the last infeasible gamma of the search are."""
_DOUBLINGS_MAX = 60
_TRIES = 3
"""Steps of regula falsi in which the interval is to shrink to a quarter, as two halvings would."""
_KEPT_MIN = 0.2
"""Of the distance at the end that stays: Anderson and Bjorck keep none of it where the function is flat."""
_DIRECT_GAIN = "condition (a): the direct gain from w to z"
_BESIDE = 0.4
"""Of the width asked for: so far inside the interval the zero is tried at least."""
_TWO = np.longdouble(2)
_ERROR_MAX = 0.02
"""Relative error of X or Y beyond which no figure is given, but the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class Synthesis:
    """All controllers for one gamma: K = F_l(M, Phi) with ||Phi|| < gamma; ``controller`` has Phi = 0."""

    gamma: float
    controller: StateSpace
    generator: StateSpace
    """M of (23): inputs [y; Phi's output], outputs [u; Phi's input]."""
    X: Array
    Y: Array
    state_feedback_modes: ComplexArray
    """Eigenvalues of E_x - W_x X, 1/s."""
    observer_modes: ComplexArray
    """Eigenvalues of E_y - W_y Y, 1/s."""
    controls: int

    def with_parameter(self, parameter: StateSpace) -> StateSpace:
        """F_l(M, Phi). Error: ValueError unless Phi is stable with a norm below gamma."""
        norm = hinf_norm(parameter).gain
        if not norm < self.gamma:
            raise ValueError(f"the parameter's norm {norm:.6g} must be below gamma {self.gamma:.6g}")
        return lower_lft(self.generator, parameter)


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One of the two Riccati equations, as far as it is the same for every gamma: :func:`_side`."""

    a: LongArray
    b: LongArray
    dd: LongArray
    dc: LongArray
    cc: LongArray
    size_cc: Array
    size_cd: Array
    disturbances: int


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The equations of X and of Y, and condition (a)."""

    control: _Side
    observer: _Side
    direct_gain: float


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """What a gamma gives: the Riccati solutions, F and L of (20) to (22)."""

    X: RiccatiSolution
    Y: RiccatiSolution
    F: Array
    L: Array
    coupling: float
    """gamma^2 over the spectral radius of X Y, less 1."""


@dataclass(frozen=True, slots=True)
class _Fails:
    """Which condition of theorem 1 fails.

    ``distance``: below 0 and nearly straight in gamma near the limit that the condition sets; ``before``
    continues it at a gamma that is feasible. 0 and infinity where they are not known.
    """

    condition: str
    distance: float = 0.0
    before: Callable[[_Solved], float] = lambda _: math.inf


def synthesise(plant: GeneralisedPlant, gamma: float) -> Synthesis:
    """All controllers with ||F_l(P, K)|| < ``gamma``.

    Raises SingularPlant (A1 to A4), and InfeasibleDesign with gamma_min if ``gamma`` is not above it.
    """
    normal = normal_form(plant)
    found = _evaluated(_problem(normal), gamma)
    if isinstance(found, _Fails):
        least = gamma_min(plant)
        raise InfeasibleDesign(
            f"gamma = {gamma:.9g}",
            f"gamma_min is {least:.9g} ({found.condition})",
            "take a larger gamma, or relax the weights",
        )
    _require_accurate(found)
    return _controllers(normal, gamma, found, plant.controls)


def gamma_min(plant: GeneralisedPlant, relative: float = GAMMA_MIN_RELATIVE) -> float:
    """The least gamma that a controller reaches, to ``relative``, from above: the value returned is feasible.

    Raises SingularPlant (A1 to A4).
    """
    problem = _problem(normal_form(plant))
    low = problem.direct_gain
    high = max(2.0 * low, 1.0)
    fails = _Fails(_DIRECT_GAIN)
    for _ in range(_DOUBLINGS_MAX):
        found = _evaluated(problem, high)
        if not isinstance(found, _Fails):
            break
        low, high, fails = high, 2.0 * high, found
    else:
        raise InfeasibleDesign("a finite gamma", f"none up to {high:.3g}", "check the scaling of w and z")
    least = 1e-12 * high
    while low == 0.0:
        lower = _evaluated(problem, 0.5 * high)
        if isinstance(lower, _Fails):
            low, fails = 0.5 * high, lower
        else:
            high, found = 0.5 * high, lower
            low = 0.5 * high if high <= least else 0.0
    high = _last_feasible(problem, (low, fails), (high, found), relative)
    beside = _evaluated(problem, high * (1.0 + 1e-4))
    if not isinstance(beside, _Fails):
        _require_accurate(beside)
    return high


def _last_feasible(
    problem: _Problem, infeasible: tuple[float, _Fails], feasible: tuple[float, _Solved], relative: float
) -> float:
    """The feasible gamma next to an infeasible one, between the two given.

    The zero of the distance from the condition that fails at the lower end is tried (regula falsi with the
    steps of Anderson and Bjorck); where that is condition (a), the very limit. Where no distance is known, or
    three steps have not quartered the interval, that is halved.
    """
    (low, fails), (high, found) = infeasible, feasible
    width, tries, weight = high - low, 0, 1.0
    last: bool | None = None
    while high - low > relative * high:
        below, above = fails.distance, fails.before(found)
        step = _BESIDE * relative * high
        middle = math.sqrt(low * high)
        if fails.condition is _DIRECT_GAIN and last:
            middle = low + step
        elif tries < _TRIES and below < 0.0 < above < math.inf:
            left, right = below * (weight if last else 1.0), above * (1.0 if last else weight)
            middle = min(max((low * right - high * left) / (right - left), low + step), high - step)
        if not low < middle < high:
            break
        new = _evaluated(problem, middle)
        if isinstance(new, _Fails):
            low, fails, ratio = middle, new, new.distance / (below or math.inf)
        else:
            high, found, ratio = middle, new, fails.before(new) / above if above < math.inf else 0.0
        is_feasible = high == middle
        weight = weight * max(1.0 - ratio, _KEPT_MIN) if is_feasible is last else 1.0
        last, tries = is_feasible, tries + 1
        if high - low < 0.25 * width:
            width, tries = high - low, 0
    return high


def _double(matrix: LongArray) -> Array:
    return np.asarray(matrix, dtype=float)


def _require_accurate(found: _Solved) -> None:
    """Raises SingularPlant where rounding leaves X or Y without true digits."""
    for solution, name, assumption, end in (
        (found.X, "X", "A2 or A3", "control a larger direct weight, D12"),
        (found.Y, "Y", "A2 or A4", "measurement a larger direct disturbance, D21"),
    ):
        if solution.error > _ERROR_MAX:
            raise SingularPlant(
                assumption,
                f"nearly broken: {name} is known to {solution.error:.1g} of itself only",
                f"give every {end}, or move modes that lie more than ten decades apart together",
            )


def closed_loop(plant: GeneralisedPlant, controller: StateSpace) -> StateSpace:
    """F_l(P, K), from w to z."""
    return lower_lft(plant.system, controller)


def verified_norm(plant: GeneralisedPlant, controller: StateSpace) -> float:
    """||F_l(P, K)||, computed without the synthesis' own quantities; infinite if the loop is unstable."""
    return hinf_norm(closed_loop(plant, controller)).gain


def direct_gain_bound(D11: Array, controls: int, measurements: int) -> float:
    """Condition (a) of theorem 1: what the direct gain from w to z leaves out of the controls' reach."""
    rows, columns = D11[:-controls], D11[:, :-measurements]
    sizes = [float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in (rows, columns)]
    return max(sizes)


def _problem(normal: NormalPlant) -> _Problem:
    m2, p2 = normal.B2.shape[1], normal.C2.shape[0]
    D1s = np.hstack([normal.D11, np.eye(len(normal.D11))[:, -m2:]])
    Ds1 = np.vstack([normal.D11, np.eye(normal.D11.shape[1])[-p2:]])
    B, C = np.hstack([normal.B1, normal.B2]), np.vstack([normal.C1, normal.C2])
    return _Problem(
        _side(normal.A, B, normal.C1, D1s, normal.B1.shape[1]),
        _side(normal.A.T, C.T, normal.B1.T, Ds1.T, len(normal.C1)),
        direct_gain_bound(normal.D11, m2, p2),
    )


def _side(A: Array, B: Array, C1: Array, D: Array, disturbances: int) -> _Side:
    """The equation of X (18); with A', C', B1' and Ds1' for their arguments: of Y (19)."""
    a, b, c, d = (np.asarray(part, dtype=np.longdouble) for part in (A, B, C1, D))
    sizes = np.abs(C1.T) @ np.abs(C1), np.abs(C1.T @ D)
    return _Side(a, b, d.T @ d, d.T @ c, c.T @ c, *sizes, disturbances)


def _evaluated(problem: _Problem, gamma: float) -> _Solved | _Fails:
    """X, Y, F and L for ``gamma``, or which condition of theorem 1 fails.

    Feasibility is decided by the signs of X and Y and by the radius of their product; eigenvalues near the
    imaginary axis are no safe sign when modes lie eight decades apart.
    """
    if gamma <= problem.direct_gain:
        return _Fails(_DIRECT_GAIN)
    X, F = _solution(problem.control, gamma)
    if not isinstance(X, RiccatiSolution) or not is_positive_semidefinite(X):
        return _no_solution("X", X, lambda solved: solved.X)
    Y, Lt = _solution(problem.observer, gamma)
    if not isinstance(Y, RiccatiSolution) or not is_positive_semidefinite(Y):
        return _no_solution("Y", Y, lambda solved: solved.Y)
    product = np.asarray(X.X @ Y.X, dtype=float)
    radius = float(np.abs(np.linalg.eigvals(product)).max(initial=0.0))
    solved = _Solved(X, Y, F, Lt.T, gamma**2 / radius - 1.0 if radius > 0.0 else math.inf)
    if solved.coupling > 0.0:
        return solved
    return _Fails("condition (b): the spectral radius of X Y", solved.coupling, lambda each: each.coupling)


def _no_solution(
    name: str, end: RiccatiSolution | NoRiccatiSolution, of: Callable[[_Solved], RiccatiSolution]
) -> _Fails:
    """X (or Y) stops being >= 0 through infinity, so that 1 over the eigenvalue that does so is straight. It
    stops to exist where two eigenvalues of H meet on the axis, having come and leaving as square roots do."""
    condition = f"condition (b): no stabilising {name} >= 0"
    if isinstance(end, RiccatiSolution):
        least = np.linalg.eigvalsh(_double(end.X))[0]
        return _Fails(
            condition,
            1.0 / min(least, -1e-300),
            lambda each: 1.0 / max(np.linalg.eigvalsh(_double(of(each).X))[-1], 1e-300),
        )

    def off_axis(solved: _Solved) -> float:
        modes = of(solved).closed_loop
        return float(modes[np.argmin(np.abs(modes - end.centre))].real ** 2)

    return _Fails(condition, -(end.half_gap**2), off_axis)


def _solution(side: _Side, gamma: float) -> tuple[RiccatiSolution | NoRiccatiSolution, Array]:
    """X and F of (20); or Y and L' of (21)."""
    R = side.dd.copy()
    first = np.arange(side.disturbances)
    R[first, first] -= np.longdouble(gamma) ** 2
    try:
        inverse = _inverse(R)
    except np.linalg.LinAlgError:
        return NoRiccatiSolution(0.0, 0.0), np.zeros((0, 0))
    cross, inputs = inverse @ side.dc, inverse @ side.b.T
    W: LongArray = side.b @ inputs
    Q: LongArray = side.cc - side.dc.T @ cross
    terms = side.size_cc + side.size_cd @ np.abs(_double(cross))
    solution = stabilising_solution(side.a - side.b @ cross, (W + W.T) / _TWO, (Q + Q.T) / _TWO, terms)
    if not isinstance(solution, RiccatiSolution):
        return solution, np.zeros((0, 0))
    return solution, _double(-(cross + inputs @ solution.X))


def _inverse(R: LongArray) -> LongArray:
    """R^-1 in extended precision: the one in double precision and two steps of Newton and Schulz."""
    inverse = np.asarray(np.linalg.inv(np.asarray(R, dtype=float)), dtype=np.longdouble)
    for _ in range(2):
        inverse = inverse @ (2.0 * np.eye(len(R)) - R @ inverse)
    return inverse


def _controllers(normal: NormalPlant, gamma: float, found: _Solved, controls: int) -> Synthesis:
    """M of theorem 2, (23) to (31), with the normalisation and D22 undone."""
    m2, p2 = normal.B2.shape[1], normal.C2.shape[0]
    m1, p1 = normal.B1.shape[1], len(normal.C1)
    D11_hat, D12_hat, D21_hat = _direct_gains(normal.D11, gamma, m2, p2)
    F12, F2 = found.F[m1 - p2 : m1], found.F[m1:]
    L12, L2 = found.L[:, p1 - m2 : p1], found.L[:, p1:]
    Z = np.linalg.inv(np.asarray(np.eye(len(normal.A)) - found.Y.X @ found.X.X / gamma**2, dtype=float))
    B2_hat = Z @ (normal.B2 + L12) @ D12_hat
    C2_hat = -D21_hat @ (normal.C2 + F12)
    B1_hat = -Z @ L2 + B2_hat @ np.linalg.solve(D12_hat, D11_hat)
    C1_hat = F2 + D11_hat @ np.linalg.solve(D21_hat, C2_hat)
    B = np.hstack([normal.B1, normal.B2])
    A_hat = normal.A + B @ found.F + B1_hat @ np.linalg.solve(D21_hat, C2_hat)
    rate = normal.rate_rad_s
    generator = StateSpace(
        A_hat * rate,
        np.hstack([B1_hat @ normal.right, B2_hat]) * rate,
        np.vstack([normal.left @ C1_hat, C2_hat]),
        np.block(
            [
                [normal.left @ D11_hat @ normal.right, normal.left @ D12_hat],
                [D21_hat @ normal.right, np.zeros((p2, m2))],
            ]
        ),
    )
    generator = _over_direct_gain(generator, normal.D22)
    return Synthesis(
        gamma=gamma,
        controller=generator.part(slice(0, m2), slice(0, p2)),
        generator=generator,
        X=np.asarray(found.X.X, dtype=float),
        Y=np.asarray(found.Y.X, dtype=float),
        state_feedback_modes=found.X.closed_loop * rate,
        observer_modes=found.Y.closed_loop * rate,
        controls=controls,
    )


def _direct_gains(D11: Array, gamma: float, m2: int, p2: int) -> tuple[Array, Array, Array]:
    """D11hat, D12hat (lower Cholesky factor of T2) and D21hat (upper one of T3), (24) to (26)."""
    D1111, D1112 = D11[:-m2, :-p2], D11[:-m2, -p2:]
    D1121, D1122 = D11[-m2:, :-p2], D11[-m2:, -p2:]
    left = gamma**2 * np.eye(len(D1111)) - D1111 @ D1111.T
    right = gamma**2 * np.eye(D1111.shape[1]) - D1111.T @ D1111
    across = np.linalg.solve(left, D1112)
    D11_hat = -D1121 @ D1111.T @ across - D1122
    T1 = np.eye(m2) - D1121 @ np.linalg.solve(right, D1121.T)
    T3 = np.eye(p2) - D1112.T @ across
    lower = [np.asarray(np.linalg.cholesky(T), dtype=float) for T in (T1, T3)]
    return D11_hat, lower[0], lower[1].T


def _over_direct_gain(generator: StateSpace, D22: Array) -> StateSpace:
    """The controllers of a plant with direct gain D22 from those of the plant without: y - D22 u for y."""
    p2, m2 = D22.shape
    p, m = generator.D.shape
    feedback = np.zeros((m, p))
    feedback[:p2, :m2] = -D22
    return connect(generator, feedback, np.eye(m), np.eye(p)) if np.any(D22) else generator
