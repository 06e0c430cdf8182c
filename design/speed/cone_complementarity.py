"""[Ling2012] Theorem 4.1 and Algorithm 4.2: feedback by cone complementarity linearisation (CCL).

Multiplied by X = P^-1, the certificate of Theorem 3.3 is linear in the gain as well, F = K X, but only beside
constraints that are not linear, (4.4): S = Z^-1, N = M^-1, P = X^-1. The algorithm relaxes each to a linear
one, (4.5), and pushes towards equality by minimising a linearised trace, (4.6), again and again. Differences
here:

* (4.2) as printed, (4.3) as [Z, P; P, N] > 0, (4.5) as blocks >= 0, and the trace of (4.6) with its
  missing term N_k M; the disturbance enters through the second column of B only.
* Step 4's check is Theorem 3.3 itself with K = F X^-1 fixed and P, Q, Z free.
* The aim is the largest delay for a given gamma, as in the paper's section 5. After a success the
  delay goes on from the largest that Theorem 3.3 certifies for the gain found. An unsuccessful start
  is repeated at half its delay.

Time is counted in delays, the disturbance so that gamma is 1, the speed error in gamma and the current in the
amount that balances 1 N m: the trace depends on the units.
"""

import math
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.certificate import STRICT, certified_gain
from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.delay.lmi import LmiProblem, MatrixInequality, Unknowns, solve
from servobench.design.errors import NoSolution
from servobench.design.speed.lmi_design import certified_delay_within, certified_gain_or_inf
from servobench.design.speed.speed_design import SpeedDesign

ITERATIONS_MAX = 30
"""k_max of Step 4."""
_FIRST_STEP = 0.05
"""Relative increase of the delay after a success; a failure divides it by 4."""
_LAST_STEP = 2e-3
"""Three failures: the last increase that is tried is 3e-3. One of 8e-4 reaches up to 1.3 % more in twice the
time."""
_STARTS = 8
"""First delays tried, each half of the last."""
_SETTLED = 10
"""Iterations after which the pace of the algorithm says how far it will come."""
_DIGITS = 6
"""Decimals, behind the first digit, of the delays from which it goes on."""
_MATRICES = ("X", "P", "Q", "Z", "M", "S", "N")


@dataclass(frozen=True, slots=True, eq=False)
class _Plant:
    """The open loop in the units of the module's head: x' = A x + B u(t-1) + E d, z = C x."""

    A: Array
    B: Array
    E: Array
    C: Array
    scale: Array
    """K = scaled K / scale."""


def largest_ccl_delay(model: SpeedModel, gamma: float) -> SpeedDesign:
    """Return the delay, s, that Algorithm 4.2 reaches for ``gamma``, rad/s per N m, with full feedback.

    Raises NoSolution if even the first feasible set, S = X, is not found.
    """
    delay_s, K, point = _first_gain(model, gamma)
    delay_s = max(delay_s, _certified_delay_s(model, K, gamma, delay_s))
    step = _FIRST_STEP
    while step > _LAST_STEP:
        tried_s = delay_s * (1.0 + step)
        gain, point = _complement(model, tried_s, gamma, point)
        if gain is None:
            step /= 4.0
            continue
        K = gain
        delay_s = max(tried_s, _certified_delay_s(model, K, gamma, tried_s))
    # a hair below it, so that rounding cannot spoil the certificate
    delay_s *= 1.0 - 1e-7
    return SpeedDesign(K, delay_s, certified_gain(model, model.loop(K, delay_s), 0).gain)


def _certified_delay_s(model: SpeedModel, K: Array, gamma: float, near_s: float) -> float:
    """Return the certified delay, s, rounded down: the iterations that start from it end up to 1e-3 apart
    where it differs by 1e-10."""
    delay_s = certified_delay_within(model, K, gamma, near_s)
    unit_s = 10.0 ** (math.floor(math.log10(delay_s)) - _DIGITS) if delay_s > 0.0 else 1.0
    return math.floor(delay_s / unit_s) * unit_s


def _first_gain(model: SpeedModel, gamma: float) -> tuple[float, Array, dict[str, Array]]:
    """Run steps 2 to 4 once: a delay, s, the gain that fulfils (3.10) there, the last point."""
    first_s = _first_delay(model, gamma)
    for start in range(_STARTS):
        delay_s = first_s * 0.5**start
        point = _with_equal(model, delay_s, gamma)
        if point is None:
            continue
        K, point = _complement(model, delay_s, gamma, point)
        if K is not None:
            return delay_s, K, point
    raise NoSolution(
        f"Algorithm 4.2 for {gamma:g} rad/s per N m",
        f"(3.10) does not hold after {ITERATIONS_MAX} iterations",
        f"delays from {first_s * 1e3:g} ms down to {first_s * 0.5 ** (_STARTS - 1) * 1e3:g} ms",
    )


def _complement(
    model: SpeedModel, delay_s: float, gamma: float, point: dict[str, Array]
) -> tuple[Array | None, dict[str, Array]]:
    """Run steps 3 and 4 at one delay: the gain that fulfils (3.10), or None; the last point.

    A delay is given up early if the certified gain, at the pace of the last iteration, cannot come within
    ``gamma`` in the rest.
    """
    plant = _plant(model, delay_s, gamma)
    unknowns, inequalities = _inequalities(plant)
    last = math.inf
    for k in range(ITERATIONS_MAX):
        objective = _linearised_trace(unknowns, point)
        problem = LmiProblem("Step 3 of Algorithm 4.2", unknowns, inequalities, objective, STRICT)
        try:
            y = solve(problem, 1e-8, 1e-6).y
        except NoSolution:
            return None, point
        values = unknowns.values(y)
        point = {name: values[name] for name in _MATRICES}
        K = (values["F"] @ np.linalg.inv(values["X"]))[0] / plant.scale
        gain = certified_gain_or_inf(model, K, delay_s, gamma)
        if gain <= gamma:
            return K, point
        if k >= _SETTLED and gain - gamma > (last - gain) * (ITERATIONS_MAX - 1 - k):
            return None, point
        last = gain
    return None, point


def _first_delay(model: SpeedModel, gamma: float) -> float:
    """Return step 2: the largest delay, s, to a per cent, with a feasible set for S = X."""
    delay_s = 1.0 / abs(float(model.A[0, 0]))
    first_s: float | None = None
    low, high = 0.0, math.inf
    for _ in range(60):
        if _with_equal(model, delay_s, gamma) is not None:
            first_s = low = delay_s
        else:
            high = delay_s
        if high - low < 0.01 * high:
            break
        delay_s = 2.0 * low if math.isinf(high) else (0.5 * high if low == 0.0 else 0.5 * (low + high))
    if first_s is None:
        what = f"Algorithm 4.2 for {gamma:g} rad/s per N m"
        raise NoSolution(what, "no feasible set with S = X at any delay")
    return first_s


def _with_equal(model: SpeedModel, delay_s: float, gamma: float) -> dict[str, Array] | None:
    """Return a feasible set at ``delay_s`` with S = M = X, so that P = Z = N = X^-1; None if there is
    none."""
    plant = _plant(model, delay_s, gamma)
    n = len(plant.A)
    unknowns = Unknowns()
    for name in ("X", "Q"):
        unknowns.symmetric(name, n)
    _free_matrices(unknowns, n)
    # the least trace of X keeps the set away from the edge of what numbers can tell apart
    positive = [MatrixInequality.positive(unknowns, name) for name in ("X", "Q")]
    bounded = _closed_loop(plant, unknowns, S="X", M="X")
    objective = np.zeros(unknowns.count)
    objective[unknowns.slice_of("X")] = np.trace(unknowns.basis("X"), axis1=1, axis2=2)
    try:
        y = solve(LmiProblem("S = X", unknowns, [*positive, bounded], objective, STRICT), 1e-8, 1e-6).y
    except NoSolution:
        return None
    X, Q = unknowns.value("X", y), unknowns.value("Q", y)
    inverse: Array = np.asarray(np.linalg.inv(X), dtype=np.float64)
    return {"X": X, "S": X, "M": X, "P": inverse, "Z": inverse, "N": inverse, "Q": Q}


def _plant(model: SpeedModel, delay_s: float, gamma: float) -> _Plant:
    current_per_nm = model.B2[1] / model.A[1, 0]
    T = np.array([current_per_nm, gamma])
    return _Plant(
        A=delay_s * model.A * T / T[:, None],
        B=delay_s * model.B1 / T,
        E=delay_s * model.B2 / T,
        C=model.C * T / gamma,
        scale=T,
    )


def _free_matrices(unknowns: Unknowns, n: int) -> None:
    unknowns.full("Y", n, n)
    unknowns.full("W", n, n)
    unknowns.full("F", 1, n)


def _inequalities(plant: _Plant) -> tuple[Unknowns, list[MatrixInequality]]:
    """Return (4.2), (4.3) and (4.5)."""
    n = len(plant.A)
    unknowns = Unknowns()
    for name in _MATRICES:
        unknowns.symmetric(name, n)
    _free_matrices(unknowns, n)
    inequalities = [_closed_loop(plant, unknowns, S="S", M="M"), _pair(unknowns, "Z", "P", "N", n)]
    inequalities += [_pair(unknowns, a, None, b, n) for a, b in (("S", "Z"), ("N", "M"), ("P", "X"))]
    inequalities.append(MatrixInequality.positive(unknowns, "Q"))
    return unknowns, inequalities


def _pair(unknowns: Unknowns, first: str, between: str | None, second: str, n: int) -> MatrixInequality:
    """Return [first, between; between, second], the identity between them if ``between`` is None."""
    rows = np.eye(2 * n)
    top, bottom = rows[:, :n], rows[:, n:]
    inequality = MatrixInequality.zero(unknowns, 2 * n)
    inequality.add(unknowns, first, top)
    inequality.add(unknowns, second, bottom)
    if between is None:
        inequality.constant += top @ bottom.T + bottom @ top.T
    else:
        inequality.add(unknowns, between, top, bottom.T)
    return inequality


def _closed_loop(plant: _Plant, unknowns: Unknowns, S: str, M: str) -> MatrixInequality:
    """Return the negative of (4.2), with eta = gamma = 1; ``S`` and ``M`` name the matrices used there."""
    n = len(plant.A)
    m = 4 * n + 2
    rows = np.eye(m)
    one, two, three, five = (rows[:, start : start + n] for start in (0, n, 2 * n, 3 * n + 1))
    d, z = rows[:, 3 * n], rows[:, 4 * n + 1]
    B = plant.B[:, None]
    inequality = MatrixInequality.zero(unknowns, m)
    # - (A X + X A') and - X A', - X C'
    inequality.add(unknowns, "X", -one, plant.A.T @ one.T + plant.A.T @ five.T + np.outer(plant.C, z))
    # - (Y + Y'), and Y with the second and third columns
    inequality.add(unknowns, "Y", -one, one.T - two.T - three.T)
    # W~ stands transposed in row one, plain in rows two and three
    inequality.add(unknowns, "W", two, two.T + three.T - one.T)
    inequality.add(unknowns, "F", -(one + five) @ B, two.T)
    for name, rows_of, sign in (("Q", one, -1.0), ("Q", two, 1.0), (M, three, 1.0), (S, five, 1.0)):
        inequality.add_form(unknowns, name, rows_of, sign)
    drive = one @ plant.E + five @ plant.E
    inequality.constant += np.outer(d, d) + np.outer(z, z) - np.outer(drive, d) - np.outer(d, drive)
    return inequality


def _linearised_trace(unknowns: Unknowns, point: dict[str, Array]) -> Array:
    """Return tr(S_k Z + S Z_k + N_k M + N M_k + P_k X + P X_k) as a row over the unknowns."""
    objective = np.zeros(unknowns.count)
    for a, b in (("S", "Z"), ("N", "M"), ("P", "X")):
        for name, weight in ((a, point[b]), (b, point[a])):
            objective[unknowns.slice_of(name)] += np.einsum("kij,ji->k", unknowns.basis(name), weight)
    return objective
