"""Runs of predictor and H-infinity through lost readings, held against what their files certify."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.studies.speed.dynamic import design_speed_predictor, request_of
from tests.floor_runs import Case

EXAMPLES = Path(__file__).parents[2] / "examples"
FILES = {name: EXAMPLES / "controllers" / f"ling2012-{name}.toml" for name in ("predictor", "hinf")}


def bench(name: str, lost: int) -> dict[str, Any]:
    """Of every ``lost`` + 1 readings one comes.

    Without 1400h:05 the run begins at an instant at which no statusword of the event timer keeps a SYNC
    waiting: it would by 32 us, and a command acts that much later than the certificate has it.
    """
    return {
        "bench": {"name": "lossy", "duration_s": 1.0, "seed": 1},
        "loop": {"period_us": 1000, "actuation": "on_sync", "command_readback": "event"},
        "drive": {
            "axis1": {
                "node": 1,
                "motor": str(EXAMPLES / "motors" / "ling2012.toml"),
                "simulation": {"encoder_counts_per_revolution": 65_536, "lacks": ["1400:5"]},
                "limits": {"speed_max_rpm": 3000.0, "torque_max_nm": 4.0},
                "controller": str(FILES[name]),
            }
        },
        "reference": {"axis1": [{"at_s": 0.0, "kind": "ramp", "speed_rpm": 500.0, "over_s": 0.1}]},
        "load": {"axis1": [{"at_s": 0.6, "torque_nm": 0.3}]},
        "faults": {"periodic_loss": [{"direction": "drive_to_host", "frames": [0x181], "lost": lost}]},
    }


def certificate_of(folder: Path, tables: dict[str, Any], *more: str) -> tuple[int, dict[str, Any]]:
    path = folder / "bench.toml"
    path.write_text(toml_text(tables))
    done = CliRunner().invoke(app, ["run", str(path), *more])
    summary = json.loads(next(folder.glob("runs/*/summary.json")).read_text())
    return done.exit_code, summary["certificates"]["axis1"]


@pytest.mark.parametrize(("name", "lost"), [("predictor", 5), ("hinf", 1)])
def test_with_as_many_readings_lost_as_are_certified_the_gain_is_kept(
    name: str, lost: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, held = certificate_of(tmp_path, bench(name, lost))
    assert status == 0
    assert held["state"] == "kept", held
    assert held["losses_together"] == {"certified": lost, "seen": lost, "seen_at_most": lost}
    told = tomllib.loads(FILES[name].read_text())["controller"]["certificate"]["sequences"]
    gain = held["gain_rad_s_nm"]
    assert gain["certified"] == told["gain_certified"] > told["gain_found"] > gain["seen_at_least"] > 0.3


def test_more_losses_than_are_certified_leave_the_premises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _, held = certificate_of(tmp_path, bench("predictor", 6), "--allow-uncertified")
    assert held["state"] == "premise left"
    left = "losses: 6 in a row, readings and commands together, made for at most 5"
    assert held["premises_left"][0] == left


def test_the_gain_is_for_the_current_loop_of_the_design_alone() -> None:
    case = Case("ling2012", LING2012.model_dump(mode="json"), 1e-3)
    for bandwidth_hz, unknown in (
        (800.0, ()),
        (700.0, ("bandwidth: gain certified for a current loop of 800 Hz alone",)),
    ):
        for file in FILES.values():
            config = case.config(tomllib.loads(file.read_text())["controller"])
            drive = config.drive["axis1"]
            simulation = drive.simulation.model_copy(update={"current_bandwidth_hz": bandwidth_hz})
            axes = {"axis1": drive.model_copy(update={"simulation": simulation})}
            plan = Certificates(config.model_copy(update={"drive": axes})).plans()["axis1"]
            assert plan.samples_alone
            assert plan.unknown == unknown


def test_the_predictor_of_a_file_is_the_one_that_is_certified() -> None:
    """To the last digit."""
    result = design_speed_predictor(request_of(LING2012.parameters, 800.0, 1e-3, 1e-3, 0.6, 0.1), 1)
    design, written = result.design, result.controller()
    assert (written.torque_gain, written.speed_gain_nm_s_rad) == tuple(design.F[:2])
    assert (written.load_noise_nm_sqrt_s, written.load_noise_max_nm_sqrt_s) == (
        design.walks.quiet,
        design.walks.bold,
    )
    assert written.speed_noise_rad_s == design.request.speed_noise_rad_s
    assert written.torque_noise_nm == design.request.torque_noise_nm
