"""[Azaiz2007] from the command line, and its drive over CAN with H-infinity current loops."""

import json
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.execution.simulated_drives import drive_parameters
from servobench.hil.testing.bench_runs import BenchRunner
from tests.draws import few_of

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


def test_reproduce_prints_the_keys() -> None:
    """Texts, the printed controllers beside ours and the figures are held by tests/unit/hil/told."""
    status, out, _ = _run("reproduce", "azaiz2007", "--json")
    assert status == 0
    found = json.loads(out)
    for axis in ("q", "d"):
        assert set(found[axis]) == AXIS_KEYS
        assert set(found[axis]["reduced"]) == {"gain", "zeros", "poles", "closed_loop_norm"}
    assert found["q"]["gain"] == pytest.approx(49.7026, rel=1e-5)
    assert all(set(run) == RUN_KEYS for run in found["simulation"].values())
    assert found["simulation"]["nominal"]["peak_torque_nm"] == pytest.approx(11.327, rel=2e-3)


def test_design_current_writes_a_controller_that_a_bench_runs(
    servo_bench: BenchRunner, tmp_path: Path
) -> None:
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
    speed = _speed(servo_bench, {"drive.axis1.current_control.controller": str(out_file)})
    assert speed[-1] == pytest.approx(175.0, abs=1.0)


def test_a_discrete_design_runs_in_the_simulated_drive(servo_bench: BenchRunner, tmp_path: Path) -> None:
    """H-infinity on the plant sampled at the drive's inner rate, with one sample of computing delay."""
    out_file = tmp_path / "kq.toml"
    status, out, _ = _run(
        "design", "current", MOTOR, "--axis", "q", "--sample-rate-hz", "16000", "--discrete",
        "--out", str(out_file), "--json",
    )  # fmt: skip
    assert status == 0
    found = json.loads(out)["sampled"]
    assert found["method"] == "discrete"
    assert found["spectral_radius"] < 1.0
    assert found["gamma_min"] <= found["closed_loop_norm"] < found["gamma"]
    table = [row["gamma_min"] for row in found["gamma_min_by_rate"]]
    assert table == sorted(table)
    assert found["continuous_sampled"]["closed_loop_norm"] > found["gamma_min"]
    speed = _speed(servo_bench, {"drive.axis1.current_control.controller": str(out_file)})
    assert speed[-1] == pytest.approx(175.0, abs=1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--gamma", "0.9"], ["gamma_min is 0.95", "relax the weights"]),
        (["--gamma", "1", "--gamma-factor", "2"], ["either --gamma or --gamma-factor"]),
        (["--gamma-factor", "1.0"], ["at least 1.0005 times gamma_min", "runs to infinity"]),
        (["--sample-rate-hz", "40"], ["more than 46.1 Hz", "sample faster"]),
        (["--sample-rate-hz", "100"], ["a rate at which the loop is stable", "sample faster"]),
        (
            ["--sample-rate-hz", "300", "--discrete", "--gamma", "1"],
            ["more than gamma_min = 1.4", "sample faster"],
        ),
        (["--discrete"], ["--sample-rate-hz with it"]),
        (["--reduce", "9"], ["fewer states than the 4"]),
        (["--other", str(EXAMPLES / "controllers" / "azaiz2007-kq.toml")], ["one for the d axis"]),
        (["--picture", "/nonexistent/x.png"], ["file that can be written"]),
        (["--weights", "none.toml"], ["Weights file not found"]),
    ],
)
def test_bad_input_says_what_to_do(arguments: list[str], words: list[str]) -> None:
    status, _, err = _run("design", "current", MOTOR, "--axis", "q", *arguments)
    assert status == 2
    assert all(word in err for word in words)


WEIGHTS = """
[error]
kind = "error"
crossing_rad_s = 156.75
peak = 1.51
static_error = 1e-4
[control]
kind = "zero_pole"
high = 25.0
zero_rad_s = 1000.0
pole_rad_s = 50000.0
[output]
kind = "crossing"
low = 0.5
high = 1e4
crossing_rad_s = 235.0
"""


@pytest.mark.parametrize(
    ("written", "instead", "words"),
    [
        ("high = 25.0", "high = 0.0", ["A2", "vanishes at high frequency", "give it a gain above 0"]),
        ("high = 25.0", "high = 1e-12", ["A2", "nearly broken", "larger gain"]),
        ("static_error = 1e-4", "static_error = 0.0", ["A1", "integrator", "1e-4 say"]),
        ("pole_rad_s = 50000.0", "pole_rad_s = -50000.0", ["A1", "not stable", "give it a pole above 0"]),
        ("zero_rad_s = 1000.0", "zero_rad_s = 0.0", ["A3", "give it a zero above 0"]),
        ("crossing_rad_s = 156.75", "crossing_rad_s = 15675.0", ["gamma_min is", "relax the weights"]),
    ],
)
def test_weights_that_break_an_assumption(
    tmp_path: Path, written: str, instead: str, words: list[str]
) -> None:
    path = tmp_path / "weights.toml"
    path.write_text(WEIGHTS.replace(written, instead), encoding="utf-8")
    status, _, err = _run("design", "current", MOTOR, "--axis", "q", "--weights", str(path))
    assert status == 2
    assert all(word in err for word in words), err


def test_the_rules_as_a_weights_file_give_the_paper_s_gain(tmp_path: Path) -> None:
    path = tmp_path / "weights.toml"
    path.write_text(WEIGHTS, encoding="utf-8")
    _, out, _ = _run("design", "current", MOTOR, "--axis", "q", "--weights", str(path), "--json")
    assert json.loads(out)["gain"] == pytest.approx(49.7026, rel=1e-5)


PLANT: dict[str, Any] = {
    "A": [[2.0]],
    "B": [[1.0, 1.0]],
    "C": [[1.0], [0.0], [1.0]],
    "D": [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]],
    "controls": 1,
    "measurements": 1,
}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"B": [[1.0, 0.0]]}, ["A1", "not stabilisable", "s = 2 1/s", "actuator"]),
        ({"C": [[1.0], [0.0], [0.0]]}, ["A1", "not detectable", "sensor"]),
        (
            {"D": [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]]},
            ["A2", "D12 has rank 0", "give every control a weight"],
        ),
        ({"A": [[0.0]], "C": [[0.0], [0.0], [1.0]]}, ["A3", "w = 0 rad/s", "weigh it"]),
        ({"A": [[0.0]], "B": [[0.0, 1.0]]}, ["A4", "w = 0 rad/s", "disturbance"]),
        ({"controls": 2}, ["at least one of each kind"]),
        ({"A": [[1.0, 2.0]]}, ["matrices that fit"]),
        ({"B": [[1.0, 1.0], [1.0]]}, ["rows of different lengths"]),
    ],
)
def test_a_plant_that_breaks_an_assumption(tmp_path: Path, changes: dict[str, Any], words: list[str]) -> None:
    path = tmp_path / "plant.json"
    path.write_text(json.dumps(PLANT | changes), encoding="utf-8")
    status, _, err = _run("design", "hinf", str(path))
    assert status == 2
    assert all(word in err for word in words), err


def test_a_plant_of_one_s_own(tmp_path: Path) -> None:
    path = tmp_path / "plant.json"
    path.write_text(json.dumps(PLANT), encoding="utf-8")
    status, out, _ = _run("design", "hinf", str(path), "--gamma-factor", "1.2", "--json")
    found = json.loads(out)
    assert status == 0
    assert found["gamma"] == pytest.approx(1.2 * found["gamma_min"])
    assert found["gamma_min"] * 0.999 < found["closed_loop_norm"] < found["gamma"]


def test_wrong_decoupling_is_shown_over_speed() -> None:
    """Without angle advance and with twice the inductances the coupled axes part earlier."""
    status, out, _ = _run(
        "design", "current", MOTOR, "--axis", "q", "--reduce", "3", "--sample-rate-hz", "4000",
        "--speed-rpm", "6000", "--decoupling-factor", "2.0", "--advance-periods", "0", "--json",
    )  # fmt: skip
    assert status == 0
    found = json.loads(out)
    coupled = found["sampled"]["coupled"]
    assert coupled["speed_rad_s"][-1] == pytest.approx(628.3, abs=0.1)
    assert coupled["as_asked"][-1] > max(coupled["decoupled"][-1], coupled["without_advance"][-1])
    lowest = found["sampled"]["lowest_rate"]
    assert lowest["rate_hz"] == max(lowest["margin_rate_hz"], lowest["coupled_rate_hz"])
    robust = found["robust"]
    assert robust["modulus_margin_bound"] <= robust["worst_modulus_margin"]
    assert robust["coupled"]["real_mu_bound"] > 1.0
    assert robust["coupled"]["rightmost_pole_per_s"] > 0.0


def test_text_recommends_a_rate() -> None:
    status, out, _ = _run("design", "current", MOTOR, "--axis", "d", "--sample-rate-hz", "8000")
    assert status == 0
    assert "Hz or more holds a modulus margin of" in out


def test_the_pid_of_the_example_is_what_the_rule_gives() -> None:
    current = EXAMPLES / "controllers" / "azaiz2007-kq.toml"
    status, out, _ = _run("design", "pid", MOTOR, "--current-control", str(current), "--json")
    found = json.loads(out)
    assert status == 0
    with (EXAMPLES / "controllers" / "azaiz2007-speed.toml").open("rb") as file:
        used = tomllib.load(file)["controller"]
    for key in ("proportional_nm_s_rad", "integral_nm_rad", "derivative_nm_s2_rad", "derivative_filter_s"):
        assert used[key] == pytest.approx(found[key], rel=1e-4)


@pytest.mark.parametrize("axis", ["q", "d"])
def test_the_controllers_of_the_example_are_what_the_design_gives(tmp_path: Path, axis: str) -> None:
    path = tmp_path / "k.toml"
    _run(
        "design", "current", MOTOR, "--axis", axis, "--reduce", "3", "--reduce-by", "paper",
        "--out", str(path),
    )  # fmt: skip
    made, used = (
        tomllib.loads(file.read_text(encoding="utf-8"))["current_controller"]
        for file in (path, EXAMPLES / "controllers" / f"azaiz2007-k{axis}.toml")
    )
    assert made["gain"] == pytest.approx(used["gain"], rel=1e-6)
    assert np.array(made["poles_rad_s"]) == pytest.approx(np.array(used["poles_rad_s"]), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (["azaiz2007-kq.toml", "azaiz2007-kq.toml"], ["one controller for the q axis at most"]),
        (["none.toml"], ["Current controller file not found"]),
    ],
)
def test_simulate_refuses_current_controllers_it_cannot_run(files: list[str], words: list[str]) -> None:
    options = [part for name in files for part in ("--current-control", str(EXAMPLES / "controllers" / name))]
    status, _, err = _run("simulate", "--bus", "hub:unused", "--node", "1", "--motor", MOTOR, *options)
    assert status == 2
    assert all(word in err for word in words), err


def test_simulated_drives_get_the_controllers_of_both_axes() -> None:
    files = [EXAMPLES / "controllers" / f"azaiz2007-k{axis}.toml" for axis in "qd"]
    found = drive_parameters(files)
    assert found.controller_q is not None
    assert found.controller_d is not None
    assert found.controller_q.order == found.controller_d.order == 3
    assert found.controller_q.period_s == pytest.approx(1.0 / found.inner_rate_hz)


def _speed(servo_bench: BenchRunner, changes: dict[str, Any]) -> np.ndarray:
    """(800,) speed, rad/s, as the host saw it, cycle by cycle."""
    run = servo_bench(EXAMPLES / "azaiz2007_hinf.toml", changes)
    run.assert_passed()
    return run.axis().velocity_rad_s


@pytest.mark.parametrize(
    ("resistance", "inductance"),
    few_of([*product((0.5, 1.5), repeat=2), *product((1.0,), (0.5, 1.0, 1.5))], 2),
)
def test_the_drive_over_can_holds_step_and_load(
    servo_bench: BenchRunner, resistance: float, inductance: float
) -> None:
    """175 rad/s at 0.1 s, 3 N m at 0.18 s: rise, overshoot, dip, recovery, also with other parameters."""
    simulation = {"resistance_factor": resistance, "inductance_factor": inductance}
    speed = _speed(servo_bench, {"drive.axis1.simulation": simulation})
    assert speed[:100] == pytest.approx(0.0, abs=0.5)
    assert np.argmax(speed > 0.9 * 175.0) < 100 + 40
    assert np.nanmax(speed) < 1.13 * 175.0
    assert np.nanmin(speed[182:]) > 0.93 * 175.0
    assert speed[700:] == pytest.approx(175.0, abs=1.75)


def test_the_example_weights_give_the_gains_of_the_paper() -> None:
    """49.7026 by the rules, as (71) says, and 49.7105 with the rounded (44) and (46)."""
    for name, gain in (("azaiz2007-q", 49.7026), ("azaiz2007-q-printed", 49.7105)):
        path = EXAMPLES / "weights" / f"{name}.toml"
        _, out, _ = _run("design", "current", MOTOR, "--axis", "q", "--weights", str(path), "--json")
        assert json.loads(out)["gain"] == pytest.approx(gain, abs=6e-5)


SALIENT = """
[motor]
name = "salient"
resistance_ohm = 0.05
inductance_d_h = 2e-5
inductance_q_h = 6e-5
flux_linkage_wb = 0.01
pole_pairs = 7
transform = "amplitude_invariant"
[mechanics]
inertia_kg_m2 = 1e-5
viscous_friction_nm_s = 1e-6
[rating]
torque_nm = 0.3
speed_rpm = 3000.0
current_max_a = 20.0
dc_bus_voltage_v = 48.0
"""


@pytest.mark.parametrize("structure", few_of(["third-order", "pi", "full", "pi+pole"], 2))
@pytest.mark.parametrize("motor", few_of(["salient", "ling2012"], 1))
def test_other_motors_and_structures(tmp_path: Path, motor: str, structure: str) -> None:
    """The rules scale with r/L: the paper's own margins, whatever the motor, and a stable sampled loop."""
    path = EXAMPLES / "motors" / "ling2012.toml"
    if motor == "salient":
        path = tmp_path / "salient.toml"
        path.write_text(SALIENT, encoding="utf-8")
    status, out, err = _run(
        "design", "current", str(path), "--axis", "q", "--structure", structure,
        "--sample-rate-hz", "40000", "--delay-samples", "2", "--json",
    )  # fmt: skip
    assert status == 0, err
    found = json.loads(out)
    assert found["gamma_min"] == pytest.approx(0.951761, rel=1e-5)
    norms = {"full": 0.99705, "pi": 1.33144, "pi+pole": 0.95337, "third-order": 0.95179}
    assert found["closed_loop_norm"] == pytest.approx(norms[structure], rel=2e-4)
    assert found["sampled"]["spectral_radius"] < 1.0
    assert found["robust"]["stable"]
