"""Margins, step figures, reduction, sampling, the coupled axes, fixed structures and robustness."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from servobench.design.current.current_design import design_axis, reduced_design, rule_weights, step_figures
from servobench.design.current.current_loop import (
    Decoupling,
    closed_loop_matrix,
    discrete_design,
    gamma_min_over_rates,
    held,
    lowest_coupled_rate_hz,
    lowest_rate_hz,
    nominal_decoupling,
    rotation,
    sampled_figures,
    spectral_radius,
)
from servobench.design.errors import InfeasibleDesign
from servobench.design.hinf.fixed_structure import Structure, tune
from servobench.design.hinf.margins import margins
from servobench.design.hinf.mixed_sensitivity import axis_plant, crossing_weight, error_weight, slope_weight
from servobench.design.hinf.reduction import Method, hankel_singular_values, reduce
from servobench.design.hinf.system_norm import hinf_norm
from servobench.design.papers.azaiz2007 import MOTOR, paper_design, printed_figures
from servobench.design.statespace import (
    StateSpace,
    connect,
    from_bilinear,
    from_zpk,
    series,
    state_space,
    to_bilinear,
    tustin,
    zeros,
    zpk,
)
from tests.draws import few_of

Q, Q_REDUCED = paper_design("q")
D, D_REDUCED = paper_design("d")
RATE_HZ = 16_000.0


@pytest.mark.parametrize(
    ("design", "gain", "phase", "modulus", "rise", "settling"),
    [(Q, (31.2, 2600), (83.7, 145), 0.92, 0.013, 0.025), (D, (32.3, 1290), (84.7, 61), 0.93, 0.032, 0.059)],
)
def test_published_figures(design, gain, phase, modulus, rise, settling) -> None:  # type: ignore[no-untyped-def]
    """Sections 3.3 and 3.4 to their printed digits; K_d's printed modulus margin 0.95 does not follow."""
    found = design.margins
    assert found.gain_margin_db == pytest.approx(gain[0], abs=0.05)
    assert found.gain_margin_rad_s == pytest.approx(gain[1], rel=2e-3)
    assert found.phase_margin_deg == pytest.approx(phase[0], abs=0.05)
    assert found.phase_margin_rad_s == pytest.approx(phase[1], rel=1e-2)
    assert found.modulus_margin == pytest.approx(modulus, abs=0.005)
    assert design.step.rise_time_s == pytest.approx(rise, abs=5e-4)
    assert design.step.settling_time_s == pytest.approx(settling, abs=5e-4)


def test_margins_of_a_loop_in_closed_form() -> None:
    """L = 8/(s + 1)^3: phase -180 degrees at sqrt 3 where |L| = 1."""
    loop = from_zpk([], [-1.0, -1.0, -1.0], 4.0)
    found = margins(loop)
    assert found.gain_margin_db == pytest.approx(20.0 * math.log10(2.0), abs=1e-9)
    assert found.gain_margin_rad_s == pytest.approx(math.sqrt(3.0), rel=1e-9)
    crossover = math.sqrt(4.0 ** (2.0 / 3.0) - 1.0)
    assert found.phase_margin_deg == pytest.approx(180.0 - 3.0 * math.degrees(math.atan(crossover)), abs=1e-9)
    sensitivity = connect(loop, [[-1.0]], [[1.0]], [[-1.0]])
    whole = StateSpace(sensitivity.A, sensitivity.B, sensitivity.C, sensitivity.D + 1.0)
    assert found.modulus_margin == pytest.approx(1.0 / hinf_norm(whole).gain, rel=1e-8)


def test_step_figures_of_a_lag_and_of_an_oscillator() -> None:
    lag = step_figures(state_space([[-5.0]], [[1.0]], [[5.0]], [[0.0]]))
    assert lag.rise_time_s == pytest.approx(math.log(9.0) / 5.0, rel=1e-9)
    assert lag.settling_time_s == pytest.approx(math.log(50.0) / 5.0, rel=1e-9)
    assert lag.overshoot_percent == 0.0
    damping = 0.3
    oscillator = step_figures(from_zpk([], np.roots([1.0, 2.0 * damping, 1.0]), 1.0))
    peak = 100.0 * math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    assert oscillator.overshoot_percent == pytest.approx(peak, rel=1e-4)


@pytest.mark.parametrize("seed", few_of(range(20), 5))
def test_zero_pole_form_and_back(seed: int) -> None:
    draw = np.random.default_rng(seed)
    poles = [-(10.0 ** draw.uniform(-2, 6)) for _ in range(3)] + [complex(-20, 30), complex(-20, -30)]
    zero_count = int(draw.integers(0, 5))
    wanted = [-(10.0 ** draw.uniform(-2, 6)) for _ in range(zero_count)]
    form = zpk(from_zpk(wanted, poles, 7.0))
    assert form.gain == pytest.approx(7.0, rel=1e-4)
    assert np.sort(np.abs(form.zeros)) == pytest.approx(np.sort(np.abs(wanted)), rel=1e-4)
    assert np.sort(np.abs(form.poles)) == pytest.approx(np.sort(np.abs(poles)), rel=1e-4)


def test_zeros_of_a_pure_integrator_with_gain() -> None:
    assert zeros(from_zpk([-3.0], [0.0], 2.0)) == pytest.approx([-3.0])


def test_norm_at_rest_at_a_peak_and_of_an_unstable_system() -> None:
    assert hinf_norm(state_space([[-2.0]], [[1.0]], [[6.0]], [[0.0]])).gain == pytest.approx(3.0, rel=1e-12)
    damping = 0.01
    resonant = from_zpk([], np.roots([1.0, 2.0 * damping * 1e4, 1e8]), 1e8)
    peak = 1.0 / (2.0 * damping * math.sqrt(1.0 - damping**2))
    assert hinf_norm(resonant).gain == pytest.approx(peak, rel=1e-9)
    assert hinf_norm(state_space([[1.0]], [[1.0]], [[1.0]], [[0.0]])).gain == math.inf


def test_weights_meet_their_rules_and_give_the_printed_numbers() -> None:
    w1 = error_weight(156.75, 1.51, 1e-4)
    assert (w1.zero_rad_s, w1.pole_rad_s) == pytest.approx((177.3493, 0.011745), rel=1e-5)
    assert w1.gain(156.75) == pytest.approx(1.0, rel=1e-12)
    assert w1.low == pytest.approx(1e4)
    w3 = slope_weight(0.5, 1e4, 235.0 / math.sqrt(3.0))
    assert (w3.zero_rad_s, w3.pole_rad_s) == pytest.approx((135.68, 271.35e4), rel=3e-5)
    assert crossing_weight(0.5, 1e4, 235.0).zero_rad_s == pytest.approx(w3.zero_rad_s, rel=1e-6)
    with pytest.raises(ValueError, match="one gain below 1"):
        crossing_weight(2.0, 3.0, 100.0)


def test_hankel_singular_values_against_the_gramians() -> None:
    draw = np.random.default_rng(3)
    A = draw.normal(size=(5, 5)) - 4.0 * np.eye(5)
    system = StateSpace(A, draw.normal(size=(5, 2)), draw.normal(size=(3, 5)), np.zeros((3, 2)))
    P = scipy.linalg.solve_continuous_lyapunov(A, -system.B @ system.B.T)
    W = scipy.linalg.solve_continuous_lyapunov(A.T, -system.C.T @ system.C)
    wanted = np.sort(np.sqrt(np.linalg.eigvals(P @ W).real))[::-1]
    assert hankel_singular_values(system) == pytest.approx(wanted, rel=1e-8)
    for method in (Method.TRUNCATE, Method.RESIDUALISE):
        small = reduce(system, 3, method)
        error = series_difference(system, small)
        assert hinf_norm(error).gain <= 2.0 * wanted[3:].sum() * (1.0 + 1e-9)
    assert reduce(system, 3, Method.RESIDUALISE).steady_gain() == pytest.approx(
        system.steady_gain(), rel=1e-9
    )


def series_difference(left: StateSpace, right: StateSpace) -> StateSpace:
    """left - right."""
    zero = np.zeros((left.order, right.order))
    A = np.block([[left.A, zero], [zero.T, right.A]])
    return StateSpace(A, np.vstack([left.B, right.B]), np.hstack([left.C, -right.C]), left.D - right.D)


@pytest.mark.parametrize("design", [Q, D])
@pytest.mark.parametrize("method", list(Method))
def test_a_state_fewer_costs_nothing(design, method) -> None:  # type: ignore[no-untyped-def]
    small = reduced_design(design, 3, method)
    assert small.closed_loop_norm == pytest.approx(design.closed_loop_norm, rel=2e-3)


def test_tustin_against_scipy_and_its_prewarping() -> None:
    K = Q_REDUCED.controller
    ours = tustin(K, RATE_HZ)
    theirs = scipy.signal.cont2discrete((K.A, K.B, K.C, K.D), 1.0 / RATE_HZ, method="bilinear")
    omega = np.logspace(0, 4, 20)
    reference = state_space(theirs[0], theirs[1], theirs[2], theirs[3], 1.0 / RATE_HZ)
    assert ours.response(omega) == pytest.approx(reference.response(omega), rel=1e-8)
    exact = tustin(K, RATE_HZ, 4000.0)
    assert exact.response(4000.0) == pytest.approx(K.response(4000.0), rel=1e-10)
    with pytest.raises(ValueError, match="sample faster"):
        tustin(K, 40.0, 145.0)


def test_bilinear_there_and_back() -> None:
    sampled = held(axis_plant(0.6, 2.8e-3), RATE_HZ, 2)
    back = from_bilinear(to_bilinear(sampled), 1.0 / RATE_HZ)
    omega = np.logspace(0, 4.6, 20)
    assert back.response(omega) == pytest.approx(sampled.response(omega), rel=1e-9)


def test_discrete_design_keeps_the_margin_that_tustin_loses() -> None:
    G = Q.plant
    rate_hz = 2000.0
    discrete = discrete_design(G, Q.weights, 1.03, 1.0, rate_hz, 1)
    by_tustin = sampled_figures(G, tustin(Q_REDUCED.controller, rate_hz, 145.0), 1)
    found = sampled_figures(G, discrete.controller, 1)
    assert found.spectral_radius < 1.0
    assert found.margins.modulus_margin > by_tustin.margins.modulus_margin


@pytest.mark.parametrize(("rate_hz", "delay"), [(2000.0, 1), (8000.0, 1), (8000.0, 2), (16_000.0, 0)])
def test_norm_of_a_discrete_design_is_that_of_a_sweep_of_its_loop(rate_hz: float, delay: int) -> None:
    """Hold and delay by scipy and by hand; the loop along the unit circle."""
    found = discrete_design(Q.plant, Q.weights, 0.0, 1.02, rate_hz, delay)
    period_s = 1.0 / rate_hz
    A, B, C, D, _ = scipy.signal.cont2discrete((Q.plant.A, Q.plant.B, Q.plant.C, Q.plant.D), period_s)
    angle = np.concatenate([np.logspace(-7, np.log10(math.pi), 20_000)[:-1], [math.pi - 1e-9]])
    z = np.exp(1j * angle)
    g = np.array([(C @ np.linalg.solve(each * np.eye(1) - A, B) + D)[0, 0] for each in z]) * z**-delay
    k = found.controller.response(angle / period_s)[:, 0, 0]
    s = 2.0 / period_s * np.tan(0.5 * angle)
    S = 1.0 / (1.0 + g * k)
    weighted = [
        weight.system.response(s)[:, 0, 0] * part
        for weight, part in [(Q.weights.error, S), (Q.weights.control, k * S), (Q.weights.output, g * k * S)]
    ]
    swept = float(np.sqrt(sum(np.abs(each) ** 2 for each in weighted)).max())
    assert found.norm == pytest.approx(swept, rel=1e-5)
    assert found.gamma_min <= swept < found.gamma
    poles = np.abs(
        connect(series(held(Q.plant, rate_hz, delay), found.controller), [[-1.0]], [[1.0]], [[1.0]]).poles()
    )
    assert poles.max() < 1.0


def test_gamma_min_rises_as_the_rate_falls_and_is_the_continuous_one_at_last() -> None:
    rates = [400_000.0, 32_000.0, 16_000.0, 8000.0, 4000.0, 2000.0, 1000.0]
    found = gamma_min_over_rates(Q.plant, Q.weights, rates, 1)
    assert found == sorted(found)
    assert found[0] == pytest.approx(Q.gamma_min, rel=1e-3)
    assert found[-1] > 1.05 * Q.gamma_min
    longer = gamma_min_over_rates(Q.plant, Q.weights, rates, 2)
    assert all(late > early for late, early in zip(longer, found, strict=True))


def test_the_lowest_rate_holds_the_margin_and_a_lower_one_does_not() -> None:
    K = Q_REDUCED.controller
    rate_hz = lowest_rate_hz(Q.plant, K, 145.0, 0.85, 1)
    assert sampled_figures(Q.plant, tustin(K, rate_hz, 145.0), 1).margins.modulus_margin >= 0.85
    assert sampled_figures(Q.plant, tustin(K, 0.99 * rate_hz, 145.0), 1).margins.modulus_margin < 0.85
    with pytest.raises(InfeasibleDesign, match="the continuous loop has"):
        lowest_rate_hz(Q.plant, K, 145.0, 0.99, 1)


def _sampled(rate_hz: float = RATE_HZ) -> tuple[StateSpace, StateSpace]:
    return tustin(D_REDUCED.controller, rate_hz, 61.0), tustin(Q_REDUCED.controller, rate_hz, 145.0)


def test_coupled_axes_fall_apart_at_standstill() -> None:
    K_d, K_q = _sampled()
    apart = max(sampled_figures(design.plant, K, 1).spectral_radius for design, K in ((D, K_d), (Q, K_q)))
    coupled = spectral_radius(MOTOR, K_d, K_q, np.zeros(1), nominal_decoupling(MOTOR, 1))
    assert coupled[0] == pytest.approx(apart, rel=1e-9)


@pytest.mark.parametrize("delay_samples", [0, 1, 2])
def test_coupled_transition_against_a_simulation_in_the_stator_s_frame(delay_samples: int) -> None:
    """One period after another of the motor's equations, the voltage held still in the stator's frame."""
    K_d, K_q = _sampled(4000.0)
    speed, T = 150.0, 1.0 / 4000.0
    electrical = MOTOR.pole_pairs * speed
    wrong = Decoupling(2e-3, 3e-3, 0.7)
    M = closed_loop_matrix(MOTOR, K_d, K_q, speed, wrong, delay_samples)
    draw = np.random.default_rng(1)
    x = draw.normal(size=len(M))
    i, waiting = x[:2], list(x[2 : 2 + 2 * delay_samples].reshape(-1, 2))
    n_d = K_d.order
    x_d, x_q = x[2 + 2 * delay_samples :][:n_d], x[2 + 2 * delay_samples :][n_d:]
    e = -i
    v = np.array([(K_d.C @ x_d + K_d.D[:, 0] * e[0])[0], (K_q.C @ x_q + K_q.D[:, 0] * e[1])[0]])
    v += electrical * np.array([-wrong.inductance_q_h * i[1], wrong.inductance_d_h * i[0]])
    waiting.append(v)
    # computed delay_samples periods ago, turned on by 0.7 periods from the angle at that time
    start = rotation((0.7 - delay_samples) * electrical * T) @ waiting.pop(0)
    steps = 4000
    h = T / steps
    R, Ld, Lq = MOTOR.resistance_ohm, MOTOR.inductance_d_h, MOTOR.inductance_q_h

    def slope(i: np.ndarray, t: float) -> np.ndarray:
        u = rotation(-electrical * t) @ start
        return np.array(
            [(u[0] - R * i[0] + electrical * Lq * i[1]) / Ld, (u[1] - R * i[1] - electrical * Ld * i[0]) / Lq]
        )

    for k in range(steps):
        half = i + 0.5 * h * slope(i, k * h)
        i = i + h * slope(half, (k + 0.5) * h)
    after = np.concatenate([i, *waiting, K_d.A @ x_d + K_d.B[:, 0] * e[0], K_q.A @ x_q + K_q.B[:, 0] * e[1]])
    assert M @ x == pytest.approx(after, rel=1e-6, abs=1e-6)


def test_decoupling_and_angle_advance_matter_at_speed() -> None:
    K_d, K_q = _sampled()
    fast = np.array([2.0 * MOTOR.rated_speed_rad_s])
    right = spectral_radius(MOTOR, K_d, K_q, fast, nominal_decoupling(MOTOR, 1))
    stale = spectral_radius(MOTOR, K_d, K_q, fast, Decoupling(1.4e-3, 2.8e-3, 0.0))
    assert right[0] < 1.0 < stale[0]


def test_fixed_structures_against_the_full_order() -> None:
    """A pole more helps, and no structure beats gamma_min."""
    found = {form: tune(Q.plant, Q.weights, form, 145.0)[1] for form in Structure}
    assert Q.gamma_min < found[Structure.THIRD] <= found[Structure.PI_POLE] * (1.0 + 1e-6)
    assert found[Structure.PI_POLE] < found[Structure.PI]
    assert found[Structure.PI_POLE] < 1.01 * Q.gamma_min


@pytest.mark.parametrize("structure", [Structure.PI, Structure.THIRD])
def test_the_best_coefficients_do_not_hang_on_the_motor_s_size(structure: Structure) -> None:
    """A motor twenty times as fast with the weights carried over is the same problem."""
    fast = replace(MOTOR, resistance_ohm=0.05, inductance_q_h=2.8e-3 / 240.0)
    weights = rule_weights(fast, "q")
    G = axis_plant(0.05, 2.8e-3 / 240.0)
    _, own = tune(Q.plant, Q.weights, structure, 145.0)
    assert tune(G, weights, structure, 145.0 * 20.0)[1] == pytest.approx(own, rel=1e-4)


def test_weights_follow_another_motor() -> None:
    """Scaled by r/L and 1/r the problem, and so gamma_min, stays the paper's own."""
    other = replace(MOTOR, resistance_ohm=2.875, inductance_q_h=8.5e-3)
    found = design_axis(other, "q", rule_weights(other, "q"), 1.0)
    assert found.gamma_min == pytest.approx(Q.gamma_min, rel=1e-7)


def test_the_lowest_coupled_rate_is_stable_and_a_lower_one_is_not() -> None:
    pair = D_REDUCED.controller, Q_REDUCED.controller
    speed = MOTOR.rated_speed_rad_s
    rate_hz = lowest_coupled_rate_hz(MOTOR, *pair, (61.0, 145.0), speed, 1)
    assert rate_hz is not None

    def radius(rate_hz: float) -> float:
        d, q = (tustin(K, rate_hz, at) for K, at in zip(pair, (61.0, 145.0), strict=True))
        speeds = np.linspace(0.0, speed, 6)
        return float(spectral_radius(MOTOR, d, q, speeds, nominal_decoupling(MOTOR, 1)).max())

    assert radius(rate_hz) < 1.0 <= radius(0.97 * rate_hz)


def test_the_printed_controllers_have_the_printed_margins_but_one() -> None:
    """(70) on the printed plant: 0.9285, where the paper says 0.95."""
    q, d = printed_figures("q"), printed_figures("d")
    assert q["modulus_margin"] == pytest.approx(0.92, abs=0.005)
    assert d["modulus_margin"] == pytest.approx(0.92853, abs=2e-5)
    assert d["gain_margin_db"] == pytest.approx(32.3, abs=0.05)
    assert d["phase_margin_deg"] == pytest.approx(84.7, abs=0.05)
