"""Worst cases over a box of motors: against random motors, closed forms and an unstable witness."""

import itertools
import math

import numpy as np
import pytest
import scipy.optimize

from servobench.design.current.coupled_robustness import coupled_real_mu, coupled_robustness, worst_motor
from servobench.design.hinf.margins import margins
from servobench.design.hinf.mixed_sensitivity import axis_plant
from servobench.design.hinf.robustness import AxisBox, Worst, axis_robustness, worst_over_box
from servobench.design.hinf.system_norm import largest_gain
from servobench.design.papers.azaiz2007 import MOTOR, paper_design
from servobench.design.statespace import StateSpace, connect, from_zpk, series
from tests.draws import few_of

Q, Q_REDUCED = paper_design("q")
D, D_REDUCED = paper_design("d")
R_OHM, L_H = 0.6, 2.8e-3


def _sensitivity(r: float, L: float, K: StateSpace, omega: np.ndarray) -> np.ndarray:
    loop = series(axis_plant(r, L), K).response(omega)[:, 0, 0]
    return np.asarray(1.0 / np.abs(1.0 + loop))


@pytest.mark.long
@pytest.mark.parametrize("K", few_of([from_zpk([-200.0], [0.0], 0.9), Q.controller, Q_REDUCED.controller], 2))
@pytest.mark.parametrize("spread", few_of([0.5, 0.8, 0.1], 2))
@pytest.mark.parametrize("weighted", [False, True])
def test_no_motor_is_worse_and_one_is_as_bad(K: StateSpace, spread: float, weighted: bool) -> None:
    """400 random motors of the box on a fine grid of frequencies stay below; the worst one is reached."""
    weight = Q.weights.error if weighted else None
    found = worst_over_box(AxisBox(R_OHM, L_H, spread), K, weight)
    draw = np.random.default_rng(5)
    omega = np.logspace(-4, 6, 1500)
    gain = np.array([weight.gain(float(w)) for w in omega]) if weight else np.ones(len(omega))
    seen = 0.0
    for _ in range(400):
        r, L = R_OHM * (1.0 + spread * draw.uniform(-1, 1)), L_H * (1.0 + spread * draw.uniform(-1, 1))
        seen = max(seen, float((gain * _sensitivity(r, L, K, omega)).max()))
    assert seen <= found.bound
    assert found.reached <= found.bound <= 1.001 * found.reached
    assert _gain_of(found, K) * (weight.gain(found.frequency_rad_s) if weight else 1.0) == pytest.approx(
        found.reached, rel=1e-6
    )


def _gain_of(found: Worst, K: StateSpace) -> float:
    at = np.array([found.frequency_rad_s])
    return float(_sensitivity(found.resistance_ohm, found.inductance_h, K, at)[0])


@pytest.mark.long
def test_a_narrow_peak_between_the_first_frequencies_is_found() -> None:
    """A lightly damped pair in K lifts |S| over a thousandth of an octave."""
    pair = np.roots([1.0, 2e-5 * 3333.0, 3333.0**2])
    antiresonance = np.roots([1.0, 2e-2 * 3340.0, 3340.0**2])
    K = from_zpk([*antiresonance, -R_OHM / L_H], [*pair, 0.0], 0.02 * L_H * 3333.0)
    found = worst_over_box(AxisBox(R_OHM, L_H, 1e-6), K)
    modulus = margins(series(axis_plant(R_OHM, L_H), K)).modulus_margin
    omega = np.linspace(3300.0, 3360.0, 600_001)
    assert found.reached == pytest.approx(_sensitivity(R_OHM, L_H, K, omega).max(), rel=1e-4)
    assert found.reached >= 1.0 / modulus * (1.0 - 1e-4)


def test_an_unstable_motor_of_the_box_leaves_no_bound() -> None:
    found = axis_robustness(R_OHM, L_H, Q.controller, Q.weights, spread=0.98)
    assert not found.stable
    assert found.worst_modulus_margin == 0.0
    assert found.sensitivity.bound == math.inf


def _rightmost(K: StateSpace, spread: float) -> float:
    corners = itertools.product((1.0 - spread, 1.0 + spread), repeat=2)
    return max(
        float(
            connect(series(axis_plant(R_OHM * r, L_H * L), K), [[-1.0]], [[1.0]], [[1.0]]).poles().real.max()
        )
        for r, L in corners
    )


def test_real_mu_of_one_axis_touches_the_edge_of_stability() -> None:
    """Grown by 1/mu the box holds a motor with a pole on the axis; at +-50 % every motor is stable."""
    found = axis_robustness(R_OHM, L_H, Q.controller, Q.weights)
    assert found.stable
    edge = 0.5 / found.real_mu_peak
    assert _rightmost(Q.controller, 0.999 * edge) < 0.0 < _rightmost(Q.controller, 1.001 * edge)


def real_mu_upper_bound(M: np.ndarray, starts: int = 3) -> float:
    """Bound of mu of ``M`` (n, n) against diagonal real perturbations, by diagonal D and G scalings.

    mu(M) <= beta if for scalings D > 0 and G:  M* D M + j (G M - M* G) <= beta^2 D  (Fan, Tits, Doyle 1991).
    Every D and G gives a bound; the search only tightens it.
    """
    n = len(M)

    def bound(theta: np.ndarray) -> float:
        D = np.exp(np.clip(theta[:n], -20.0, 20.0))
        scaled = M * D[:, None] / D
        size = np.linalg.norm(scaled, 2)
        low, high = 0.0, float(size)
        G = np.clip(theta[n:], -1e6, 1e6)
        if not np.any(G):
            return high
        root = 1.0 / np.sqrt(1.0 + G**2) ** 0.5
        for _ in range(40):
            beta = 0.5 * (low + high)
            tested = (scaled / max(beta, 1e-300) - 1j * np.diag(G)) * root[:, None] * root
            low, high = (low, beta) if np.linalg.norm(tested, 2) <= 1.0 else (beta, high)
        return high

    best = min(bound(np.zeros(2 * n)), float(np.linalg.norm(M, 2)))
    generator = np.random.default_rng(0)
    for k in range(starts):
        start = np.zeros(2 * n) if k == 0 else generator.normal(scale=1.0, size=2 * n)
        start[n:] += 0.1
        optimum = scipy.optimize.minimize(bound, start, method="Nelder-Mead", options={"maxiter": 400})
        best = min(best, float(optimum.fun))
    return best


@pytest.mark.long
def test_mu_bound_against_exact_cases() -> None:
    assert real_mu_upper_bound(np.diag([0.5 + 0j, -0.8])) == pytest.approx(0.8, rel=1e-3)
    rotation_like = np.array([[0.0, 1.0], [-1.0, 0.0]], dtype=complex)
    # det(I - M diag(x, y)) = 1 + x y: singular first at |x| = |y| = 1
    assert real_mu_upper_bound(rotation_like) == pytest.approx(1.0, rel=1e-3)
    assert real_mu_upper_bound(np.array([[1j]])) < 0.3  # a real number never meets an imaginary one


@pytest.mark.long
@pytest.mark.parametrize("speed", few_of([230.0, 0.0, 115.0], 1))
def test_the_coupled_bound_agrees_with_scalings_and_with_a_witness(speed: float) -> None:
    """No tighter than an unstable motor allows, and close to it; no looser than D and G scalings."""
    pair = D_REDUCED.controller, Q_REDUCED.controller
    found = coupled_robustness(MOTOR, *pair, speed)
    assert worst_motor(MOTOR, *pair, speed, 0.97 * 0.5 / found.real_mu_bound).rightmost_pole_per_s < 1e-6
    if speed > 0.0:
        beyond = 1.06 * 0.5 / found.real_mu_bound
        assert worst_motor(MOTOR, *pair, speed, beyond).rightmost_pole_per_s > 0.0
    omega = np.array([found.real_mu_rad_s])
    assert coupled_real_mu(MOTOR, *pair, speed, omega)[0] <= 1.02 * _scaled_mu(pair, speed, omega[0])


def _scaled_mu(pair: tuple[StateSpace, StateSpace], speed: float, omega: float) -> float:
    """The same four parameters as a matrix, by :func:`real_mu_upper_bound`."""
    s, electrical = 1j * omega, MOTOR.pole_pairs * speed
    r, L_d, L_q = MOTOR.resistance_ohm, MOTOR.inductance_d_h, MOTOR.inductance_q_h
    K_d, K_q = (complex(K.at(s)[0, 0, 0]) for K in pair)
    see = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    enter = np.array([[-1.0, 0.0, -s, electrical], [0.0, -1.0, -electrical, -s]])
    loop = np.diag([r + s * L_d + K_d, r + s * L_q + K_q])
    M = see @ np.linalg.solve(loop, enter) * (0.5 * np.array([r, r, L_d, L_q]))
    return real_mu_upper_bound(np.asarray(M, dtype=complex))


def test_at_standstill_the_coupled_axes_are_no_better_than_one() -> None:
    one = max(axis_robustness(R_OHM, L, K, design.weights).real_mu_peak for L, K, design in (
        (2.8e-3, Q_REDUCED.controller, Q), (1.4e-3, D_REDUCED.controller, D)
    ))  # fmt: skip
    coupled = coupled_robustness(MOTOR, D_REDUCED.controller, Q_REDUCED.controller, 0.0)
    assert coupled.real_mu_bound == pytest.approx(one, rel=1e-3)


def test_largest_gain_is_that_of_the_formula() -> None:
    """The two ways to |S| in these tests are one."""
    T = connect(series(axis_plant(R_OHM, L_H), Q.controller), [[-1.0]], [[1.0]], [[1.0]])
    S = StateSpace(T.A, T.B, -T.C, 1.0 - T.D)
    omega = np.logspace(0, 5, 30)
    assert largest_gain(S, omega) == pytest.approx(_sensitivity(R_OHM, L_H, Q.controller, omega), rel=1e-7)


@pytest.mark.parametrize("seed", [24, 38, 83, 142])
def test_margins_at_a_resonance_narrower_than_a_grid(seed: int) -> None:
    """A pair of poles beside one of zeros, damped by thousandths: polynomials on a dense grid."""
    draw = np.random.default_rng(seed)
    at, damping = 100.0 * 10.0 ** draw.uniform(-1, 1), 10.0 ** draw.uniform(-3, -1)
    poles = [0.0, -10.0 * draw.uniform(0.5, 2), *np.roots([1.0, 2.0 * damping * at, at**2])]
    notch = 2.0 * damping * draw.uniform(0.5, 2) * at * 1.05
    zeros = np.roots([1.0, notch, (at * draw.uniform(0.8, 1.2)) ** 2])
    gain = 10.0 ** draw.uniform(1, 4)
    found = margins(from_zpk(zeros, poles, gain))
    omega = np.union1d(np.logspace(-3, 4, 20_000), at * np.linspace(0.7, 1.3, 400_000))
    values = gain * np.polyval(np.poly(zeros), 1j * omega) / np.polyval(np.poly(poles), 1j * omega)
    assert found.modulus_margin == pytest.approx(np.abs(1.0 + values).min(), rel=1e-3)
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(values) - 1.0)))
    phases = np.degrees(np.angle(-values[crossings]))
    assert found.phase_margin_deg == pytest.approx(phases[np.argmin(np.abs(phases))], abs=0.1)
