"""The PID rule: what it promises, and that more cannot be had."""

import math
from dataclasses import replace

import numpy as np
import pytest

from servobench.design.current.current_design import complementary
from servobench.design.errors import InfeasibleDesign
from servobench.design.mechanism import Coupling, Mechanism, Side
from servobench.design.papers.azaiz2007 import MOTOR, paper_design
from servobench.design.speed.speed_pid import SpeedPid, first_order_current_loop, pid_by_rule
from tests.draws import few_of

Q = paper_design("q")[1]
T_I, CROSSOVER = complementary(Q.plant, Q.controller), Q.margins.phase_margin_rad_s


def _at(found: SpeedPid, omega: float) -> tuple[float, float]:
    """Degrees above -180, and the gain, of the loop as the gains are written."""
    s = 1j * omega
    controller = (
        found.proportional_nm_s_rad
        + found.integral_nm_rad / s
        + found.derivative_nm_s2_rad * s / (1.0 + found.derivative_filter_s * s)
    )
    shaft = MOTOR.inertia_kg_m2 * s + MOTOR.viscous_friction_nm_s
    loop = controller * np.exp(-s * found.dead_time_s) * T_I.at(s)[0, 0, 0] / shaft
    return 180.0 + math.degrees(np.angle(loop)), float(abs(loop))


@pytest.mark.parametrize("latency_s", [2e-4, 1e-3, 3e-3])
@pytest.mark.parametrize("margin_deg", [40.0, 50.0, 60.0])
def test_the_margin_asked_for_is_there(latency_s: float, margin_deg: float) -> None:
    found = pid_by_rule(MOTOR, T_I, CROSSOVER, 1e-3, latency_s, margin_deg)
    phase, gain = _at(found, found.crossover_rad_s)
    assert phase == pytest.approx(margin_deg, abs=1e-6)
    assert gain == pytest.approx(1.0, rel=1e-9)
    assert found.margins.phase_margin_deg == pytest.approx(margin_deg, abs=1e-6)
    assert found.margins.modulus_margin > 0.3
    assert found.dead_time_s == pytest.approx(latency_s + 5e-4)


def test_more_delay_costs_crossover() -> None:
    crossovers = [pid_by_rule(MOTOR, T_I, CROSSOVER, 1e-3, x).crossover_rad_s for x in (2e-4, 1e-3, 3e-3)]
    assert crossovers[0] > crossovers[1] > crossovers[2]


def test_the_integral_and_derivative_follow_the_rule() -> None:
    found = pid_by_rule(MOTOR, first_order_current_loop(5000.0), 5000.0, 1e-3, 5e-4, 50.0, 25.0)
    assert found.derivative_nm_s2_rad / found.proportional_nm_s_rad == pytest.approx(1.0 / 5000.0)
    assert found.proportional_nm_s_rad / found.integral_nm_rad == pytest.approx(25.0 / found.crossover_rad_s)


def test_a_margin_that_cannot_be_had_says_what_can() -> None:
    with pytest.raises(InfeasibleDesign, match=r"the best is .*shorten the delay"):
        pid_by_rule(MOTOR, T_I, CROSSOVER, 1e-3, 1e-3, 179.9)


W_I = 5000.0
"""Bandwidth of the current loop behind the coupling, rad/s."""


def _polynomials(pid: SpeedPid, coupling: Coupling, delay_order: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of the whole loop, the delay by Pade; the equations of motion by hand."""
    J_m, J_l, k, d = (
        coupling.motor_kg_m2,
        coupling.load_kg_m2,
        coupling.stiffness_nm_rad,
        coupling.damping_nm_s,
    )
    told = [J_l, d, k] if coupling.encoder is Side.MOTOR else [d, k]
    Kp, Ki, Kd = pid.proportional_nm_s_rad, pid.integral_nm_rad, pid.derivative_nm_s2_rad
    Tf, tau = pid.derivative_filter_s, pid.dead_time_s
    n, f = delay_order, math.factorial
    soon = [f(2 * n - k) * f(n) / (f(2 * n) * f(k) * f(n - k)) * tau**k for k in range(n, -1, -1)]
    late = [(-1) ** k * value for k, value in zip(range(n, -1, -1), soon, strict=True)]
    top = np.polymul([Kp * Tf + Kd, Kp + Ki * Tf, Ki], np.polymul(told, np.polymul([W_I], late)))
    rest = np.polymul([J_m * J_l, (J_m + J_l) * d, (J_m + J_l) * k, 0.0], [Tf, 1.0, 0.0])
    return top, np.polymul(rest, np.polymul([1.0, W_I], soon))


def _kept(pid: SpeedPid, coupling: Coupling) -> float:
    """Modulus margin, where the closed loop is stable; else 0."""
    top, bottom = _polynomials(pid, coupling)
    if np.roots(np.polyadd(top, bottom)).real.max() >= 0.0:
        return 0.0
    peaks = math.tau * np.array([coupling.antiresonance_hz, coupling.resonance_hz])
    omega = np.concatenate(
        [np.geomspace(0.1, 8000.0, 4000), *(p * np.linspace(0.7, 1.4, 2001) for p in peaks)]
    )
    # Below the frequencies at which the approximation of the delay ends.
    omega = omega[omega < 6.0 / pid.dead_time_s]
    return float(np.min(np.abs(1.0 + np.polyval(top, 1j * omega) / np.polyval(bottom, 1j * omega))))


def _slower(pid: SpeedPid, share: float) -> SpeedPid:
    return replace(
        pid,
        proportional_nm_s_rad=share * pid.proportional_nm_s_rad,
        integral_nm_rad=share**2 * pid.integral_nm_rad,
        derivative_nm_s2_rad=share * pid.derivative_nm_s2_rad,
    )


@pytest.mark.parametrize("seed", few_of(range(16), 5))
def test_behind_a_coupling_the_loop_is_stable_with_its_margin_where_the_resonance_may_be(seed: int) -> None:
    draw = np.random.default_rng(seed)
    ratio, antiresonance_hz = math.exp(draw.uniform(-1.0, 1.6)), math.exp(draw.uniform(3.4, 6.0))
    load_kg_m2 = MOTOR.inertia_kg_m2 * ratio / (1.0 + ratio)
    coupling = Coupling(
        MOTOR.inertia_kg_m2 - load_kg_m2,
        load_kg_m2,
        (math.tau * antiresonance_hz) ** 2 * load_kg_m2,
        draw.uniform(0.01, 0.1),
        encoder=(Side.MOTOR, Side.LOAD)[seed % 4 == 0],
    )
    free = replace(MOTOR, viscous_friction_nm_s=0.0)
    T_i = first_order_current_loop(W_I)
    found = pid_by_rule(replace(free, mechanism=Mechanism(coupling)), T_i, W_I, 1e-3, 1e-3)
    places = [replace(coupling, stiffness_nm_rad=x * x * coupling.stiffness_nm_rad) for x in (0.9, 1.0, 1.1)]
    margins = [_kept(found, place) for place in places]
    assert min(margins) >= 0.395
    assert 0.4 <= found.margins.modulus_margin <= 1.02 * margins[1], (
        "which knows no frequency beyond the delay's"
    )
    rigid = pid_by_rule(free, T_i, W_I, 1e-3, 1e-3)
    assert found.resonance_hz == pytest.approx(coupling.resonance_hz)
    if found.crossover_rad_s < rigid.crossover_rad_s:
        assert min(_kept(_slower(found, 1.1), place) for place in places) < 0.4, "no faster one does"
    else:
        assert found.crossover_rad_s == pytest.approx(rigid.crossover_rad_s)
