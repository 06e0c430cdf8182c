"""Speed controllers with states of their own: what is told and written of them, and for which losses."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servobench.design.delay.lmi import SOLVER
from servobench.design.sampled.analysis import SampledAnalysis
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.speed.hinf_design import HinfDesign
from servobench.design.speed.predictor_design import PredictorDesign
from servobench.design.speed.predictor_loop import Walks
from servobench.design.speed.predictor_plant import encoder_noise_rad_s
from servobench.design.speed.speed_robustness import LoopRobustness
from servobench.hil.configuration.controller_files import CurrentLoop
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.studies.numbers import short
from servobench.hil.studies.speed import dynamic
from servobench.hil.studies.speed.controller_text import (
    plant_of,
)
from servobench.hil.studies.speed.dynamic import (
    HinfResult,
    PredictorResult,
    certified_of,
    design_speed_predictor,
    loss_certificate,
    loss_figures,
    request_of,
)
from tests.unit.hil.made_analyses import MARGINS, made_analysis, unproved

MOTOR = LING2012.parameters
REQUEST = request_of(MOTOR, 150.0, 0.001, 0.0010004, 0.6, 0.1, dead_time_us=120.0)
ROBUST = LoopRobustness(
    {
        "peak_over_floor": 1.123456789,
        "peak_over_floor_inertia_70_percent": 1.2,
        "peak_over_floor_inertia_130_percent": 1.3,
        "peak_over_floor_5_lost": 1.4,
    },
    88.123456789,
    {"inertia_70_percent": math.inf, "inertia_130_percent": 90.0},
    (0.5, 1.7),
    MARGINS,
    0.00123456789,
    0.0456789012,
)
PLANT = plant_of(MOTOR)


def test_the_noise_of_a_request_is_worked_out() -> None:
    given = (REQUEST.current_bandwidth_hz, REQUEST.period_s, REQUEST.delay_max_s, REQUEST.load_nm)
    assert given == (150.0, 0.001, 0.0010004, 0.6)
    assert (REQUEST.command_noise_nm, REQUEST.dead_time_s) == pytest.approx((0.1, 120e-6))
    assert REQUEST.torque_noise_nm == short(0.005 * MOTOR.rated_torque_nm)
    assert REQUEST.speed_filter_hz == 500.0
    coarse = request_of(MOTOR, 150.0, 0.001, 0.001, 0.6, 0.1, encoder_counts=4096, speed_filter_hz=50.0)
    assert coarse.speed_noise_rad_s == short(encoder_noise_rad_s(4096, 50.0, 16_000.0))
    assert REQUEST.speed_noise_rad_s == short(encoder_noise_rad_s(65_536, 500.0, 16_000.0))
    assert (coarse.speed_filter_hz, coarse.dead_time_s) == pytest.approx((50.0, 1e-4))


def lossy(losses: int, **changes: Any) -> SampledAnalysis:
    return made_analysis(SampledNetwork(Strategy.ARRIVAL, 0.001, losses, 0.001), **changes)


def refuted(losses: int) -> SampledAnalysis:
    return unproved(f"{losses} are too many", SampledNetwork(Strategy.ARRIVAL, 0.001, losses, 0.001))


def test_losses_are_told_down_to_the_most_that_are_certified() -> None:
    attempts = [refuted(3), refuted(2), lossy(1)]
    assert certified_of(attempts) is attempts[2]
    assert loss_figures(attempts, 0.6) == {
        "covers": "samples lost, at the delay and with the plant of the design, every command arriving",
        "not_certified": {"3_in_a_row": "3 are too many", "2_in_a_row": "2 are too many"},
        "losses_in_a_row": 1,
        "gain_certified": 125.0,
        "gain_found": 100.0,
        "decay_certified_per_s": 3.0,
        "decay_found_per_s": 4.0,
        "peak_certified_rad_s": 30.0,
        "peak_found_rad_s": 24.0,
    }
    written = loss_certificate(attempts)
    assert written is not None
    assert (written.losses_in_a_row_max, written.solver, written.gain) == (1, SOLVER, 125.0)


@pytest.mark.parametrize("attempts", [[], [refuted(0)], [lossy(1), refuted(0)]])
def test_without_a_certificate_no_losses_are(attempts: list[SampledAnalysis]) -> None:
    assert certified_of(attempts) is None
    assert loss_certificate(attempts) is None
    told = loss_figures(attempts, 0.6)
    assert told["losses_in_a_row"] is None
    assert "gain_certified" not in told
    assert ("not_certified" in told) == bool(attempts)


def predicted(**more: Any) -> PredictorResult:
    made = PredictorDesign(REQUEST, np.array([0.25, 0.05]), Walks(0.4, 4.0))
    return PredictorResult(made, ROBUST, 2, **more)


@pytest.fixture
def gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a predictor with so many lost."""
    monkeypatch.setattr(dynamic, "losses_gain", lambda _design, lost: 90.0 if lost == [1] else math.inf)


@pytest.mark.usefixtures("gains")
def test_the_figures_of_a_predictor_are_whole() -> None:
    figures = predicted(losses=[lossy(1)]).figures
    assert figures == {
        "feasible": True,
        "structure": "predictor",
        "current_bandwidth_hz": 150.0,
        "period_s": 0.001,
        "delay_s": pytest.approx(0.0020004),
        "dead_time_s": REQUEST.dead_time_s,
        "speed_noise_rad_s": REQUEST.speed_noise_rad_s,
        "speed_gain_nm_s_rad": 0.05,
        "torque_gain": 0.25,
        "load_noise_nm_sqrt_s": 0.4,
        "load_noise_max_nm_sqrt_s": 4.0,
        "load_nm": 0.6,
        "peak_floor_rad_s": REQUEST.floor_rad_s(),
        "gamma": 88.123456789,
        "certificate": {
            "gamma": "exact, of the sampled loop with constant gains and every sample",
            "losses": loss_figures([lossy(1)], 0.6),
            "peaks": "over lost samples; over the floor by trial",
        },
        "robustness": {
            **ROBUST.peaks_over_floor,
            "gain_margin_db": 6.0,
            "phase_margin_deg": 45.0,
            "modulus_margin": 0.6,
            "delay_margin_s": 0.00123456789,
            "inertia_70_percent": {"gamma_exact": None},
            "inertia_130_percent": {"gamma_exact": 90.0},
            "gains_found_by_losses": [90.0, None],
            "torque_noise_nm": 0.0456789012,
        },
    }


def test_a_predictor_s_file_has_its_gains_and_figures_in_six_digits() -> None:
    found = predicted().controller()
    assert (found.speed_gain_nm_s_rad, found.torque_gain) == (0.05, 0.25)
    assert (found.dead_time_us, found.speed_filter_hz, found.current_bandwidth_hz) == (120.0, 500.0, 150.0)
    assert (found.inertia_kg_m2, found.viscous_friction_nm_s) == (
        MOTOR.inertia_kg_m2,
        MOTOR.viscous_friction_nm_s,
    )
    assert found.certificate is None
    assert found.figures is not None
    assert found.figures.model_dump(exclude_none=True) == {
        "load_nm": 0.6,
        "peak_over_floor": 1.12346,
        "peak_over_floor_inertia_70_percent": 1.2,
        "peak_over_floor_inertia_130_percent": 1.3,
        "gamma": 88.1235,
        "delay_margin_us": 1234.57,
        "torque_noise_nm": 0.0456789,
    }


@pytest.mark.parametrize(
    ("measured", "losses", "held"),
    [
        (False, [], (None, None)),
        (True, [], (2, 1000)),
        (True, [refuted(1)], (2, 1000)),
        (False, [refuted(2), lossy(1)], (1, 1000)),
    ],
)
def test_a_file_is_made_for_a_network_that_was_measured_or_certified(
    measured: bool, losses: list[SampledAnalysis], held: tuple[int | None, int | None]
) -> None:
    made_for = predicted(measured=measured, losses=losses).controller().made_for
    assert made_for is not None
    assert (made_for.losses_in_a_row_max, made_for.delay_max_us) == held
    assert (made_for.delay_us, made_for.period_us, made_for.plant) == (2001, 1000, PLANT)
    loop = CurrentLoop(bandwidth_hz=150.0, bandwidth_min_hz=75.0, bandwidth_max_hz=255.0)
    assert made_for.current_loop == loop


def test_losses_are_certified_from_the_most_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        dynamic, "predictor_losses", lambda _design, most: refuted(most) if most else lossy(0)
    )
    monkeypatch.setattr(PredictorResult, "peak", lambda *_losses: PeakBound(60.0, 59.0))
    done = predicted().certified()
    assert [each.network.losses_max for each in done.losses] == [2, 1, 0]
    certificate = done.controller().certificate
    assert certificate is not None
    assert certificate.losses_in_a_row_max == 0
    assert certificate.sequences is not None
    assert certificate.sequences.step_peak_certified_rad_s == 60.0
    assert certificate.sequences.step_peak_found_rad_s == 59.0


def test_a_predictor_is_looked_at_with_the_digits_of_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    rough = PredictorDesign(REQUEST, np.array([0.123456789, 0.987654321]), Walks(0.3333333333, 6.6666666666))
    monkeypatch.setattr(dynamic, "design_predictor", lambda _request: rough)
    monkeypatch.setattr(dynamic, "predictor_robustness", lambda _design: ROBUST)
    done = design_speed_predictor(REQUEST, 3, measured=True)
    assert done.design.F.tolist() == [0.123457, 0.987654]
    assert (done.design.walks.quiet, done.design.walks.bold) == (0.333333, 6.66667)
    assert (done.loop, done.losses_max, done.measured) == (ROBUST, 3, True)


def hinf_result() -> HinfResult:
    weights = SimpleNamespace(error=0.5, noise_rad_s=0.1, integral_rad_s=2.0)
    found = SimpleNamespace(gamma=1.2345678, gamma_min=1.1, K=SimpleNamespace(order=7))
    conditioned = SimpleNamespace(
        A=np.array([[0.5]]), B=np.array([1.0]), L=np.array([2.0]), C=np.array([3.0]), D=4.0, order=3
    )
    made: Any = HinfDesign
    return HinfResult(made(REQUEST, weights, found, conditioned), ROBUST, 1)


def test_an_h_infinity_controller_is_told_with_its_norm_and_orders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dynamic, "uncertainty_norm", lambda _design: 0.75)
    done = hinf_result()
    figures = done.figures
    assert figures["weights"] == {"error_s_rad": 0.5, "noise_rad_s": 0.1, "integral_rad_s": 2.0}
    names = ("norm", "norm_min", "order_full", "order")
    assert [figures[name] for name in names] == [1.2345678, 1.1, 7, 3]
    assert figures["robustness"]["uncertainty_norm"] == 0.75
    found = done.controller()
    assert (found.period_us, found.A, found.B, found.L, found.C, found.D) == (
        1000, ((0.5,),), (1.0,), (2.0,), (3.0,), 4.0,
    )  # fmt: skip
    lags_s = 1.0 / (2 * math.pi * 150.0) + 1.0 / (2 * math.pi * 500.0)
    assert found.answer_us == short(1e6 * (0.0010004 + 120e-6 + lags_s))
    assert found.figures is not None
    assert found.figures.norm == 1.23457
