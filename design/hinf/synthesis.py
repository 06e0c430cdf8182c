"""H-infinity output feedback by the formulae of Glover and Doyle, [Azaiz2007] (10) to (32) as corrected.

The printed formulae have slips; used here are (17) with the second row [-B1 B1', -A], (21) with + Y C' and
R_nj^-1, (24) with D1111', (25) with D1121 on both sides, (28) with D21hat, and (30) with the scaling of
the inputs undone (Zhou, Doyle, Glover, Robust and Optimal Control, 1996, theorem 17.1, says the same).

Partitions in the normal form: D11 = [D1111 D1112; D1121 D1122], the last rows as many as controls, the
last columns as many as measurements.
"""

import math
from dataclasses import dataclass

import numpy as np

from design.errors import InfeasibleDesign, SingularPlant
from design.hinf.plant import GeneralisedPlant, NormalPlant, normal_form
from design.hinf.riccati import LongArray, RiccatiSolution, is_positive_semidefinite, stabilising_solution
from design.hinf.system_norm import hinf_norm
from design.statespace import Array, StateSpace, connect, lower_lft

GAMMA_MIN_RELATIVE = 1e-10
"""How far apart, relative, the last feasible and the last infeasible gamma of the bisection are."""
_DOUBLINGS_MAX = 60
_TRIES = 3
"""Steps of regula falsi in which the interval is to shrink to a quarter, as two halvings would."""
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
    state_feedback_modes: Array
    """Eigenvalues of E_x - W_x X, 1/s."""
    observer_modes: Array
    """Eigenvalues of E_y - W_y Y, 1/s."""
    controls: int

    def with_parameter(self, parameter: StateSpace) -> StateSpace:
        """F_l(M, Phi). Error: ValueError unless Phi is stable with a norm below gamma."""
        norm = hinf_norm(parameter).gain
        if not norm < self.gamma:
            raise ValueError(f"the parameter's norm {norm:.6g} must be below gamma {self.gamma:.6g}")
        return lower_lft(self.generator, parameter)


@dataclass(frozen=True, slots=True, eq=False)
class _Feasible:
    """What a gamma gives: the Riccati solutions, F and L of (20) to (22)."""

    X: RiccatiSolution
    Y: RiccatiSolution
    F: Array
    L: Array
    radius: float
    """Spectral radius of X Y."""


@dataclass(frozen=True, slots=True)
class _Fails:
    """Which condition of theorem 1 fails, and :func:`_distance` where it is known."""

    condition: str
    distance: float | None = None


def synthesise(plant: GeneralisedPlant, gamma: float) -> Synthesis:
    """All controllers with ||F_l(P, K)|| < ``gamma``.

    Raises SingularPlant (A1 to A4), and InfeasibleDesign with gamma_min if ``gamma`` is not above it.
    """
    normal = normal_form(plant)
    found = _feasible(normal, gamma)
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
    normal = normal_form(plant)
    low = direct_gain_bound(normal.D11, plant.controls, plant.measurements)
    high = max(2.0 * low, 1.0)
    for _ in range(_DOUBLINGS_MAX):
        if not isinstance(_feasible(normal, high), _Fails):
            break
        low, high = high, 2.0 * high
    else:
        raise InfeasibleDesign("a finite gamma", f"none up to {high:.3g}", "check the scaling of w and z")
    if low == 0.0:
        low = high
        while low > high * 1e-12 and not isinstance(_feasible(normal, low * 0.5), _Fails):
            low *= 0.5
        high, low = low, low * 0.5
    high = _last_feasible(normal, low, high, relative)
    beside = _feasible(normal, high * (1.0 + 1e-4))
    if not isinstance(beside, _Fails):
        _require_accurate(beside)
    return high


def _last_feasible(normal: NormalPlant, low: float, high: float, relative: float) -> float:
    """The feasible gamma next to an infeasible one, between ``low``, infeasible, and ``high``, feasible.

    Where the distance from the limit is known at both ends its zero is tried (regula falsi with the steps of
    Illinois). Where it is not, or three steps have not quartered the interval, that is halved.
    """
    ends: dict[bool, float | None] = {False: None, True: _distance(normal, high)}
    width, tries = high - low, 0
    last: bool | None = None
    while high - low > relative * high:
        middle = math.sqrt(low * high) if low > 0.0 else 0.5 * high
        below, above = ends[False], ends[True]
        if tries < _TRIES and below is not None and above is not None and math.isfinite(above):
            guess = (low * above - high * below) / (above - below)
            step = _BESIDE * relative * high
            middle = min(max(guess, low + step), high - step)
        if not low < middle < high:
            break
        value = _distance(normal, middle)
        feasible = value is not None and value > 0.0
        low, high = (low, middle) if feasible else (middle, high)
        ends[feasible] = value
        other = ends[not feasible]
        if feasible is last and other is not None:
            ends[not feasible] = 0.5 * other
        last, tries = feasible, tries + 1
        if high - low < 0.25 * width:
            width, tries = high - low, 0
    return high


def _distance(normal: NormalPlant, gamma: float) -> float | None:
    """Above 0 where ``gamma`` is feasible, and nearly straight through 0; None where X or Y is missing.

    inf where X and Y are nothing: then it does not say how far the limit is.

    X and Y cease to be >= 0 through infinity, so that 1 over the eigenvalue that does so is straight.
    """
    found = _solutions(normal, gamma)
    if isinstance(found, _Fails):
        return found.distance
    coupling = gamma**2 / found.radius - 1.0 if found.radius > 0.0 else math.inf
    if coupling <= 0.0:
        return coupling
    largest = max(float(np.linalg.norm(_double(each.X), 2)) for each in (found.X, found.Y))
    return min(coupling, 1.0 / largest) if largest > 0.0 else coupling


def _indefinite(solution: RiccatiSolution) -> float:
    """1 over the most negative eigenvalue of an X that is not >= 0."""
    return 1.0 / min(float(np.linalg.eigvalsh(_double(solution.X))[0]), -1e-300)


def _double(matrix: LongArray) -> Array:
    return np.asarray(matrix, dtype=float)


def _require_accurate(found: _Feasible) -> None:
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


def _feasible(normal: NormalPlant, gamma: float) -> _Feasible | _Fails:
    """X, Y, F and L for ``gamma``, or which condition of theorem 1 fails."""
    found = _solutions(normal, gamma)
    if not isinstance(found, _Fails) and found.radius >= gamma**2:
        return _Fails("condition (b): the spectral radius of X Y")
    return found


def _solutions(normal: NormalPlant, gamma: float) -> _Feasible | _Fails:
    """The same before the radius of X Y is looked at.

    Feasibility is decided by the signs of X and Y and by the radius of their product; eigenvalues near the
    imaginary axis are no safe sign when modes lie eight decades apart.
    """
    m2, p2 = normal.B2.shape[1], normal.C2.shape[0]
    if gamma <= direct_gain_bound(normal.D11, m2, p2):
        return _Fails("condition (a): the direct gain from w to z")
    D1s = np.hstack([normal.D11, np.eye(len(normal.D11))[:, -m2:]])
    Ds1 = np.vstack([normal.D11, np.eye(normal.D11.shape[1])[-p2:]])
    B, C = np.hstack([normal.B1, normal.B2]), np.vstack([normal.C1, normal.C2])
    X, F = _control_side(normal.A, B, normal.C1, D1s, gamma, normal.B1.shape[1])
    if X is None or not is_positive_semidefinite(X):
        return _Fails("condition (b): no stabilising X >= 0", None if X is None else _indefinite(X))
    Y, Lt = _control_side(normal.A.T, C.T, normal.B1.T, Ds1.T, gamma, len(normal.C1))
    if Y is None or not is_positive_semidefinite(Y):
        return _Fails("condition (b): no stabilising Y >= 0", None if Y is None else _indefinite(Y))
    product = np.asarray(X.X @ Y.X, dtype=float)
    radius = float(np.abs(np.linalg.eigvals(product)).max(initial=0.0))
    return _Feasible(X, Y, F, Lt.T, radius)


def _control_side(
    A: Array, B: Array, C1: Array, D: Array, gamma: float, disturbances: int
) -> tuple[RiccatiSolution | None, Array]:
    """X of (18) and F of (20); with A', C', B1' and Ds1' for their arguments: Y of (19) and L' of (21)."""
    a, b, c, d = (np.asarray(part, dtype=np.longdouble) for part in (A, B, C1, D))
    R = d.T @ d
    R[:disturbances, :disturbances] -= np.longdouble(gamma) ** 2 * np.eye(disturbances)
    try:
        inverse = _inverse(R)
    except np.linalg.LinAlgError:
        return None, np.zeros((0, 0))
    cross, inputs = inverse @ (d.T @ c), inverse @ b.T
    W: LongArray = b @ inputs
    Q: LongArray = c.T @ c - c.T @ d @ cross
    terms = np.abs(C1.T) @ np.abs(C1) + np.abs(C1.T @ D) @ np.abs(np.asarray(cross, dtype=float))
    solution = stabilising_solution(a - b @ cross, (W + W.T) / _TWO, (Q + Q.T) / _TWO, terms)
    if solution is None:
        return None, np.zeros((0, 0))
    return solution, np.asarray(-(cross + inputs @ solution.X), dtype=float)


def _inverse(R: LongArray) -> LongArray:
    """R^-1 in extended precision: the one in double precision and two steps of Newton and Schulz."""
    inverse = np.asarray(np.linalg.inv(np.asarray(R, dtype=float)), dtype=np.longdouble)
    for _ in range(2):
        inverse = inverse @ (2.0 * np.eye(len(R)) - R @ inverse)
    return inverse


def _controllers(normal: NormalPlant, gamma: float, found: _Feasible, controls: int) -> Synthesis:
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
