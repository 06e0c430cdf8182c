"""The predictor on count and speed: filter and loop against simulations that share no code with them."""

import math

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

from servobench.design.errors import InfeasibleDesign
from servobench.design.papers.ling2012 import MOTOR
from servobench.design.speed.fused_design import (
    PHASES,
    FusedDesign,
    FusedRequest,
    FusedWalks,
    design_fused,
    fused_filter,
    fused_losses,
    fused_robustness,
    rounding,
)
from servobench.design.speed.fused_loop import FusedLoop
from servobench.design.speed.predictor_design import PredictorRequest
from servobench.design.speed.predictor_loop import Prediction
from servobench.design.speed.predictor_plant import encoder_noise_rad_s, plant_of

Array = NDArray[np.float64]
PERIOD_S, FILTER_HZ, RATE_HZ, COUNTS = 1e-3, 500.0, 16_000.0, 4096
PLANT = plant_of(MOTOR, math.tau * 800.0, FILTER_HZ)
R = rounding(COUNTS, FILTER_HZ, RATE_HZ)
FILTER = fused_filter(PLANT, PERIOD_S, R, 0.01)
WALKS = FusedWalks(0.6, 0.08)
GAINS = FILTER.gains(WALKS, 5)
LOAD_NM = 0.6


def request(counts: int = COUNTS, noise_nm: float = 0.1) -> FusedRequest:
    noise = rounding(counts, FILTER_HZ, RATE_HZ)
    known = PredictorRequest(
        motor=MOTOR,
        current_bandwidth_hz=800.0,
        speed_filter_hz=FILTER_HZ,
        speed_noise_rad_s=encoder_noise_rad_s(counts, FILTER_HZ, RATE_HZ),
        torque_noise_nm=0.01,
        period_s=PERIOD_S,
        delay_max_s=1e-3,
        load_nm=LOAD_NM,
        command_noise_nm=noise_nm,
        dead_time_s=1e-4,
    )
    return FusedRequest(known, tuple(map(tuple, noise.tolist())))


def prediction(delay_s: float = 1.1e-3) -> Prediction:
    return Prediction(PLANT, PERIOD_S, delay_s, PLANT.feedback(1200.0, 4000.0))


def test_rounding_is_that_of_counts_drawn_at_random() -> None:
    draw = np.random.default_rng(40)
    step = math.tau / COUNTS
    counts = step * draw.uniform(-0.5, 0.5, 400_000)
    share = 1.0 / (1.0 + RATE_HZ / (math.tau * FILTER_HZ))
    speed, speeds = 0.0, []
    for newest, before in zip(counts[1:], counts[:-1], strict=True):
        speed += share * ((newest - before) * RATE_HZ - speed)
        speeds.append(speed)
    found = np.cov(counts[100:], speeds[99:])
    assert found == pytest.approx(R, rel=0.01)
    assert R[1, 1] == pytest.approx(encoder_noise_rad_s(COUNTS, FILTER_HZ, RATE_HZ) ** 2)


def rates() -> Array:
    """Of [T, omega, w, angle, T_L | u]."""
    J, a, f = PLANT.inertia_kg_m2, PLANT.current_rate_rad_s, PLANT.filter_rate_rad_s
    A = np.zeros((6, 6))
    A[0, 0], A[0, 5] = -a, a
    A[1, :5] = [1.0 / J, -PLANT.viscous_friction_nm_s / J, 0.0, 0.0, -1.0 / J]
    A[2, 1:3], A[3, 1] = [f, -f], 1.0
    return A


@pytest.mark.parametrize("losses", [0, 2])
def test_the_error_of_the_filter_is_that_of_a_simulation(losses: int) -> None:
    """Walks in steps of a fiftieth of a period, noise of each sample, losses before each received one."""
    draw, runs, steps = np.random.default_rng(41), 4000, 50
    dt = PERIOD_S / steps
    places = [1, 2, 3, 4]
    A = scipy.linalg.expm(rates() * dt)[np.ix_(places, places)]
    whole = scipy.linalg.expm(rates() * PERIOD_S)[np.ix_(places, places)]
    lever = scipy.linalg.expm(rates() * PERIOD_S)[1:4, 4]
    root = np.linalg.cholesky(R)
    x, estimate = np.zeros((runs, 4)), np.zeros((runs, 4))
    order = [0, 1, 2, 3]  # [omega, w, angle, T_L] in both
    errors = []
    for number in range(90):
        for _ in range(steps):
            x = x @ A.T
            x[:, 3] += WALKS.load_nm_sqrt_s * math.sqrt(dt) * draw.normal(size=runs)
            x[:, 0] += WALKS.speed_rad_s_sqrt_s * math.sqrt(dt) * draw.normal(size=runs)
        x[:, :3] += 0.01 * draw.normal(size=(runs, 1)) * lever
        estimate = estimate @ whole.T
        if number % (losses + 1) == losses:
            read = x[:, [2, 1]] + draw.normal(size=(runs, 2)) @ root.T
            L = GAINS[losses][order]
            estimate = estimate + (read - estimate[:, [2, 1]]) @ L.T
            errors.append(np.cov((x - estimate).T))
    found = np.mean(errors[-5:], axis=0)
    if losses == 0:
        P = FILTER.stationary(WALKS)
        expected = P - GAINS[0] @ np.array([P[2], P[1]])
        assert np.sqrt(np.diag(found)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.02)
    raw_rad_s = math.sqrt(R[1, 1])
    assert math.sqrt(found[0, 0]) < (0.2 if losses == 0 else 0.4) * raw_rad_s


class Simulated:
    """Shaft, filter, prediction and feedback in absolute angles, by exponentials of every piece."""

    def __init__(self, inertia: float, delay_s: float, model_delay_s: float = 1.1e-3) -> None:
        own = rates()
        self.real = own.copy()
        self.real[1] /= inertia
        self.model, self.F = own, PLANT.feedback(1200.0, 4000.0)
        self.delay_s, self.model_delay_s = delay_s, model_delay_s
        self.x, self.estimate = np.zeros(5), np.zeros(5)
        self.sent: list[tuple[float, float]] = [(-1.0, 0.0)]
        """When each command acts at the shaft, from the begin on, and its torque."""
        self.peak = 0.0

    def moved(self, A: Array, x: Array, begin: float, end: float, later_s: float = 0.0) -> Array:
        edges = sorted({end, *(at + later_s for at, _ in self.sent if begin < at + later_s < end)})
        for edge in edges:
            force = [torque for at, torque in self.sent if at + later_s <= begin + 1e-12][-1]
            x = (scipy.linalg.expm(A * (edge - begin)) @ np.append(x, force))[:5]
            begin = edge
        return x

    def run(self, load_nm: float, phase: float, periods: int, lost: int, noise: Array | None = None) -> None:
        later_s = self.delay_s - self.model_delay_s
        self.x[4] = load_nm
        self.x = self.moved(self.real, self.x, -(1.0 - phase) * PERIOD_S, 0.0, later_s)
        self.peak = abs(self.x[1])
        self.torques = []
        for number in range(periods):
            at = number * PERIOD_S
            if number >= lost:
                L = GAINS[lost if number == lost else 0]
                read = self.x[[3, 2]] + (0.0 if noise is None else noise[number])
                correction = L @ (read - self.estimate[[3, 2]])
                self.estimate = self.estimate + np.append(0.0, correction)
            acts = at + self.model_delay_s
            ahead = self.moved(self.model, self.estimate, at, acts)
            torque = -float(self.F @ ahead[[0, 1, 2, 4]])
            self.torques.append(torque)
            self.sent.append((acts, torque))
            del self.sent[:-6]
            for part in range(8):
                begin = at + part * PERIOD_S / 8
                self.x = self.moved(self.real, self.x, begin, begin + PERIOD_S / 8, later_s)
                self.peak = max(self.peak, abs(self.x[1]))
            self.estimate = self.moved(self.model, self.estimate, at, at + PERIOD_S)


@pytest.mark.parametrize(
    ("inertia", "delay_s", "phase", "lost"),
    [(1.0, 1.1e-3, 0.0, 0), (0.7, 1.1e-3, 0.35, 0), (1.3, 1.3e-3, 0.5, 0), (1.0, 1.1e-3, 0.2, 3)],
)
def test_a_peak_is_that_of_a_simulation(inertia: float, delay_s: float, phase: float, lost: int) -> None:
    loop = FusedLoop(prediction(), PLANT.changed(inertia), delay_s)
    (found,) = loop.peaks(GAINS, LOAD_NM, np.array([phase]), 25, lost)
    simulated = Simulated(inertia, delay_s)
    simulated.run(LOAD_NM, phase, 25, lost)
    assert found == pytest.approx(simulated.peak, rel=1e-9)


def test_the_noise_of_the_torque_is_that_of_a_simulation() -> None:
    loop = FusedLoop(prediction())
    noise = np.random.default_rng(42).normal(size=(2500, 2)) @ np.linalg.cholesky(R).T
    simulated = Simulated(1.0, 1.1e-3)
    simulated.run(0.0, 0.0, 2500, 0, noise)
    assert loop.noise(GAINS[0], R)[0] == pytest.approx(np.std(simulated.torques[100:]), rel=0.06)


def test_a_loop_is_stable_up_to_its_delay_margin() -> None:
    design = FusedDesign(request(), prediction().F, GAINS, 1e-3)
    margin_s = fused_robustness(design).delay_margin_s
    assert design.loop(more_s=margin_s).is_stable(GAINS[0])
    assert not design.loop(more_s=margin_s + PERIOD_S / 20).is_stable(GAINS[0])


@pytest.fixture(scope="module")
def made() -> FusedDesign:
    return design_fused(request())


@pytest.mark.long
def test_a_design_keeps_its_limits(made: FusedDesign) -> None:
    assert made.noise()[0] <= 1.001 * 0.1
    for inertia, more_s in made.request.borne:
        assert made.loop(inertia, 1.0, more_s).is_stable(made.gains[0])
    peaks = [made.ratio(inertia) for inertia in (1.0, 0.7, 1.3)]
    assert peaks == pytest.approx([1.58, 1.46, 1.69], abs=0.03)
    assert len(PHASES) == 6


@pytest.mark.long
def test_gain_and_decay_are_certified_close_to_what_is_found(made: FusedDesign) -> None:
    analysis = fused_losses(made, 2)
    assert analysis.certified
    assert analysis.gain_certified is not None
    assert analysis.decay_certified_per_s is not None
    assert analysis.gain_certified < 1.05 * analysis.gain_found
    assert analysis.decay_certified_per_s > 0.95 * analysis.decay_found_per_s


def test_noise_that_no_filter_keeps_is_refused() -> None:
    with pytest.raises(InfeasibleDesign, match="no predictor on count and speed"):
        design_fused(request(noise_nm=1e-4))
