"""[Azaiz2007] from the command line, and its drive over CAN with H-infinity current loops."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.bench import run_bench
from hil.cli import app
from hil.configuration.bench_file import bench_from
from hil.configuration.config_files import read_toml
from hil.recording.records_file import RECORDS_FILE, read_records
from hil.terminal.progress import no_progress

EXAMPLES = Path(__file__).parents[2] / "examples"
MOTOR = str(EXAMPLES / "motors" / "azaiz2007.toml")
AXIS_KEYS = {
    "gain", "zeros", "poles", "gamma_min", "closed_loop_norm", "gain_margin_db", "gain_margin_rad_s",
    "phase_margin_deg", "phase_margin_rad_s", "modulus_margin", "steady_state_error", "rise_time_s",
    "settling_time_s", "overshoot_percent", "hankel_singular_values", "reduced",
}  # fmt: skip
RUN_KEYS = {
    "peak_torque_nm", "peak_torque_time_s", "rise_time_s", "settling_time_s", "speed_max_rad_s",
    "speed_min_after_step_rad_s", "id_max_a",
}  # fmt: skip


def _run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, result.stdout, result.stderr


def test_reproduce_prints_the_keys_and_draws_every_figure(tmp_path: Path) -> None:
    status, out, _ = _run("reproduce", "azaiz2007", "--json", "--figures", str(tmp_path / "figures"))
    assert status == 0
    found = json.loads(out)
    for axis in ("q", "d"):
        assert set(found[axis]) == AXIS_KEYS
        assert set(found[axis]["reduced"]) == {"gain", "zeros", "poles", "closed_loop_norm"}
    assert found["q"]["gain"] == pytest.approx(49.7026, rel=1e-5)
    assert all(set(run) == RUN_KEYS for run in found["simulation"].values())
    assert found["simulation"]["nominal"]["peak_torque_nm"] == pytest.approx(11.327, rel=2e-3)
    assert {path.suffix for path in (tmp_path / "figures").iterdir()} == {".png"}
    assert len(list((tmp_path / "figures").iterdir())) == 6


def test_design_current_writes_a_controller_that_a_bench_runs(tmp_path: Path) -> None:
    out_file = tmp_path / "kq.toml"
    status, out, _ = _run(
        "design", "current", MOTOR, "--axis", "q", "--reduce", "3", "--sample-rate-hz", "16000",
        "--out", str(out_file), "--picture", str(tmp_path / "q.png"), "--json",
    )  # fmt: skip
    assert status == 0
    found = json.loads(out)
    assert set(found) >= AXIS_KEYS
    assert set(found["sampled"]) >= {
        "phase_margin_deg",
        "gain_margin_db",
        "modulus_margin",
        "spectral_radius",
    }
    assert set(found["robust"]) >= {"worst_modulus_margin", "worst_weighted_sensitivity"}
    assert found["sampled"]["spectral_radius"] < 1.0
    assert (tmp_path / "q.png").stat().st_size > 10_000
    speed = _speed(tmp_path, {"controller": str(out_file)}, {})
    assert speed[-1] == pytest.approx(175.0, abs=1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--gamma", "0.9"], ["gamma_min is 0.95", "relax the weights"]),
        (["--gamma", "1", "--gamma-factor", "2"], ["either --gamma or --gamma-factor"]),
        (["--sample-rate-hz", "40"], ["too low"]),
        (["--reduce", "9"], ["order 9", "1..3 expected"]),
        (["--weights", "none.toml"], ["weights file"]),
    ],
)
def test_bad_input_says_what_to_do(arguments: list[str], words: list[str]) -> None:
    status, _, err = _run("design", "current", MOTOR, "--axis", "q", *arguments)
    assert status == 2
    assert all(word in err for word in words)


def _speed(folder: Path, control: dict[str, str], simulation: dict[str, float]) -> np.ndarray:
    """(800,) speed, rad/s, as the host saw it, cycle by cycle."""
    tables = read_toml(EXAMPLES / "azaiz2007_hinf.toml", "bench file")
    tables["drive"]["axis1"]["current_control"] |= control
    tables["drive"]["axis1"]["simulation"] = simulation
    config = bench_from(tables, "test", EXAMPLES)
    outcome = run_bench(
        config, bus_spec=None, time=None, seed=None, record=folder / "run", view=False, progress=no_progress
    )
    assert outcome.passed
    rows = np.concatenate(list(read_records(folder / "run" / RECORDS_FILE)))
    return np.asarray(rows["velocity_rad_s"], dtype=float)


@pytest.mark.parametrize("resistance", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("inductance", [0.5, 1.0, 1.5])
def test_the_drive_over_can_holds_step_and_load(tmp_path: Path, resistance: float, inductance: float) -> None:
    """175 rad/s at 0.1 s, 3 N m at 0.18 s: rise, overshoot, dip, recovery, also with other parameters."""
    varied = {"resistance_factor": resistance, "inductance_factor": inductance}
    speed = _speed(tmp_path, {}, varied)
    assert speed[:100] == pytest.approx(0.0, abs=0.5)
    assert np.argmax(speed > 0.9 * 175.0) < 100 + 40
    assert np.nanmax(speed) < 1.10 * 175.0
    assert np.nanmin(speed[182:]) > 0.93 * 175.0
    assert speed[700:] == pytest.approx(175.0, abs=1.75)
