"""Exact stability limits and norms of loops with one delay."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.design.delay.delay_loop import (
    DelayLoop,
    Feedback,
    Units,
    gain_for_error,
    peak_floor_rad_s,
    percent_of_speed,
    speed_model,
)
from servobench.design.delay.delay_norm import (
    first_delay_beyond_s,
    hinf_norm,
    hinf_peak,
    is_stable,
    largest_stable_delay_s,
    norm_between,
)
from tests.draws import examples_of, few_of
from tests.motors import AZAIZ, LING
from tests.unit.design.delay_oracles import generator_abscissa, magnitudes, random_loop

ONE = np.ones(1)


def first_order(a: float, k: float, delay_s: float) -> DelayLoop:
    """x' = -a x - k x(t - delay) + d, z = x."""
    return DelayLoop(np.array([[-a]]), ONE, np.array([-k]), ONE, ONE, delay_s)


@given(a=st.floats(0.0, 50.0), over=st.floats(1.02, 30.0), k0=st.floats(0.1, 50.0))
@examples_of(100)
def test_delay_margin_of_first_order(a: float, over: float, k0: float) -> None:
    k = a * over + k0
    w = math.sqrt(k * k - a * a)
    assert largest_stable_delay_s(first_order(a, k, 0.0)) == pytest.approx(math.acos(-a / k) / w, rel=1e-9)


def test_first_order_with_little_feedback_is_stable_at_any_delay() -> None:
    assert largest_stable_delay_s(first_order(3.0, 2.0, 0.0)) == math.inf
    assert largest_stable_delay_s(first_order(-3.0, 2.0, 0.0)) == 0.0


@pytest.mark.parametrize("seed", few_of(range(60), 12))
def test_stability_as_the_spectrum_says(seed: int) -> None:
    loop = random_loop(seed)
    rightmost = generator_abscissa(loop)
    if abs(rightmost) > 1e-6 * np.linalg.norm(loop.A):
        assert is_stable(loop) == (rightmost < 0.0)


@pytest.mark.parametrize("motor", [LING, AZAIZ])
def test_largest_delay_puts_roots_on_the_axis(motor: object) -> None:
    loop = speed_model(motor).loop([-0.2, -0.03], 0.0)  # type: ignore[arg-type]
    limit = largest_stable_delay_s(loop)
    rate = abs(loop.A[0, 0])
    assert abs(generator_abscissa(replace(loop, delay_s=limit))) < 1e-7 * rate
    assert (
        generator_abscissa(replace(loop, delay_s=0.999 * limit))
        < 0.0
        < generator_abscissa(replace(loop, delay_s=1.001 * limit))
    )


@pytest.mark.parametrize("seed", few_of(range(60), 12))
def test_norm_is_the_supremum(seed: int) -> None:
    """No frequency of a dense grid is above it, and the one that is named reaches it."""
    loop = random_loop(seed)
    if not is_stable(loop):
        assert hinf_norm(loop) == math.inf
        return
    peak = hinf_peak(loop)
    scale = np.linalg.norm(loop.A) + np.linalg.norm(loop.BK)
    grid = np.concatenate([[0.0], np.geomspace(1e-4, 1e2, 20_000) * scale])
    assert magnitudes(loop, grid).max() <= peak.gain * (1.0 + 1e-7)
    assert magnitudes(loop, np.array([peak.frequency_rad_s]))[0] == pytest.approx(peak.gain, rel=1e-7)


@pytest.mark.parametrize("over", [1.02, 1.5, 8.0])
@pytest.mark.parametrize("seed", few_of(range(60), 12))
def test_the_first_delay_beyond_a_gain_is_where_the_norm_passes_it(seed: int, over: float) -> None:
    loop = replace(random_loop(seed), delay_s=0.0)
    gain = over * hinf_norm(loop)
    if math.isinf(gain):
        assert first_delay_beyond_s(loop, 1e9) == 0.0
        return
    first_s = first_delay_beyond_s(loop, gain)
    if math.isinf(first_s):
        delays_s = np.geomspace(1e-3, 1e2, 12) / np.linalg.norm(loop.A)
        assert max(hinf_norm(replace(loop, delay_s=float(delay_s))) for delay_s in delays_s) <= gain
        return
    for share in (0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0 - 1e-6):
        assert hinf_norm(replace(loop, delay_s=share * first_s)) <= gain
    assert hinf_norm(replace(loop, delay_s=(1.0 + 1e-6) * first_s)) > gain


def test_a_gain_that_is_passed_without_delay_has_no_delay() -> None:
    loop = replace(speed_model(LING).loop([0.0, -0.0212], 0.0), delay_s=0.0)
    assert first_delay_beyond_s(loop, 0.99 * hinf_norm(loop)) == 0.0
    assert first_delay_beyond_s(speed_model(LING).loop([0.0, 0.5], 0.0), 1e6) == 0.0


def test_norm_of_a_narrow_resonance_is_not_missed() -> None:
    """Just inside the limit of stability the peak is as high as it is narrow."""
    loop = speed_model(LING).loop([0.0, -0.0212], 0.0)
    limit = largest_stable_delay_s(loop)
    norms = [hinf_norm(replace(loop, delay_s=limit * (1.0 - share))) for share in (1e-3, 1e-5, 1e-7)]
    assert norms[1] / norms[0] == pytest.approx(100.0, rel=0.02)
    assert norms[2] / norms[1] == pytest.approx(100.0, rel=0.02)


def test_published_design_exactly() -> None:
    """[Ling2012] 5: K = [0, -0.0212] at 64 ms; figures found beforehand by another program."""
    model = speed_model(LING)
    loop = model.loop([0.0, -0.0212], 0.064)
    assert hinf_norm(loop) == pytest.approx(125.3141, rel=1e-5)
    assert largest_stable_delay_s(loop) == pytest.approx(0.170369, abs=1e-6)


def test_gain_at_rest_in_closed_form() -> None:
    """With little delay the norm is at rest: 1/(B_0 - K_t K2 + ...) of the static loop."""
    K2 = -0.0212
    loop = speed_model(LING).loop([0.0, K2], 0.0)
    static = 1.0 / (LING.viscous_friction_nm_s - LING.torque_constant_nm_a * K2)
    assert hinf_norm(loop) == pytest.approx(static, rel=1e-9)


@pytest.mark.parametrize("delay_s", [1.0, 1e3, 1e6])
def test_gain_at_rest_in_closed_form_whatever_the_delay(delay_s: float) -> None:
    """With K2 > 0, less than friction, the feedback is in phase at rest and nowhere more so."""
    static = 1.0 / (LING.viscous_friction_nm_s - LING.torque_constant_nm_a * 0.004)
    for bandwidth_hz in (None, 800.0):
        loop = speed_model(LING, current_bandwidth_hz=bandwidth_hz).loop([0.0, 0.004], delay_s)
        assert hinf_norm(loop) == pytest.approx(static, rel=1e-13)


def test_after_a_long_delay_some_low_frequency_is_in_phase() -> None:
    """K2 < 0: below a delay's inverse rate friction alone counts, so that the gain is as with K2 > 0."""
    loop = speed_model(LING, current_bandwidth_hz=800.0).loop([0.0, -0.0046], 1e8)
    assert hinf_norm(loop) == pytest.approx(
        1.0 / (LING.viscous_friction_nm_s - LING.torque_constant_nm_a * 0.0046), rel=1e-11
    )


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_no_current_loop_between_two_has_a_larger_norm_than_the_bound(seed: int) -> None:
    draw = np.random.default_rng(seed)
    slow_hz, width = float(np.exp(draw.uniform(4.0, 7.0))), float(draw.uniform(1.02, 1.25))
    delay_s, crossing = float(draw.uniform(5e-4, 5e-3)), float(draw.uniform(0.2, 0.9))
    integral = bool(seed % 2)

    def loop(bandwidth_hz: float) -> DelayLoop:
        model = speed_model(LING, integral, bandwidth_hz)
        K2 = -crossing / (delay_s + 1.0 / (math.tau * slow_hz)) / float(model.A[1, 0])
        K = [0.0, K2, K2 / model.integral_time_s(delay_s)][: len(model.A)]
        return model.loop(K, delay_s)

    bound = norm_between(loop(slow_hz), loop(slow_hz * width))
    inner = [hinf_norm(loop(slow_hz * float(part))) for part in np.linspace(1.0, width, 9)]
    assert max(inner) <= bound
    assert bound < 1.04 * max(inner)


def test_a_bound_between_two_loops_is_not_that_of_the_two() -> None:
    """Current loops of 7 and of 6000 Hz are stable, those between them are not."""
    slow, between, fast = (
        speed_model(LING, current_bandwidth_hz=hz).loop([-0.55, -1.6], 0.002) for hz in (7.0, 300.0, 6000.0)
    )
    assert math.isfinite(hinf_norm(slow))
    assert math.isfinite(hinf_norm(fast))
    assert not is_stable(between)
    assert norm_between(slow, fast) == math.inf


def test_units_of_a_demand() -> None:
    rpm = math.tau / 60.0
    assert gain_for_error(5.0, 0.6, 1500.0 * rpm, Units.PUBLISHED) == pytest.approx(125.0)
    assert gain_for_error(5.0, 0.6, 1500.0 * rpm) == pytest.approx(125.0 * rpm)
    assert percent_of_speed(125.0 * rpm, 0.6, 1500.0 * rpm) == pytest.approx(5.0)


def test_floor_of_the_peak() -> None:
    delay = 0.064
    straight = delay / LING.inertia_kg_m2
    B, J = LING.viscous_friction_nm_s, LING.inertia_kg_m2
    assert peak_floor_rad_s(LING, delay) == pytest.approx((1.0 - math.exp(-B * delay / J)) / B)
    assert peak_floor_rad_s(LING, delay) < straight


def test_free_gains_and_integral_time() -> None:
    model = speed_model(LING, integral=True)
    assert model.free_gains(Feedback.FULL) == [0, 1]
    K = model.with_entries(np.array([0.0, -0.02, -0.1]), model.free_gains(Feedback.SPEED), [-0.03])
    np.testing.assert_allclose(K, [0.0, -0.03, -0.15], rtol=1e-12)
