"""Time responses of loops with delay, against small steps, closed forms and scipy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import StateSpace as ScipySystem
from scipy.signal import step

from servobench.design.delay.delay_loop import Array, DelayLoop, peak_floor_rad_s
from servobench.design.delay.delay_norm import largest_stable_delay_s
from servobench.design.delay.delay_response import respond, step_peak
from servobench.design.papers.ling2012 import DELAY_S, MODEL, MOTOR, K, load_pulse
from tests.draws import examples_of

STEPS = 800
"""Of the Runge-Kutta oracle to a delay."""


def small_steps(loop: DelayLoop, intervals: int, x0: Array, load: float) -> Array:
    """States at multiples of delay/STEPS, classical Runge-Kutta with the delayed state interpolated."""
    h = loop.delay_s / STEPS
    x = np.zeros((intervals * STEPS + STEPS + 1, len(loop.A)))
    x[STEPS] = x0

    def slope(now: Array, then: Array) -> Array:
        return np.asarray(loop.A @ now + loop.BK @ then + loop.E * load)

    for k in range(STEPS, len(x) - 1):
        first, last = x[k - STEPS], x[k - STEPS + 1]
        if k - STEPS < STEPS:
            first = last = np.zeros(len(loop.A))
        middle = 0.5 * (first + last)
        a = slope(x[k], first)
        b = slope(x[k] + 0.5 * h * a, middle)
        c = slope(x[k] + 0.5 * h * b, middle)
        x[k + 1] = x[k] + h / 6.0 * (a + 2.0 * b + 2.0 * c + slope(x[k] + h * c, last))
    return np.asarray(x[STEPS:])


@pytest.mark.parametrize(("x0", "load"), [((0.0, 0.0), 1.0), ((0.7, 157.0), 0.0)])
def test_a_response_is_that_of_small_steps(x0: tuple[float, float], load: float) -> None:
    loop = MODEL.loop(K, DELAY_S)
    oracle = small_steps(loop, 8, np.array(x0), load)
    found = respond(loop, 8 * DELAY_S, load, np.array(x0))
    times = np.arange(len(oracle)) * DELAY_S / STEPS
    for column in range(2):
        there = np.interp(found.time_s, times, oracle[:, column])
        scale = np.abs(oracle[:, column]).max()
        assert np.abs(found.x[:, column] - there).max() < 2e-4 * scale


def test_nothing_acts_before_the_delay_has_passed() -> None:
    found = respond(MODEL.loop(K, DELAY_S), DELAY_S, 1.0)
    B, J = MOTOR.viscous_friction_nm_s, MOTOR.inertia_kg_m2
    free = -np.expm1(-B * found.time_s / J) / B
    assert np.allclose(found.x[:, 1], free, rtol=1e-10, atol=1e-12)
    assert found.time_s[-1] == pytest.approx(DELAY_S, abs=1e-3)


def test_peak_of_the_printed_loop() -> None:
    loop = MODEL.loop(K, DELAY_S)
    oracle = np.abs(small_steps(loop, 8, np.zeros(2), 1.0)[:, 1]).max()
    assert step_peak(loop) == pytest.approx(oracle, rel=1e-6)
    assert step_peak(loop) == pytest.approx(118.29513, rel=1e-6)


@pytest.mark.long
def test_peak_without_delay_is_scipy_s() -> None:
    loop = MODEL.loop([0.0, -0.3], 0.0)
    system = ScipySystem(loop.A + loop.BK, loop.E[:, None], loop.C[None], [[0.0]])
    _, response = step(system, T=np.linspace(0.0, 0.3, 200_001))
    assert step_peak(loop) == pytest.approx(float(np.abs(response).max()), rel=1e-6)


@given(st.floats(0.002, 0.2), st.floats(0.05, 0.9), st.floats(-0.9, 0.0))
@examples_of(25)
def test_no_loop_is_below_the_floor(delay_s: float, share: float, current: float) -> None:
    gain = np.array([current, -share / delay_s * MOTOR.inertia_kg_m2 / MOTOR.torque_constant_nm_a])
    peak = step_peak(MODEL.loop(gain, delay_s))
    assert peak >= peak_floor_rad_s(MOTOR, delay_s) * (1.0 - 1e-9)


@pytest.mark.long
def test_an_unstable_loop_has_no_peak() -> None:
    limit_s = largest_stable_delay_s(MODEL.loop(K, 0.0))
    assert math.isinf(step_peak(MODEL.loop(K, 1.001 * limit_s)))
    assert math.isfinite(step_peak(MODEL.loop(K, 0.98 * limit_s)))


def test_a_pulse_is_the_difference_of_two_steps() -> None:
    found = load_pulse()
    before = found.time_s < 0.05
    B, J = MOTOR.viscous_friction_nm_s, MOTOR.inertia_kg_m2
    assert np.allclose(found.x[before, 1], -0.6 * np.expm1(-B * found.time_s[before] / J) / B, rtol=1e-9)
    coasting = (found.time_s > 0.0505) & (found.time_s < DELAY_S)
    assert np.all(np.diff(found.x[coasting, 1]) < 0.0)
