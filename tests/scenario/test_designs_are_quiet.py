"""A speed design for the drive's current loop is quiet on it; one for R/L is refused, as it limit-cycles."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.bench import run_bench
from servobench.hil.rows.run_files import EVENTS_FILE
from servobench.hil.studies.speed.controller_text import plant_of
from servobench.hil.verdict.verdict import LimitResult
from tests.draws import few_of
from tests.random_motors import FINE_ENCODER, designed, random_bench, run, steady_rms_nm, torque_rms_nm

QUIET_NM = 0.15
"""Of Ling's motor, 2 N m rated."""
NOISE_ALONE = 1.35
"""Torque over what the encoder's noise makes of it by the design's own figure: the speed's noise is not quite
white at 1 kHz, and the drive's speed filter takes 0.3 ms more. A limit cycle is 10 and more."""


@pytest.mark.parametrize("seed", few_of([1, 2, 3, 4], 2))
def test_a_design_for_the_drives_bandwidth_has_the_noise_of_the_encoder_and_no_more(seed: int) -> None:
    """A heavy shaft takes more torque for the same speed error, and so for the same noise."""
    own = designed(np.random.default_rng(seed))
    assert torque_rms_nm(own.motor, own.gain) < NOISE_ALONE * own.noise_nm
    fine_nm = torque_rms_nm(own.motor, own.gain, encoder_counts_per_revolution=FINE_ENCODER)
    assert fine_nm < 0.1 * QUIET_NM, "without noise nothing swings"


def made_for_the_winding(simulation: dict[str, float]) -> dict[str, Any]:
    """What `hil design speed --target sampled --current-bandwidth-hz 53.83` writes for 1 ms without loss."""
    loop = {"bandwidth_hz": 53.83, "bandwidth_min_hz": 53.83, "bandwidth_max_hz": 53.83}
    made_for = {"delay_us": 2000, "strategy": "arrival", "period_us": 1000, "losses_in_a_row_max": 0}
    made_for |= {
        "delay_max_us": 1000,
        "plant": plant_of(LING2012.parameters).model_dump(),
        "current_loop": loop,
    }
    tables = random_bench(LING2012.model_dump(mode="json"), [-1.881, -1.757])
    tables["drive"]["axis1"]["controller"]["made_for"] = made_for
    tables["drive"]["axis1"]["simulation"] = simulation
    return tables


def test_a_design_for_54_hz_is_refused_on_the_default_drive_of_800(tmp_path: Path) -> None:
    config = bench_from(made_for_the_winding({}), "bench.toml", Path())
    with pytest.raises(BadInput, match=r"inner_rate_hz: found '800 Hz', expected .* 53\.83 Hz and no other"):
        run_bench(
            config,
            record=tmp_path / "refused",
        )
    assert not (tmp_path / "refused").exists()


@pytest.mark.parametrize("by_file", [False, True])
def test_where_it_is_let_pass_its_limit_cycle_is_an_event_and_judged(tmp_path: Path, by_file: bool) -> None:
    tables = made_for_the_winding({})
    if by_file:
        tables["drive"]["axis1"]["controller"]["made_for"]["torque_rms_nm_max"] = QUIET_NM
    else:
        tables["verdict"] = {"torque_rms_nm_max": QUIET_NM}
    config = bench_from(tables, "bench.toml", Path())
    folder = tmp_path / "run"
    result = run_bench(config, record=folder, allow_uncertified=True)
    assert (result.torque_rms_nm or 0.0) > 1.0
    assert not result.verdict.passed
    (limit,) = result.verdict.limits
    assert (limit.metric, limit.limit, limit.result) == ("torque_rms_nm_max", QUIET_NM, LimitResult.BROKEN)
    (event,) = [line for line in (folder / EVENTS_FILE).read_text().splitlines() if "limit cycle" in line]
    assert '"WARN"' in event


def test_it_runs_quietly_on_the_loop_that_it_was_made_for() -> None:
    tables = made_for_the_winding({"current_bandwidth_hz": 53.83})
    assert steady_rms_nm(run(bench_from(tables, "bench.toml", Path()))) < QUIET_NM


def test_the_least_gain_at_one_millisecond_is_quiet_for_800_hz_and_not_for_54() -> None:
    """Both designed by `hil design speed --target sampled` for 1 ms without loss and up to 1 ms of delay."""
    motor = LING2012.model_dump(mode="json")
    assert torque_rms_nm(motor, [-0.277584, -1.152695]) < QUIET_NM
    assert torque_rms_nm(motor, [-1.881, -1.757]) > 1.0
