"""The least peak that noise allows: its limits in closed form, and beside what the predictor reaches."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from servobench.design.delay.delay_loop import Array
from servobench.design.speed.predictor_design import PredictorDesign
from servobench.design.speed.predictor_loop import AdaptiveFilter, Walks, load_step
from tests.noise_floor import NoisyStep
from tests.unit.design.test_predictor import NOISE_RAD_S, PLANT, REQUEST

STEP = NoisyStep(PLANT, 1e-3, 1.1e-3, 0.6, NOISE_RAD_S, 0.1)


def test_without_noise_it_is_the_floor_of_the_delay() -> None:
    fast = replace(STEP, plant=PLANT.changed(current=1000.0), speed_noise_rad_s=1e-6)
    assert fast.least_peak_rad_s(0.0) == pytest.approx(REQUEST.floor_rad_s(), rel=1e-3)
    earlier = replace(REQUEST, delay_max_s=0.6e-3).floor_rad_s()
    assert fast.least_peak_rad_s(0.5) == pytest.approx(earlier, rel=1e-3)


def test_noise_raises_it_and_a_torque_that_may_be_noisier_lowers_it() -> None:
    peaks = [
        replace(STEP, speed_noise_rad_s=share * NOISE_RAD_S).least_peak_rad_s(0.5)
        for share in (0.1, 1.0, 4.0, 16.0)
    ]
    assert peaks == sorted(peaks)
    assert peaks[-1] > 1.2 * peaks[0]
    noisier = replace(STEP, speed_noise_rad_s=16.0 * NOISE_RAD_S, command_noise_nm=0.3)
    assert noisier.least_peak_rad_s(0.5) < peaks[-1]


def test_the_largest_mean_is_reached_by_the_likelihood_ratio_and_by_nothing_else() -> None:
    """One reading with a step of d sigmas, 10^6 draws: any function of it keeps the bound."""
    draw = np.random.default_rng(4).normal(size=1_000_000)
    d, allowed = 0.9, 0.1
    bound = allowed * np.sqrt(np.sinh(d * d))

    def mean(command: Callable[[Array], Array]) -> float:
        size = allowed / np.sqrt(np.mean(np.square(command(draw))))
        return float(0.5 * size * np.mean(command(draw + d) - command(draw - d)))

    # the difference of the two signs' densities over that without a step, up to a factor
    assert mean(lambda y: np.sinh(d * y)) == pytest.approx(bound, rel=0.01)
    others: list[Callable[[Array], Array]] = [
        lambda y: y,
        np.sign,
        np.tanh,
        lambda y: y * (np.abs(y) > 1.5),
        lambda y: y**3,
    ]
    assert all(mean(command) < 1.002 * bound for command in others)


def test_the_predictor_s_mean_peak_is_not_below() -> None:
    made = PredictorDesign(REQUEST, PLANT.feedback(0.6 / 2.1e-3, 5000.0), Walks(0.66, 1.4))
    draw = np.random.default_rng(7)
    for phase in (0.0, 0.5):
        peaks, noise = [], []
        for _ in range(60):
            filtering = AdaptiveFilter(REQUEST.kalman, made.walks)
            noisy = draw.normal(size=20) * NOISE_RAD_S
            peaks.append(
                load_step(made.prediction, filtering, 0.6, 20, phase=phase, noise_rad_s=noisy).peak_rad_s
            )
            quiet = AdaptiveFilter(REQUEST.kalman, made.walks)
            drawn = draw.normal(size=60) * NOISE_RAD_S
            noise.append(load_step(made.prediction, quiet, 0.0, 60, noise_rad_s=drawn).commands_nm[20:])
        rms_nm = float(np.sqrt(np.mean(np.square(noise))))
        least = replace(STEP, command_noise_nm=rms_nm).least_peak_rad_s(phase)
        assert least < np.mean(peaks)
