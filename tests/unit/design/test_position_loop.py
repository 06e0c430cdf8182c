"""A position loop over a speed mode: against closed forms, a plain simulation and the certificates."""

import math

import numpy as np
import pytest

from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.loss_patterns import slowest_pattern
from servobench.design.sampled.sequence_certificate import certify_decay
from servobench.design.speed.position_loop import (
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
    gain = design_position(period, delay, bandwidth)
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
    period, dead_time = delay / 40, delay
    gain = design_position(period, delay * (1 - 1 / 80), 1e6)
    limit = math.pi / 2 / dead_time
    assert radius(0.998 * limit, period, delay * (1 - 1 / 80), 1e6) < 1.0
    assert radius(1.002 * limit, period, delay * (1 - 1 / 80), 1e6) > 1.0
    assert sensitivities(gain * dead_time).max() == pytest.approx(SENSITIVITY_PEAK, rel=3e-3)


def sensitivities(gain_by_dead_time: float) -> np.ndarray:
    """|S| of an integrator with dead time, over frequency."""
    omega = np.linspace(1e-3, 10.0, 200_001)
    return np.asarray(np.abs(1.0 / (1.0 + gain_by_dead_time * np.exp(-1j * omega) / (1j * omega))))


def radius(gain: float, period: float, delay: float, bandwidth: float) -> float:
    return float(np.abs(np.linalg.eigvals(closed_loop(gain, period, delay, bandwidth))).max())


def loop_response(gain: float, period: float, delay: float, bandwidth: float) -> np.ndarray:
    """L over frequency, out of the closed loop's step: the samples of theta, opened before the gain."""
    opened, closed = (closed_loop(k, period, delay, bandwidth) for k in (0.0, gain))
    z = np.exp(1j * np.pi * np.arange(1, 4001) / 4000)
    # det(zI - closed) / det(zI - opened) = 1 + L
    numerator, denominator = (
        np.array([np.linalg.det(point * np.eye(len(step)) - step) for point in z])
        for step in (closed, opened)
    )
    return np.asarray(numerator / denominator - 1.0)


@pytest.mark.parametrize(("period", "delay", "bandwidth"), CASES)
def test_the_margins_are_those_that_the_peak_of_the_sensitivity_leaves(
    period: float, delay: float, bandwidth: float
) -> None:
    gain = design_position(period, delay, bandwidth)
    loop = loop_response(gain, period, delay, bandwidth)
    assert np.abs(1.0 / (1.0 + loop)).max() == pytest.approx(SENSITIVITY_PEAK, rel=1e-3)
    assert np.abs(loop / (1.0 + loop)).max() < 1.1
    times = SENSITIVITY_PEAK / (SENSITIVITY_PEAK - 1.0)
    assert radius(gain, period, delay, bandwidth) < 1.0
    assert radius(times * gain, period, delay, bandwidth) < 1.0
    assert radius(20.0 * times * gain, period, delay, bandwidth) > 1.0


def test_losses_in_a_row_are_certified_and_too_high_a_gain_is_not() -> None:
    period, delay, bandwidth = 1 * MS, 0.4 * MS, 190.0
    gain = design_position(period, delay, bandwidth)
    network = SampledNetwork(Strategy.ARRIVAL, period, 1, delay)

    def loop(times: float) -> HeldLoop:
        return HeldLoop(position_model(bandwidth), feedback(times * gain), network)

    slowest = slowest_pattern(loop(1.0))
    proof = certify_decay(loop(1.0), [slowest], 0.02, (0,))
    assert proof is not None
    assert 0.5 * gain < proof.figure <= slowest.decay_per_s
    assert slowest_pattern(loop(12.0)).decay_per_s < 0.0


@pytest.mark.parametrize("wrong", [(0.0, 0.0, 1.0), (1 * MS, -1 * MS, 1.0), (1 * MS, 0.0, 0.0)])
def test_what_is_no_time_is_refused(wrong: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="above 0"):
        design_position(*wrong)
