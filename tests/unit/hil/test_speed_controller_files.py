"""The file of a designed speed controller: its gain, what it was made for, and what is proved of it."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.design.delay.certificate import CertifiedGain
from servobench.design.delay.lmi import SOLVED, SOLVER
from servobench.design.sampled.analysis import SampledAnalysis
from servobench.design.sampled.bandwidth_range import BandwidthRange
from servobench.design.sampled.held_loop import SampledNetwork
from servobench.design.speed.speed_pid import SpeedPid, first_order_current_loop
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.studies.numbers import finite, margin_figures, short
from servobench.hil.studies.speed import pid
from servobench.hil.studies.speed.controller_text import (
    begun_us,
    controller_of,
    controller_text,
    sequence_proof,
    whole_us,
)
from servobench.hil.studies.speed.synthesis import DesignResult
from tests.unit.hil.made_analyses import ARRIVAL, MARGINS, STAMP, made_analysis
from tests.unit.hil.test_speed_synthesis import design, request

MOTOR = LING2012.parameters
COVERED = BandwidthRange(100.0, 200.0, 130.0, 2.5)


@pytest.mark.parametrize(
    ("time_s", "begun", "whole"),
    [(0.0, 0, 0), (1e-6, 1, 1), (1.5e-6, 1, 2), (0.002, 2000, 2000), (0.003 - 1e-13, 3000, 3000),
     (0.003 + 1e-13, 3000, 3000), (0.0030004, 3000, 3001)],
)  # fmt: skip
def test_times_are_whole_microseconds_on_the_safe_side(time_s: float, begun: int, whole: int) -> None:
    assert (begun_us(time_s), whole_us(time_s)) == (begun, whole)


def test_numbers_are_finite_or_none_and_of_six_digits() -> None:
    assert [finite(value) for value in (1.5, None, math.inf, -math.inf, math.nan)] == [1.5] + [None] * 4
    assert short(math.pi * 1e5) == 314159.0
    assert short(-1.23456789e-7) == -1.23457e-7
    figures = {"gain_margin_db": 6.0, "phase_margin_deg": 45.0, "modulus_margin": 0.6}
    assert margin_figures(MARGINS) == figures
    assert margin_figures(replace(MARGINS, gain_margin_db=math.inf)) == figures | {"gain_margin_db": None}


def result(
    network: SampledNetwork | None = None,
    bandwidths: BandwidthRange | None = None,
    sampled: SampledAnalysis | None = None,
    *,
    for_sampled: bool = False,
    bandwidth_hz: float | None = 150.0,
) -> DesignResult:
    certified = None if for_sampled else CertifiedGain(101.0, 2, 1e-4)
    asked = request(None, network=network, bandwidth_hz=bandwidth_hz, for_sampled=for_sampled)
    return DesignResult(asked, design(delay_s=0.0640004), 99.5, certified, sampled, bandwidths)


def file_of(done: DesignResult) -> dict[str, Any]:
    return controller_of(done).model_dump(exclude_none=True)


def test_a_gain_is_written_with_its_constant_delay_and_proof() -> None:
    found = file_of(result(bandwidths=COVERED))
    assert (found["kind"], found["gain"]) == ("state_feedback", (0.0, -0.02))
    assert found["made_for"] == {
        "delay_us": 64000,
        "plant": {
            "resistance_ohm": MOTOR.resistance_ohm,
            "inductance_q_h": MOTOR.inductance_q_h,
            "inertia_kg_m2": MOTOR.inertia_kg_m2,
            "viscous_friction_nm_s": MOTOR.viscous_friction_nm_s,
            "torque_constant_nm_a": MOTOR.torque_constant_nm_a,
        },
        "current_loop": {
            "order": 1,
            "bandwidth_hz": 150.0,
            "bandwidth_min_hz": 100.0,
            "bandwidth_max_hz": 200.0,
        },
    }
    assert found["certificate"] == {
        "method": "exact",
        "target": "constant",
        "gamma": 101.0,
        "gamma_all_bandwidths": 130.0,
        "gamma_exact": 99.5,
        "order": 2,
        "solver": SOLVER,
        "status": SOLVED,
        "min_margin": 1e-4,
    }


def test_a_network_is_written_with_the_proof_over_its_sequences() -> None:
    found = file_of(result(STAMP, COVERED, made_analysis()))
    assert {name: found["made_for"][name] for name in ("strategy", "period_us", "losses_in_a_row_max")} == {
        "strategy": "stamp",
        "period_us": 10_000,
        "losses_in_a_row_max": 2,
    }
    assert (found["made_for"]["delay_max_us"], found["made_for"]["agreed_delay_us"]) == (4_000, 10_000)
    certificate = found["certificate"]
    assert "gamma_all_bandwidths" not in certificate, "of that the sampled loop tells"
    assert certificate["sequences"] == {
        "gain_certified": 125.0,
        "gain_certified_all_bandwidths": 130.0,
        "gain_found": 100.0,
        "step_peak_certified_rad_s": 50.0,
        "step_peak_found_rad_s": 40.0,
        "decay_certified_per_s": 3.0,
        "decay_certified_all_bandwidths_per_s": 2.5,
        "decay_found_per_s": 4.0,
        "min_margin": 2e-4,
        "gain_matrices": (((2.0, 0.0), (0.0, 2.0)), ((3.0, 0.0), (0.0, 3.0))),
        "decay_matrices": (((1.0, 0.0), (0.0, 1.0)),),
    }


def test_a_loop_that_was_made_best_sampled_refers_to_its_sequences() -> None:
    found = file_of(result(ARRIVAL, None, made_analysis(ARRIVAL), for_sampled=True))
    certificate = found["certificate"]
    assert (certificate["target"], certificate["solver"], certificate["status"]) == (
        "sampled",
        SOLVER,
        "see sequences",
    )
    assert "gamma" not in certificate
    assert "agreed_delay_us" not in found["made_for"]
    assert "gain_certified_all_bandwidths" not in certificate["sequences"]
    loop = found["made_for"]["current_loop"]
    assert (loop["bandwidth_min_hz"], loop["bandwidth_max_hz"]) == (150.0, 150.0)


def test_a_drive_without_a_current_loop_has_none_in_its_file() -> None:
    assert "current_loop" not in file_of(result(bandwidth_hz=None))["made_for"]


@pytest.mark.parametrize("lacking", ["gain_proof", "decay_proof"])
def test_half_a_proof_is_not_written(lacking: str) -> None:
    assert sequence_proof(made_analysis(STAMP, **{lacking: None})) is None
    assert sequence_proof(None) is None


def test_a_file_that_was_written_is_read_again(tmp_path: Path) -> None:
    written = controller_of(result(STAMP, COVERED, made_analysis()))
    (tmp_path / "k.toml").write_text(controller_text(written))
    read = load_controller(tmp_path / "k.toml").model_dump()
    assert len(read["certificate"]["sequences"].pop("digest")) == 64
    told = written.model_dump()
    del told["certificate"]["sequences"]["digest"]
    assert read == told


def test_the_current_loop_of_a_pid_is_a_file_s_or_one_of_its_bandwidth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop, crossover = pid.current_loop_of(MOTOR, None, 100.0)
    assert crossover == pytest.approx(math.tau * 100.0)
    assert np.array_equal(loop.A, first_order_current_loop(crossover).A)
    monkeypatch.setattr(pid, "closed_loop", lambda motor, controller: (motor, controller))
    file: Any = object()
    found: Any = pid.current_loop_of(MOTOR, file, 100.0)
    assert found == (MOTOR, file)


def test_a_pid_is_told_and_written() -> None:
    made = SpeedPid(0.123456789, 1.23456789, 0.00123456789, 0.001, 60.123456, 0.0015, MARGINS)
    figures = pid.pid_figures(replace(made, margins=replace(MARGINS, gain_margin_db=math.inf)))
    assert "margins" not in figures
    assert (figures["proportional_nm_s_rad"], figures["phase_margin_deg"]) == (0.123456789, 45.0)
    assert (figures["gain_margin_db"], figures["dead_time_s"]) == (None, 0.0015)
    written = pid.controller_of(MOTOR, 2, math.tau * 123.456789, made)
    assert written.model_dump(exclude_none=True) == {
        "kind": "pid",
        "proportional_nm_s_rad": 0.123457,
        "integral_nm_rad": 1.23457,
        "derivative_nm_s2_rad": 0.00123457,
        "derivative_filter_s": 0.001,
        "feedforward_nm_s_rad": MOTOR.viscous_friction_nm_s,
        "made_for": {
            "crossover_rad_s": 60.1235,
            "current_loop": {"order": 2, "bandwidth_hz": 123.457},
        },
    }
