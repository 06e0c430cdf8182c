"""Certificates of loops with constant delay: against Theorem 3.3 as printed, the exact norm, and forgery."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from servobench.design.delay.certificate import (
    CLOSE_ENOUGH,
    certified_delay_s,
    certified_gain,
    certified_gain_auto,
    certified_stable,
    gain_problem,
    proved,
    scaled,
)
from servobench.design.delay.delay_loop import speed_model
from servobench.design.delay.delay_norm import hinf_norm, largest_stable_delay_s, rough_norm
from servobench.design.delay.lmi import solve
from servobench.design.errors import NoSolution
from servobench.design.papers.as_printed import theorem_3_1, theorem_3_3
from tests.motors import AZAIZ, LING
from tests.unit.design.delay_oracles import generator_abscissa, magnitudes
from tests.unit.design.random_loops import order_is_found

MODEL = speed_model(LING)
PUBLISHED = MODEL.loop([0.0, -0.0212], 0.064)


def test_order_0_is_theorem_3_3_as_printed() -> None:
    """With Y and W free, and through a modelling language."""
    printed = theorem_3_3(PUBLISHED, MODEL.state_scale, 150.0)
    assert certified_gain(MODEL, PUBLISHED, 0).gain == pytest.approx(printed, rel=2e-5)


@pytest.mark.parametrize("delay_s", [0.10, 0.149, 0.150, 0.165])
def test_order_0_is_theorem_3_1_as_printed(delay_s: float) -> None:
    loop = replace(PUBLISHED, delay_s=delay_s)
    assert certified_stable(MODEL, loop, 0) == theorem_3_1(loop, MODEL.state_scale)


def test_published_design_certified() -> None:
    """Theorem 3.3 does not give 125 for the published K at 64 ms; even the exact gain is above it."""
    found = [certified_gain(MODEL, PUBLISHED, order) for order in range(4)]
    assert found[0].gain == pytest.approx(135.668, rel=2e-5)
    assert found[1].gain == pytest.approx(125.367, rel=2e-5)
    gains = [each.gain for each in found]
    assert all(later <= earlier * (1.0 + 1e-6) for earlier, later in itertools.pairwise(gains))
    assert all(gain >= hinf_norm(PUBLISHED) * (1.0 - 1e-9) for gain in gains)
    assert all(each.min_margin > 0.0 for each in found)


@pytest.mark.long
def test_an_asked_order_is_found() -> None:
    """In random stable loops up to 0.8 of their largest delay, of orders 0 to 4; 200 by ``bench_design``."""
    draw = np.random.default_rng(5)
    assert sum(order_is_found(draw) for _ in range(60)) >= 57


def test_order_is_chosen_automatically() -> None:
    found = certified_gain_auto(MODEL, PUBLISHED)
    assert found.order == 1
    assert found.gain <= CLOSE_ENOUGH * hinf_norm(PUBLISHED)
    near_limit = MODEL.loop([0.0, -0.0212], 0.15)
    assert certified_gain_auto(MODEL, near_limit).order > 1


def test_delay_up_to_which_stability_is_certified() -> None:
    limits = [certified_delay_s(MODEL, PUBLISHED, order) for order in range(3)]
    assert limits == pytest.approx([0.149206, 0.169796, 0.170361], abs=3e-6)
    assert limits[-1] <= largest_stable_delay_s(PUBLISHED)
    assert certified_stable(MODEL, replace(PUBLISHED, delay_s=0.149), 0)
    assert not certified_stable(MODEL, replace(PUBLISHED, delay_s=0.150), 0)


@pytest.mark.parametrize("motor", [LING, AZAIZ])
def test_without_delay_it_is_the_ordinary_norm(motor: object) -> None:
    model = speed_model(motor)  # type: ignore[arg-type]
    loop = model.loop([-0.3, -0.05], 0.0)
    assert certified_gain(model, loop, 0).gain == pytest.approx(hinf_norm(loop), rel=1e-6)


def test_an_unstable_loop_has_no_certificate() -> None:
    with pytest.raises(NoSolution, match="unstable"):
        certified_gain(MODEL, MODEL.loop([0.0, -0.0212], 0.2), 0)


@pytest.mark.long
def test_order_0_of_random_loops_beside_a_spectrum_and_a_sweep() -> None:
    """Unstable: never certified. Stable: never below the sweep, and the units of its size."""
    draw = np.random.default_rng(13)
    stable = certified = 0
    for _ in range(60):
        bandwidth_hz = float(np.exp(draw.uniform(math.log(30.0), math.log(1500.0))))
        model = speed_model(LING, current_bandwidth_hz=bandwidth_hz)
        delay_s = float(np.exp(draw.uniform(math.log(1e-3), math.log(0.1))))
        crossing_rad_s = float(draw.uniform(-0.3, 3.0)) / (delay_s - 1.0 / float(model.A[0, 0]))
        K = [draw.uniform(-0.6, 0.3), -crossing_rad_s / float(model.A[1, 0])]
        loop = model.loop(K, delay_s)
        abscissa = generator_abscissa(loop)
        if abscissa >= 0.0:
            with pytest.raises(NoSolution, match="unstable"):
                certified_gain(model, loop, 0)
            continue
        stable += 1
        sweep = float(np.max(magnitudes(loop, np.append(0.0, np.geomspace(1e-2, 60.0, 20_000) / delay_s))))
        if abscissa * delay_s < -0.1:
            # nearer to the axis a peak is narrow, and the units are found by asking again
            assert 0.5 * sweep <= rough_norm(loop) <= 2.0 * sweep
        try:
            gain = certified_gain(model, loop, 0).gain
        except NoSolution:
            continue
        certified += 1
        assert gain >= sweep * (1.0 - 1e-9)
    assert 20 <= stable <= 45
    assert certified >= 0.8 * stable


@pytest.mark.parametrize(
    ("friction_nm_s", "K1"), [(0.0, -0.3), (0.0, 3.0), (LING.viscous_friction_nm_s, 1.0)]
)
@pytest.mark.parametrize("delay_s", [0.0, 0.001])
def test_a_loop_with_a_root_at_zero_has_no_certificate(
    friction_nm_s: float, K1: float, delay_s: float
) -> None:
    """Its gain at no frequency is infinite or, where the root cancels, no number."""
    model = speed_model(replace(LING, viscous_friction_nm_s=friction_nm_s), current_bandwidth_hz=800.0)
    with pytest.raises(NoSolution, match="unstable"):
        certified_gain(model, model.loop([K1, 0.0], delay_s), 0)


@pytest.mark.parametrize("entry", [0, 3, 8, -1])
def test_a_forged_certificate_is_refused(entry: int) -> None:
    """The check in numpy believes nobody."""
    problem = gain_problem(scaled(PUBLISHED, MODEL.state_scale, 140.0), 0)
    y = solve(problem).y
    proved(problem, y)
    y[entry] -= 0.05 * max(abs(y[entry]), 1.0)
    with pytest.raises(NoSolution, match="fails its check"):
        proved(problem, y)
