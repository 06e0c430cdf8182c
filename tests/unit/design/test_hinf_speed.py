"""H-infinity output feedback of the speed: norms by scalar functions, the loop by plain simulation."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from scipy.optimize import OptimizeResult

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import InfeasibleDesign
from servobench.design.papers.ling2012 import MOTOR
from servobench.design.speed.hinf_design import (
    HinfDesign,
    HinfWeights,
    design_controller,
    design_hinf,
    hinf_robustness,
    sampled_uncertainty,
    shaft_of,
)
from servobench.design.speed.hinf_loop import Conditioned, HinfLoop, conditioned, truncated
from servobench.design.speed.predictor_design import PredictorRequest
from servobench.design.speed.predictor_plant import encoder_noise_rad_s, plant_of
from servobench.design.statespace import state_space
from tests.draws import few_of

PERIOD_S = 1e-3
PLANT = plant_of(MOTOR, math.tau * 800.0, 500.0)
NOISE_RAD_S = encoder_noise_rad_s(65_536, 500.0, 16_000.0)
WEIGHTS = HinfWeights(error=0.1, noise_rad_s=0.2, integral_rad_s=80.0)
UNIT = 2.6
REQUEST = PredictorRequest(
    motor=MOTOR,
    current_bandwidth_hz=800.0,
    speed_filter_hz=500.0,
    speed_noise_rad_s=NOISE_RAD_S,
    torque_noise_nm=0.01,
    period_s=PERIOD_S,
    delay_max_s=1.1e-3,
    load_nm=0.6,
    command_noise_nm=0.1,
)


def asked(delay_s: float) -> PredictorRequest:
    return replace(REQUEST, delay_max_s=delay_s)


def shaft_response(delay_s: float, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From a held load, and from a command, to the measured speed: exponentials, and z^-1 for the delay."""
    rates = np.zeros((5, 5))
    a, f, J, B = math.tau * 800.0, math.tau * 500.0, MOTOR.inertia_kg_m2, MOTOR.viscous_friction_nm_s
    rates[0, 0], rates[0, 3] = -a, a
    rates[1, :2], rates[1, 4] = [1.0 / J, -B / J], -1.0 / J
    rates[2, 1:3] = [f, -f]
    whole = math.floor(delay_s / PERIOD_S + 1e-9)
    rest_s = delay_s - whole * PERIOD_S
    full = scipy.linalg.expm(rates * PERIOD_S)
    later = scipy.linalg.expm(rates * (PERIOD_S - rest_s))
    early = scipy.linalg.expm(rates * rest_s)
    before = later[:3, :3] @ early[:3, 3]
    z = np.exp(1j * omega * PERIOD_S)
    load, command = [], []
    for point in z:
        inverse = np.linalg.inv(point * np.eye(3) - full[:3, :3])
        load.append((inverse @ full[:3, 4])[2])
        held = later[:3, 3] * point**-whole + before * point ** -(whole + 1)
        command.append((inverse @ held)[2])
    return np.array(load), np.array(command)


@pytest.mark.long
@pytest.mark.parametrize("delay_s", few_of([19.1e-3, 0.4e-3, 1.1e-3, 3.1e-3], 2))
def test_the_norm_is_that_of_a_sweep_of_scalar_functions(delay_s: float) -> None:
    found = design_controller(asked(delay_s), WEIGHTS)
    omega = np.geomspace(0.01, math.pi / PERIOD_S * 0.9999, 6000)
    load, command = shaft_response(delay_s, omega)
    K = found.K.response(omega)[:, 0, 0]
    W = sampled_uncertainty(asked(delay_s)).response(omega)[:, 0, 0]
    z = np.exp(1j * omega * PERIOD_S)
    integral = 1.0 - np.expm1(-WEIGHTS.integral_rad_s * PERIOD_S) / (z - 1.0)
    S = 1.0 / (1.0 + command * K)
    outputs = np.hypot(np.abs(WEIGHTS.error * integral * S), np.abs(W * K * S))
    gains = outputs * np.hypot(np.abs(load), WEIGHTS.noise_rad_s)
    assert np.max(gains) == pytest.approx(found.gamma, rel=2e-3)
    assert found.gamma_min < found.gamma <= 1.06 * found.gamma_min


@pytest.mark.parametrize(("delay_s", "margin_s"), [(1.1e-3, 0.5e-3), (19.1e-3, 1.91e-3)])
def test_the_weight_covers_inertias_and_delays(delay_s: float, margin_s: float) -> None:
    omega = np.linspace(1.0, math.pi / PERIOD_S * 0.999, 500)
    W = np.abs(sampled_uncertainty(asked(delay_s)).response(omega)[:, 0, 0])
    for lever in (1.0 / 0.7, 1.0, 1.0 / 1.3):
        for late_s in np.linspace(0.0, margin_s, 11):
            assert np.all(np.abs(lever * np.exp(-1j * omega * late_s) - 1.0) - 1e-6 <= W)


def by_hand(c: Conditioned, delay_s: float, load_nm: float, periods: int) -> np.ndarray:
    """Speeds at the samples: the loop in sixteenths of a period, delay and all, with K itself."""
    parts = 20
    step, entered = PLANT.step(PERIOD_S / parts)
    K = c.K
    x, state, late = np.array([0.0, 0.0, 0.0, load_nm]), np.zeros(K.order), round(delay_s / PERIOD_S * parts)
    waiting = [0.0] * late
    speeds = []
    for _ in range(periods):
        error = -x[2]
        u = float(K.C[0] @ state + K.D[0, 0] * error)
        state = K.A @ state + K.B[:, 0] * error
        waiting += [u] * parts
        speeds.append(x[1])
        for _ in range(parts):
            x = step @ x + entered * waiting.pop(0)
    return np.array(speeds)


@pytest.mark.parametrize("delay_s", few_of([1e-3, 3.1e-3, 0.4e-3, 1.1e-3], 2))
def test_the_loop_is_that_of_a_simulation_by_hand(delay_s: float) -> None:
    c = conditioned(design_controller(asked(delay_s), WEIGHTS).K, UNIT)
    loop = HinfLoop(c, PLANT, delay_s)
    ours = loop.load_steps(0.6, 60, (1.0,))[:, 0]
    each = (len(ours) - 1) // 60
    hand = by_hand(c, delay_s, 0.6, 60)
    assert ours[::each][:60] == pytest.approx(hand, abs=1e-9)
    assert np.max(np.abs(hand)) > 0.5
    decay = np.abs(loop.load_steps(0.6, 4000, (0.0,))[-1, 0])
    assert decay < 1e-6  # no steady error
    assert loop.spectral_radius() < 1.0


def test_the_noise_figure_is_that_of_a_long_trial() -> None:
    c = conditioned(design_controller(REQUEST, WEIGHTS).K, UNIT)
    told = HinfLoop(c, PLANT, 1.1e-3).torque_noise_nm(NOISE_RAD_S)
    shaft, K = shaft_of(REQUEST).part(slice(0, 1), slice(1, 2)), c.K
    draw = np.random.default_rng(4)
    x, state, commands = np.zeros(shaft.order), np.zeros(K.order), []
    for noise in draw.normal(0.0, NOISE_RAD_S, 40_000):
        error = -float(shaft.C[0] @ x) - noise
        u = float(K.C[0] @ state + K.D[0, 0] * error)
        state, x = K.A @ state + K.B[:, 0] * error, shaft.A @ x + shaft.B[:, 0] * u
        commands.append(u)
    assert np.std(commands[200:]) == pytest.approx(told, rel=0.05)


def test_the_factors_hold_an_unstable_controller_that_integrates() -> None:
    K = state_space(np.diag([1.0, 1.05, 0.3]), [[1.0], [0.5], [1.0]], [[0.2, -0.3, 0.4]], [[0.6]], PERIOD_S)
    whole = conditioned(K, 1.0)
    assert np.max(np.abs(np.linalg.eigvals(whole.A))) < 1.0
    omega = np.geomspace(1.0, 3000.0, 50)
    assert whole.K.response(omega) == pytest.approx(K.response(omega), rel=1e-9)
    for fewer in truncated(whole, 1.0):
        assert np.min(np.abs(fewer.K.poles() - 1.0)) < 1e-9
    assert truncated(whole, 1.0)[-1].K.response(omega) == pytest.approx(K.response(omega), rel=1e-6)


@pytest.fixture(scope="module")
def made() -> HinfDesign:
    return design_hinf(REQUEST)


@pytest.mark.long
def test_the_design_keeps_what_was_asked(made: HinfDesign) -> None:
    found = hinf_robustness(made)
    assert made.controller.order < made.found.K.order
    assert found.delay_margin_s >= 0.5e-3
    assert found.command_noise_nm <= 0.1
    own, less, more, lost = found.peaks_over_floor.values()
    assert own < 1.22
    assert max(less, more) < 1.3
    assert 1.0 <= lost < 1.05
    gains = (found.gain, found.gains["inertia_70_percent"], found.gains["inertia_130_percent"])
    assert all(map(math.isfinite, gains))
    late = HinfLoop(made.controller, PLANT, 1.1e-3 + found.delay_margin_s + PERIOD_S / 20.0)
    assert late.spectral_radius() >= 1.0


@pytest.mark.long
def test_margins_are_where_the_loop_becomes_unstable(made: HinfDesign) -> None:
    factor = 10.0 ** (made.loop().margins().gain_margin_db / 20.0)
    for by, stable in ((0.99 * factor, True), (1.01 * factor, False)):
        weaker = replace(
            PLANT,
            inertia_kg_m2=PLANT.inertia_kg_m2 / by,
            viscous_friction_nm_s=PLANT.viscous_friction_nm_s / by,
        )
        assert (HinfLoop(made.controller, weaker, 1.1e-3).spectral_radius() < 1.0) is stable


@pytest.mark.long
def test_what_cannot_be_kept_is_refused() -> None:
    with pytest.raises(InfeasibleDesign, match="torque noise"):
        design_hinf(replace(REQUEST, command_noise_nm=1e-7))


def test_a_search_that_ends_where_a_bound_is_broken_by_a_hair_keeps_the_best_that_breaks_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Along a bound the cost is least just beyond it."""

    def minimize(cost: Callable[[Array], float], start: Array, **_: object) -> OptimizeResult:
        beyond = start + np.array([2.0, -3.0, 0.0])
        assert cost(beyond) > 10.0 * cost(start)
        return OptimizeResult(x=beyond)

    monkeypatch.setattr(scipy.optimize, "minimize", minimize)
    assert design_hinf(replace(REQUEST, command_noise_nm=0.2)).breach == 0.0
