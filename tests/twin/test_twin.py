"""A twin finds a drive that it has not seen, says how well, and what it does not know."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench import BadInput, Run, fit, run
from servobench.drivers.bounded_file import parse_toml
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import MotorFile
from tests.draws import few_of
from tests.twin.drawn import Hidden, hidden_drive

SPEED = "reference.axis1.speed_rpm"


def hil(*words: str) -> str:
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 0, result.output
    return result.stdout


def recorded(hidden: Hidden, duration_s: float = 8.0, **changes: Any) -> Run:
    tables = {"bench.duration_s": duration_s, **changes}
    return run(hidden.bench, tables, signals={SPEED: hidden.speed_rpm})


def test_k_2_holds_hidden_drives_and_predicts_runs_that_were_not_fitted() -> None:
    inside = together = 0
    for seed in few_of((2017, 2007), 1):  # delays, losses both ways
        hidden = hidden_drive(seed)
        other = run(hidden.bench, {"bench.duration_s": 3.0}, signals={SPEED: hidden.held_out_rpm})
        start = MotorFile.model_validate(hidden.start)
        recording = recorded(hidden)
        twin = fit(recording, start=start, hold_out=other, bootstrap=8)
        alone = fit(recording, start=start).keys
        widths = {name: (key.uncertainty, alone[name].uncertainty) for name, key in twin.keys.items()}
        wider = [(has or 0.0) / (had or math.inf) for has, had in widths.values()]
        assert min(wider) >= 0.999
        assert max(wider) > 1.2, "what repeats in all windows is in no sandwich"
        assert twin.held_out_ratio is not None
        assert twin.held_out_ratio < 1.2
        for name, truth in hidden.truth.items():
            key = twin.keys[name]
            assert key.uncertainty is not None
            together += 1
            inside += abs(key.value - truth) <= key.uncertainty
        inertia = twin.keys["mechanics.inertia_kg_m2"]
        assert inertia.value == pytest.approx(hidden.truth[inertia.name], rel=2e-3)
    assert inside >= together - 1


def test_what_a_recording_does_not_show_keeps_the_starts_value_and_says_so() -> None:
    hidden = hidden_drive(3)
    slow = 0.1 * hidden.motor["rating"]["speed_rpm"]
    one_way = run(
        hidden.bench, {"bench.duration_s": 4.0}, signals={SPEED: lambda t: slow * min(1.0, 4.0 * t)}
    )  # a steady speed one way: friction and weight look alike, and nothing accelerates
    start = MotorFile.model_validate(hidden.start)
    keys = fit(one_way, start=start).keys
    undetermined = [key for key in keys.values() if key.source == "not determined"]
    assert undetermined
    assert all(key.uncertainty is None for key in undetermined)
    assert {"load.hanging_nm", "mechanics.coulomb_friction_nm", "mechanics.viscous_friction_nm_s"} & {
        key.name for key in undetermined
    }


def test_the_command_writes_a_motor_file_that_a_bench_runs_and_motor_show_prints(
    tmp_path: Path,
) -> None:
    hidden = hidden_drive(5)
    name = "reference.axis1.speed_rpm"
    run(hidden.bench, {"bench.duration_s": 4.0}, signals={name: hidden.speed_rpm}, record=tmp_path / "rec")
    out = tmp_path / "twin.toml"
    told = hil("fit", str(tmp_path / "rec"), "--out", str(out), "--fix", "twin.speed_filter_hz", "--json")
    figures = json.loads(told)
    assert figures["keys"]["twin.speed_filter_hz"]["source"] == "fixed"
    tables = parse_toml(out.read_text(), str(out))
    assert "resistance_ohm" not in {key["name"] for key in tables["twin"]["key"]}
    assert len(tables["twin"]["covariance"]) == 5
    again = run(
        hidden.bench,
        {"bench.duration_s": 0.5, "drive.axis1.motor": tables},
        signals={name: hidden.speed_rpm},
    )
    assert again.config.drive["axis1"].motor.twin is not None
    assert figures["left_out_of_start"] == []
    coupled = tmp_path / "coupled.toml"
    coupling = "[coupling]\ninertia_ratio = 1.0\nantiresonance_hz = 150.0\n"
    kept = {key: value for key, value in hidden.start.items() if key != "load"}
    coupled.write_text(f"{toml_text(kept)}\n{coupling}")
    told = hil("fit", str(tmp_path / "rec"), "--start", str(coupled), "--out", str(tmp_path / "rigid.toml"))
    assert "Left out of the start, as the twin is rigid: coupling." in told
    assert "coupling" not in parse_toml((tmp_path / "rigid.toml").read_text(), "rigid.toml")
    shown = hil("motor", "show", str(out))
    assert "mechanics.inertia_kg_m2" in shown
    assert "fixed" in shown


def test_the_planned_motion_determines_every_key_within_the_limits_of_the_bench(tmp_path: Path) -> None:
    hidden = hidden_drive(3004)
    bench, out = tmp_path / "bench.toml", tmp_path / "excite.toml"
    rating = hidden.motor["rating"]
    load = {"axis1": [{"at_s": 1.0, "torque_nm": rating["torque_nm"]}]}
    bench.write_text(toml_text({**hidden.bench, "load": load, "verdict": {"settling_ms": 100}}))
    hil("fit", "--plan", str(bench), "--out", str(out))
    done = run(out)
    drive = done.config.drive["axis1"]
    assert done.config.load == {}
    assert done.config.faults is None
    speeds = done.axis().velocity_rad_s
    assert (
        0.7 * drive.limits.set_speed_rpm
        < float(np.nanmax(abs(speeds))) * RPM_PER_RAD_S
        < drive.limits.set_speed_rpm
    )
    torques = abs(done.axis().torque_nm)
    assert float(np.nanmax(torques)) < drive.limits.torque_max_nm
    assert abs(float(speeds[-1])) * RPM_PER_RAD_S < 0.01 * rating["speed_rpm"]
    keys = fit(done, start=MotorFile.model_validate(hidden.start)).keys
    assert {key.source for key in keys.values()} == {"fitted"}
    for name in (
        "mechanics.inertia_kg_m2",
        "mechanics.viscous_friction_nm_s",
        "mechanics.coulomb_friction_nm",
    ):
        assert keys[name].value == pytest.approx(hidden.truth[name], rel=2e-3)


def test_a_plan_is_refused_where_it_would_not_run(tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(toml_text(hidden_drive(5).bench))
    elsewhere = tmp_path / "other"
    elsewhere.mkdir()
    for words in (
        ["--plan", str(bench), "--out", str(bench)],
        ["--plan", str(bench), "--out", str(elsewhere / "excite.toml")],
        ["--plan", str(bench), str(elsewhere), "--out", str(tmp_path / "excite.toml")],
        ["--plan", "examples/position_csp.toml", "--out", "examples/excite.toml"],
        ["--plan", str(bench), "--axis", "axis2", "--out", str(tmp_path / "excite.toml")],
        ["--out", str(tmp_path / "excite.toml")],
    ):
        before = bench.read_bytes()
        result = CliRunner().invoke(app, ["fit", *words])
        assert result.exit_code != 0, words
        assert bench.read_bytes() == before
        assert list(tmp_path.rglob("excite.toml")) == []


def test_compare_tells_a_drive_that_is_the_twins_from_one_that_is_not(tmp_path: Path) -> None:
    hidden = hidden_drive(5)
    twin = tmp_path / "twin.toml"
    fit(recorded(hidden, 5.0), start=MotorFile.model_validate(hidden.start)).write(twin)

    def compared(signal: Callable[[float], float], name: str, **changed: Any) -> tuple[int, dict[str, Any]]:
        motor = {**hidden.motor, **changed}
        changes = {"bench.duration_s": 2.4, "drive.axis1.simulation.motor": motor, "bench.seed": 77}
        run(hidden.bench, changes, signals={SPEED: signal}, record=tmp_path / name)
        page = tmp_path / f"{name}.rrd"
        words = ["compare", str(tmp_path / name), "--twin", str(twin), "--json", "--rrd", str(page)]
        result = CliRunner().invoke(app, words)
        assert page.stat().st_size > 1000
        return result.exit_code, json.loads(result.stdout)

    status, same = compared(hidden.held_out_rpm, "same")
    assert (status, same["judgement"]) == (0, "within"), same
    assert {window["judgement"] for window in same["windows"]} <= {"within", "out of range"}
    mechanics = hidden.motor["mechanics"]
    heavier = {**mechanics, "inertia_kg_m2": 1.01 * mechanics["inertia_kg_m2"]}
    status, other = compared(hidden.held_out_rpm, "heavier", mechanics=heavier)
    assert (status, other["judgement"]) == (1, "outside")
    apart = [window for window in other["windows"] if window["speed"]["judgement"] == "outside"]
    assert all(window["speed"]["difference"] > window["speed"]["allowed"] for window in apart)
    assert sum(window["torque"]["judgement"] == "outside" for window in apart) < len(apart), (
        "its loop is the same"
    )
    assert "outside" in {octave["judgement"] for octave in other["frequency_hz"].values()}
    cogging = [{"per_turn": 12, "torque_nm": 0.01 * hidden.motor["rating"]["torque_nm"]}]
    status, cogged = compared(hidden.held_out_rpm, "cogging", cogging=cogging)
    assert status == 1
    assert "outside" in {place["judgement"] for place in cogged["angle_deg"].values()}
    status, faster = compared(lambda time_s: 1.7 * hidden.speed_rpm(time_s + 0.4), "faster")
    assert "out of range" in {window["judgement"] for window in faster["windows"]}


def test_what_no_twin_is_and_what_a_twin_is_not_compared_with_is_refused(tmp_path: Path) -> None:
    hidden = hidden_drive(5)
    motor = tmp_path / "motor.toml"
    motor.write_text(toml_text(hidden.start))
    for words in (["run", "--twin", str(motor)], ["one", "two", "--twin", str(motor)]):
        result = CliRunner().invoke(app, ["compare", *words])
        assert result.exit_code == 2


def test_what_cannot_be_fitted_is_refused_with_its_cure() -> None:
    hidden = hidden_drive(5)
    short = recorded(hidden, 0.5)
    with pytest.raises(BadInput, match="one of mechanics"):
        fit(short, fixed=["motor.resistance_ohm"])
    with pytest.raises(BadInput, match="record longer"):
        fit(short)
