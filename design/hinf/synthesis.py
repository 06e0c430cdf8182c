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

from servobench.design.errors import DesignError, InfeasibleDesign, NoSolution, SingularPlant
from servobench.design.hinf.feasibility import (
    COUPLING,
    DIRECT_GAIN,
    Fails,
    Problem,
    Solved,
    evaluated,
    inverse,
    problem_of,
)
from servobench.design.hinf.mixed_sensitivity import GeneralisedPlant, NormalPlant, normal_form
from servobench.design.hinf.system_norm import hinf_norm, norm_is_below
from servobench.design.statespace import Array, ComplexArray, StateSpace, connect, lower_lft

GAMMA_MIN_RELATIVE = 1e-10
"""Relative distance of the last feasible from the last infeasible gamma of the search."""
_DOUBLINGS_MAX = 60
"""Up to 1e18 times the first gamma, more than rounding leaves of any plant."""
_TRIES = 3
"""Steps of regula falsi in which the interval is to shrink to a quarter, as two halvings would."""
_KEPT_MIN = 0.2
"""Share of the end's distance that is kept: Anderson and Bjorck keep none where the function is flat."""
_BESIDE = 0.4
"""Share of the requested width: the zero is tried at least this far inside the interval."""
_ERROR_MAX = 0.02
"""Relative error of X or Y beyond which only the reason is given, no figure."""

_MOVED_MAX = 0.05
"""Likewise for the effect of rounding the plant's own figures, away from gamma_min, where X or Y is
infinite."""
_CERTAIN = 0.01
"""Rounding errors vary with gamma: at gamma_min they may be this part of the limit elsewhere."""
_ROUNDED = 1.0 + 1e-6
"""Share of a norm that rounding may add."""
_VERIFIED = (1.0, math.inf), (1.001, 1.02), (1.02, 1.02 * _ROUNDED)
"""Multiples of gamma_min: a gamma for which the loop is closed, and the limit of its norm."""
_RAISED_MAX = 0.03
"""On 400 random plants, rounding allows 29 to be verified only above their least gamma, all within 0.3 %. At
10 % two of nine refused ones would have a solution, but one that far off."""
_RAISES = (*(10.0**k for k in range(-9, -2)), 3e-3, 0.01, _RAISED_MAX, *(10.0**k for k in range(1, 7)))
"""Steps above the least gamma by the conditions alone, until its promise can be verified."""
_NOTHING = 1e-6
"""Share of the search's start: a gamma below this is raised to it, as there is no limit to keep."""


@dataclass(frozen=True, slots=True, eq=False)
class Synthesis:
    """All controllers for one gamma: K = F_l(M, Phi) with ||Phi|| < gamma; ``controller`` has Phi = 0."""

    gamma: float
    controller: StateSpace
    generator: StateSpace
    """M of (23): inputs [y; Phi's output], outputs [u; Phi's input]."""
    Y: Array
    state_feedback_modes: ComplexArray
    """Eigenvalues of E_x - W_x X, 1/s."""
    observer_modes: ComplexArray
    """Eigenvalues of E_y - W_y Y, 1/s."""

    def with_parameter(self, parameter: StateSpace) -> StateSpace:
        """Return F_l(M, Phi). Error: ValueError unless Phi is stable with a norm below gamma."""
        norm = hinf_norm(parameter).gain
        if not norm < self.gamma:
            raise ValueError(f"the parameter's norm {norm:.6g} must be below gamma {self.gamma:.6g}")
        return lower_lft(self.generator, parameter)


def synthesise(plant: GeneralisedPlant, gamma: float) -> Synthesis:
    """Return all controllers with ||F_l(P, K)|| < ``gamma``.

    Where rounding hides the solution for a ``gamma`` above gamma_min, they belong to a smaller gamma. Raises
    SingularPlant (A1 to A4), InfeasibleDesign with gamma_min if ``gamma`` is below it, and NoSolution where
    that cannot be verified.
    """
    normal = normal_form(plant)
    problem = problem_of(normal)
    solved = evaluated(problem, gamma)
    if isinstance(solved, Fails) or _inaccuracy(solved, _ERROR_MAX, math.inf):
        least = gamma_min(plant)
        if gamma < least:
            condition = solved.condition if isinstance(solved, Fails) else "by rounding"
            raise InfeasibleDesign(
                f"gamma = {gamma:.9g}",
                f"gamma_min is {least:.9g} ({condition})",
                "take a larger gamma, or relax the weights",
            )
        gamma = max(factor * least for factor, _ in _VERIFIED if factor * least <= gamma)
        solved = evaluated(problem, gamma)
    assert isinstance(solved, Solved)
    central = _controllers(normal, gamma, solved)
    loop = closed_loop(plant, central.controller)
    if norm_is_below(loop, gamma * _ROUNDED):
        return central
    least = gamma_min(plant)
    verified = [factor * least for factor, level in _VERIFIED if level < math.inf and factor * least <= gamma]
    if not verified or norm_is_below(loop, max(gamma, _VERIFIED[-1][0] * least) * _ROUNDED):
        return central
    solved = evaluated(problem, verified[-1])
    assert isinstance(solved, Solved)
    return _controllers(normal, verified[-1], solved)


def gamma_min(plant: GeneralisedPlant, relative: float = GAMMA_MIN_RELATIVE) -> float:
    """Return the least gamma that a controller reaches, to ``relative``, from above: the value is feasible.

    The loops with the controllers at 1.001 and 1.02 of it keep their norm; where rounding lets them only
    further up, by 3 % at most, that is returned. 1e-12 and less: there is no lower limit.

    Raises SingularPlant (A1 to A4), and NoSolution where nothing can be verified.
    """
    normal = normal_form(plant)
    problem = problem_of(normal)
    start = max(2.0 * problem.direct_gain, 1.0)
    least = gamma = _least_feasible(problem, start, relative)
    doubt = _doubt(plant, normal, problem, gamma)
    for step in _RAISES:
        if doubt is None:
            return gamma
        if step > _RAISED_MAX and (1.0 + step) * least > _NOTHING * start:
            break
        gamma = (1.0 + step) * least
        doubt = _doubt(plant, normal, problem, gamma)
    if doubt is not None:
        raise doubt
    return gamma


def _doubt(
    plant: GeneralisedPlant, normal: NormalPlant, problem: Problem, gamma: float
) -> DesignError | None:
    """Explain why feasibility of every gamma above ``gamma`` is not certain; None if it is."""
    for factor, level in _VERIFIED:
        solved = evaluated(problem, factor * gamma)
        if isinstance(solved, Fails):
            return _hidden(solved, factor * gamma)
        inaccurate = _inaccuracy(solved, _ERROR_MAX * _CERTAIN, _MOVED_MAX if factor > 1.0 else math.inf)
        if inaccurate:
            return inaccurate
        if solved.coupling * _CERTAIN < solved.X.error + solved.Y.error:
            return _hidden(Fails(COUPLING), factor * gamma)
        if factor == 1.0:
            continue
        K = _controllers(normal, factor * gamma, solved).controller
        if not norm_is_below(closed_loop(plant, K), level * gamma):
            return NoSolution(
                f"gamma_min near {gamma:.6g}",
                "the loop with the controller does not keep the norm that the synthesis promises",
                f"that for {factor * gamma:.6g} not {level * gamma:.6g}; rounding outweighs the plant: "
                "bring weights, modes and direct gains nearer together",
            )
    return None


def _hidden(fails: Fails, gamma: float) -> NoSolution:
    return NoSolution(
        f"the synthesis at gamma = {gamma:.9g}",
        f"{fails.condition}, by rounding, though a smaller gamma is feasible",
        "take a larger gamma, or bring weights, modes and direct gains nearer together",
    )


def _least_feasible(problem: Problem, start: float, relative: float) -> float:
    """Return the least gamma by the conditions alone, ``start`` being above condition (a)."""
    low, high, fails = problem.direct_gain, start, Fails(DIRECT_GAIN)
    for _ in range(_DOUBLINGS_MAX):
        solved = evaluated(problem, high, thorough=False)
        if not isinstance(solved, Fails):
            break
        low, high, fails = high, 2.0 * high, solved
    else:
        raise InfeasibleDesign("a finite gamma", f"none up to {high:.3g}", "check the scaling of w and z")
    least = 1e-12 * high
    while low == 0.0:
        lower = evaluated(problem, 0.5 * high, thorough=False)
        if isinstance(lower, Fails):
            low, fails = 0.5 * high, lower
        else:
            high, solved = 0.5 * high, lower
            if high <= least:
                return high
    return _last_feasible(problem, (low, fails), (high, solved), relative)


def _last_feasible(
    problem: Problem, infeasible: tuple[float, Fails], feasible: tuple[float, Solved], relative: float
) -> float:
    """Return the feasible gamma next to an infeasible one, between the two given.

    The zero of the distance from the condition that fails at the lower end is tried (regula falsi with the
    steps of Anderson and Bjorck); for condition (a), the limit itself. Where no distance is known, or three
    steps have not quartered the interval, it is halved.
    """
    (low, fails), (high, solved) = infeasible, feasible
    width, tries, weight = high - low, 0, 1.0
    last: bool | None = None
    while high - low > relative * high:
        below, above = fails.distance, fails.before(solved)
        step = _BESIDE * relative * high
        middle = math.sqrt(low * high)
        if fails.condition is DIRECT_GAIN and last:
            middle = low + step
        elif tries < _TRIES and below < 0.0 < above < math.inf:
            left, right = below * (weight if last else 1.0), above * (1.0 if last else weight)
            middle = min(max((low * right - high * left) / (right - left), low + step), high - step)
        if not low < middle < high:
            break
        new = evaluated(problem, middle, thorough=False)
        if isinstance(new, Fails):
            low, fails, ratio = middle, new, new.distance / (below or math.inf)
        else:
            high, solved, ratio = middle, new, fails.before(new) / above if above < math.inf else 0.0
        is_feasible = high == middle
        weight = weight * max(1.0 - ratio, _KEPT_MIN) if is_feasible is last else 1.0
        last, tries = is_feasible, tries + 1
        if high - low < 0.25 * width:
            width, tries = high - low, 0
    return high


def _inaccuracy(solved: Solved, error_max: float, moved_max: float) -> SingularPlant | None:
    """Return the error for an X or Y left without accurate digits by rounding; None if both are accurate."""
    for solution, name, assumption, end in (
        (solved.X, "X", "A2 or A3", "control a larger direct weight, D12"),
        (solved.Y, "Y", "A2 or A4", "measurement a larger direct disturbance, D21"),
    ):
        if solution.error > error_max or solution.moved > moved_max:
            return SingularPlant(
                assumption,
                f"nearly broken: {name} is known to {max(solution.error, solution.moved):.1g} of itself only",
                f"give every {end}, or move modes that lie more than ten decades apart together",
            )
    return None


def closed_loop(plant: GeneralisedPlant, controller: StateSpace) -> StateSpace:
    """Return F_l(P, K), from w to z."""
    return lower_lft(plant.system, controller)


def verified_norm(plant: GeneralisedPlant, controller: StateSpace) -> float:
    """Return ||F_l(P, K)||, computed without the synthesis' own quantities; infinite if the loop is
    unstable."""
    return hinf_norm(closed_loop(plant, controller)).gain


def _controllers(normal: NormalPlant, gamma: float, solved: Solved) -> Synthesis:
    """Return M of theorem 2, (23) to (31), with the normalisation and D22 undone."""
    m2, p2 = normal.B2.shape[1], normal.C2.shape[0]
    m1, p1 = normal.B1.shape[1], len(normal.C1)
    D11_hat, D12_hat, D21_hat = _direct_gains(normal.D11, gamma, m2, p2)
    F12, F2 = solved.F[m1 - p2 : m1], solved.F[m1:]
    L12, L2 = solved.L[:, p1 - m2 : p1], solved.L[:, p1:]
    Z = inverse(np.eye(len(normal.A)) - solved.Y.X @ solved.X.X / gamma**2)
    back, ahead = normal.C2 + F12, Z @ (normal.B2 + L12)
    B1_hat = ahead @ D11_hat - Z @ L2
    C1_hat = F2 - D11_hat @ back
    A_hat = normal.A + normal.B1 @ solved.F[:m1] + normal.B2 @ F2 - B1_hat @ back
    rate = normal.rate_rad_s
    B_hat = np.hstack([B1_hat @ normal.right, ahead @ D12_hat])
    C_hat = np.vstack([normal.left @ C1_hat, -D21_hat @ back])
    D_hat = np.block(
        [
            [normal.left @ D11_hat @ normal.right, normal.left @ D12_hat],
            [D21_hat @ normal.right, np.zeros((p2, m2))],
        ]
    )
    A, B, C = (np.asarray(part, dtype=float) for part in (A_hat * rate, B_hat * rate, C_hat))
    generator = StateSpace(A, B, C, D_hat)
    generator = _over_direct_gain(generator, normal.D22)
    return Synthesis(
        gamma=gamma,
        controller=generator.part(slice(0, m2), slice(0, p2)),
        generator=generator,
        Y=np.asarray(solved.Y.X, dtype=float),
        state_feedback_modes=solved.X.closed_loop * rate,
        observer_modes=solved.Y.closed_loop * rate,
    )


def _direct_gains(D11: Array, gamma: float, m2: int, p2: int) -> tuple[Array, Array, Array]:
    """Return D11hat, D12hat (lower Cholesky factor of T2) and D21hat (upper one of T3), (24) to (26)."""
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
    """Return the controllers of a plant with direct gain D22 from those of the plant without: y - D22 u for
    y."""
    p2, m2 = D22.shape
    p, m = generator.D.shape
    feedback = np.zeros((m, p))
    feedback[:p2, :m2] = -D22
    return connect(generator, feedback, np.eye(m), np.eye(p)) if np.any(D22) else generator
