"""A position loop over a speed mode: against closed forms, a plain simulation and the certificates."""

import math

import numpy as np
import pytest

from design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from design.sampled.loss_patterns import slowest_pattern
from design.sampled.sequence_certificate import certify_decay
from design.speed.position_loop import (
    SENSITIVITY_PEAK,
    closed_loop,
    design_position,
    feedback,
    position_model,
)

MS = 1e-3
CASES = [(1 * MS, 0.0, 190.0), (1 * MS, 1.4 * MS, 190.0), (1 * MS, 3 * MS, 600.0), (4 * MS, 10.5 * MS, 60.0)]


def simulated(gain: float, period: float, delay: float, bandwidth: float, periods: int) -> np.ndarray:
    """Positions at the samples after a start at 1 rad, by 2000 exact steps of first order a period."""
    parts = 2000
    behind = round(delay / period * parts)
    step = period / parts
    fade = math.exp(-bandwidth * step)
    theta, speed, held = 1.0, 0.0, 0.0
    seen, waiting = [], []
    for number in range(periods * parts):
        if number % parts == 0:
            seen.append(theta)
            waiting.append((number + behind, -gain * theta))
        while waiting and waiting[0][0] <= number:
            held = waiting.pop(0)[1]
        theta += held * step + (speed - held) * (1.0 - fade) / bandwidth
        speed = held + (speed - held) * fade
    return np.array(seen)


@pytest.mark.parametrize(("period", "delay", "bandwidth"), CASES)
def test_the_step_of_a_period_is_that_of_a_simulation(period: float, delay: float, bandwidth: float) -> None:
    gain = design_position(period, delay, bandwidth).gain_per_s
    step = closed_loop(gain, period, delay, bandwidth)
    state = np.zeros(len(step))
    state[1] = 1.0
    found = []
    for _ in range(12):
        found.append(state[1])
        state = step @ state
    assert found == pytest.approx(simulated(gain, period, delay, bandwidth, 12), abs=1e-6)


@pytest.mark.parametrize("delay", [2 * MS, 10 * MS])
def test_a_fast_drive_leaves_an_integrator_with_dead_time(delay: float) -> None:
    # Continuous: e^(-s D) K / s is unstable from K D = pi / 2 on; what |S| peaks at is worked out here.
    found = design_position(delay / 40, delay * (1 - 1 / 80), 1e6)
    dead_time = delay
    assert found.gain_per_s * found.gain_margin * dead_time == pytest.approx(math.pi / 2, rel=2e-3)
    omega = np.linspace(1e-3, 10.0, 200_001)
    loop = found.gain_per_s * dead_time * np.exp(-1j * omega) / (1j * omega)
    assert np.abs(1.0 / (1.0 + loop)).max() == pytest.approx(SENSITIVITY_PEAK, rel=3e-3)


@pytest.mark.parametrize(("period", "delay", "bandwidth"), CASES)
def test_the_margins_are_those_stated_and_what_lies_beyond_is_unstable(
    period: float, delay: float, bandwidth: float
) -> None:
    found = design_position(period, delay, bandwidth)

    def radius(gain: float, later: float = 0.0) -> float:
        step = closed_loop(gain, period, delay + later, bandwidth)
        return float(np.abs(np.linalg.eigvals(step)).max())

    assert found.sensitivity_peak == pytest.approx(SENSITIVITY_PEAK, rel=1e-6)
    assert found.complementary_peak < 1.1
    assert found.gain_margin >= SENSITIVITY_PEAK / (SENSITIVITY_PEAK - 1.0)
    gain, delay_margin = found.gain_per_s, found.delay_margin_s
    assert radius(gain * found.gain_margin * 0.999) < 1.0 < radius(gain * found.gain_margin * 1.001)
    assert radius(gain, 0.99 * delay_margin) < 1.0 < radius(gain, 1.01 * delay_margin)


def test_losses_in_a_row_are_certified_and_too_high_a_gain_is_not() -> None:
    period, delay, bandwidth = 1 * MS, 0.4 * MS, 190.0
    gain = design_position(period, delay, bandwidth).gain_per_s
    network = SampledNetwork(Strategy.ARRIVAL, period, 1, delay)

    def loop(times: float) -> HeldLoop:
        return HeldLoop(position_model(bandwidth), feedback(times * gain), network)

    slowest = slowest_pattern(loop(1.0))
    proof = certify_decay(loop(1.0), [slowest], 0.02, (False,))
    assert proof is not None
    assert 0.5 * gain < proof.figure <= slowest.decay_per_s
    assert slowest_pattern(loop(12.0)).decay_per_s < 0.0


@pytest.mark.parametrize("wrong", [(0.0, 0.0, 1.0), (1 * MS, -1 * MS, 1.0), (1 * MS, 0.0, 0.0)])
def test_what_is_no_time_is_refused(wrong: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="above 0"):
        design_position(*wrong)
