"""The predictor's loop against its own trial, and the design against what it promises."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from servobench.design.errors import InfeasibleDesign
from servobench.design.papers.ling2012 import MOTOR
from servobench.design.speed.predictor_design import (
    PredictorDesign,
    PredictorRequest,
    design_predictor,
    losses_gain,
    predictor_robustness,
)
from servobench.design.speed.predictor_loop import (
    STEP_SIGMAS,
    AdaptiveFilter,
    Prediction,
    PredictorLoop,
    Walks,
    delay_margin_s,
    load_step,
)
from servobench.design.speed.predictor_plant import READ, encoder_noise_rad_s, kalman_model, plant_of
from servobench.hil.control import load_filter
from servobench.hil.control.load_filter import FilterNoise, LoadFilter
from servobench.virtual_bus.drive.firmware import FirmwareParameters
from tests.draws import few_of
from tests.random_motors import speed_noise_rad_s

PERIOD_S = 1e-3
PLANT = plant_of(MOTOR, math.tau * 800.0, 500.0)
NOISE_RAD_S = encoder_noise_rad_s(65_536, 500.0, 16_000.0)
KALMAN = kalman_model(PLANT, PERIOD_S, NOISE_RAD_S, 0.01)
WALK = 1.5
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


def prediction(delay_s: float = 1.1e-3) -> Prediction:
    return Prediction(PLANT, PERIOD_S, delay_s, PLANT.feedback(0.6 / (PERIOD_S + delay_s), 5000.0))


def filtering() -> AdaptiveFilter:
    """Whose gains are constant."""
    return AdaptiveFilter(KALMAN, Walks(WALK, WALK))


def test_the_noise_of_an_encoder_is_that_of_the_simulated_drive() -> None:
    assert pytest.approx(speed_noise_rad_s(FirmwareParameters())) == NOISE_RAD_S


@pytest.mark.parametrize("counts", [4096, 65_536, 1 << 20])
@pytest.mark.parametrize("period_s", [1e-3, 4e-3, 20e-3])
def test_covariances_are_those_of_scipy(counts: int, period_s: float) -> None:
    """At 20 ms, where the drive's filter forgets all within a period, the process noise is one as well."""
    model = kalman_model(PLANT, period_s, encoder_noise_rad_s(counts, 500.0, 16_000.0), 0.01)
    assert np.all(np.diag(model.Q_walk) > 0.0)
    walks = np.geomspace(0.02, 600.0, 33)
    for walk, L in zip(walks, model.observers(walks), strict=True):
        P = solve_discrete_are(model.Phi.T, READ[:, None], model.process(walk), [[model.R]])
        assert model.stationary(walk) == pytest.approx(P, rel=1e-9, abs=1e-12 * np.max(P))
        assert L[1:] == pytest.approx(model.gain(P), rel=1e-9)


def test_the_filters_of_design_and_host_are_one() -> None:
    assert STEP_SIGMAS == load_filter.STEP_SIGMAS
    host = LoadFilter(
        PLANT,
        FilterNoise(NOISE_RAD_S, 0.01, 1.0, 8.0),
        PERIOD_S,
    )
    own = AdaptiveFilter(KALMAN, Walks(1.0, 8.0))
    for innovation in (0.01, -0.02, 0.9, 0.3, -0.1, 0.02, -1.5, 0.0):
        host.predict(1)
        host.correct(innovation)
        gains = own.correct(innovation)
        quiet = host.quiet
        found = [quiet.speed_gain, quiet.filtered_gain, quiet.load_gain]
        assert found == pytest.approx(gains[1:], rel=1e-3)
    assert own.steps_seen >= 2


@pytest.mark.parametrize("delay_s", [0.4e-3, 1e-3, 1.1e-3, 3.7e-3])
def test_without_noise_the_plant_without_delay_answers_a_reference(delay_s: float) -> None:
    """Separation: the poles of the loop are those of the feedback, those of the filter, and zeros."""
    found = prediction(delay_s)
    L = KALMAN.observer(WALK)
    loop = PredictorLoop(found)
    poles = np.abs(np.linalg.eigvals(loop.transition(loop.chain(L))))
    step, entered = PLANT.step(PERIOD_S)
    shaft = step[:2, :2] - np.outer(entered[:2], found.F[:2])
    filter_poles = (step - np.outer(L, np.eye(4)[2] @ step))[1:, 1:]
    expected = np.concatenate([np.linalg.eigvals(shaft), np.linalg.eigvals(filter_poles)])
    for pole in np.abs(expected):
        assert np.min(np.abs(poles - pole)) < 1e-6


@pytest.mark.long
@pytest.mark.parametrize(("inertia", "more_s"), few_of([(1.3, 0.3e-3), (1.0, 0.0), (0.7, 0.0)], 1))
def test_the_noise_figure_is_that_of_a_long_trial(inertia: float, more_s: float) -> None:
    found, delay_s = prediction(), 1.1e-3 + more_s
    plant = PLANT.changed(inertia)
    draw = np.random.default_rng(4)
    noise = draw.normal(0.0, NOISE_RAD_S, 20_000)
    trial = load_step(found, filtering(), 0.0, len(noise), plant=plant, delay_s=delay_s, noise_rad_s=noise)
    quiet = load_step(found, AdaptiveFilter(KALMAN, Walks(WALK, WALK)), 0.0, 10)
    assert np.all(quiet.commands_nm == 0.0)
    told = PredictorLoop(found, plant, delay_s).torque_noise_nm(KALMAN.observer(WALK), NOISE_RAD_S)
    assert np.std(trial.commands_nm[200:]) == pytest.approx(told, rel=0.05)


def test_the_load_leaves_no_error_even_on_another_inertia() -> None:
    for inertia in (0.8, 1.0, 1.3):
        trial = load_step(prediction(), filtering(), 0.6, 1500, plant=PLANT.changed(inertia))
        assert abs(trial.speeds_rad_s[-1]) < 1e-6
        assert trial.commands_nm[-1] == pytest.approx(0.6, rel=1e-6)


def test_margins_are_where_the_loop_becomes_unstable() -> None:
    found, L = prediction(), KALMAN.observer(WALK)
    loop = PredictorLoop(found)
    margins = loop.margins(L)
    factor = 10.0 ** (margins.gain_margin_db / 20.0)

    # torque of a plant with less of everything that resists it
    def stronger(by: float) -> PredictorLoop:
        weaker = replace(
            PLANT,
            inertia_kg_m2=PLANT.inertia_kg_m2 / by,
            viscous_friction_nm_s=PLANT.viscous_friction_nm_s / by,
        )
        return PredictorLoop(found, weaker)

    assert stronger(0.99 * factor).is_stable(L)
    assert not stronger(1.01 * factor).is_stable(L)
    late = delay_margin_s(found, L)
    assert PredictorLoop(found, delay_s=1.1e-3 + late).is_stable(L)
    assert not PredictorLoop(found, delay_s=1.1e-3 + late + PERIOD_S / 20.0).is_stable(L)


def test_the_gain_is_that_of_the_worst_sine() -> None:
    """L2 gain by lifting against a long trial of the same loop by fast sampling."""
    found, L = prediction(), KALMAN.observer(WALK)
    loop = PredictorLoop(found)
    gain = loop.gain(loop.chain(L))
    steady = abs(_answer_to_sine(loop, L, 1.0))
    best = max(abs(_answer_to_sine(loop, L, omega)) for omega in np.linspace(50.0, 900.0, 60))
    assert best <= gain * (1.0 + 1e-6)
    assert best == pytest.approx(gain, rel=0.03)
    assert steady < best


def _answer_to_sine(loop: PredictorLoop, L: np.ndarray, omega: float) -> complex:
    """Amplitude of the speed at the samples under a load of 1 N m at that frequency: a lower bound."""
    h = PERIOD_S
    chain = loop.chain(L)
    A = loop.transition(chain)
    # the load of e^{j omega t}, held in 64 pieces
    pieces = 64
    entered = np.zeros(loop.size, dtype=complex)
    added = loop.plant.step(h / pieces)[0][:, 3] * [1.0, 1.0, 1.0, 0.0]
    for piece in range(pieces):
        u = np.exp(1j * omega * h * (piece + 0.5) / pieces)
        rest, _ = loop.plant.step(h * (pieces - piece - 1) / pieces)
        entered[:3] += (rest @ added)[:3] * u
    x = np.linalg.solve(np.exp(1j * omega * h) * np.eye(loop.size) - A, entered)
    return complex(x[1])


@pytest.fixture(scope="module")
def made() -> PredictorDesign:
    return design_predictor(REQUEST)


@pytest.mark.long
def test_the_design_keeps_what_was_asked(made: PredictorDesign) -> None:
    found = predictor_robustness(made)
    assert found.delay_margin_s >= 0.5e-3
    assert found.command_noise_nm <= 0.1
    own, less, more, lost = found.peaks_over_floor.values()
    assert own < 1.2
    assert max(less, more) < 1.25
    assert lost < 1.05
    losses = [losses_gain(made, [lost]) for lost in (1, 2)]
    assert all(map(math.isfinite, (found.gains["inertia_70_percent"], found.gains["inertia_130_percent"])))
    assert found.gain < losses[0] < losses[1] < math.inf


@pytest.mark.long
def test_its_noise_with_false_steps_is_within_what_was_asked(made: PredictorDesign) -> None:
    noise = np.random.default_rng(8).normal(0.0, NOISE_RAD_S, 20_000)
    trial = load_step(made.prediction, AdaptiveFilter(KALMAN, made.walks), 0.0, len(noise), noise_rad_s=noise)
    assert np.std(trial.commands_nm) < 0.105
    assert trial.steps_seen > 100


def test_what_cannot_be_kept_is_refused() -> None:
    with pytest.raises(InfeasibleDesign, match="torque noise"):
        design_predictor(replace(REQUEST, command_noise_nm=1e-6))
