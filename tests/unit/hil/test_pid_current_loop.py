"""A PID on a current loop slower than it was tuned for is told at the start."""

import math
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.bounded_file import read_toml
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import bench_from, load_bench
from servobench.hil.configuration.drive_current_loop import crossover_rad_s
from servobench.hil.execution.network_guard import Certificates

EXAMPLES = Path(__file__).parents[3] / "examples"
HINF = EXAMPLES / "azaiz2007_hinf.toml"
MOTOR = EXAMPLES / "motors" / "azaiz2007.toml"


def hinf_with(controller: dict[str, Any] | str) -> list[str]:
    """What is told of the H-infinity bench with another PID."""
    tables = read_toml(HINF, "bench file")
    tables["drive"]["axis1"]["controller"] = controller
    return Certificates(bench_from(tables, "bench.toml", EXAMPLES)).doubts()


@pytest.fixture(scope="module")
def tuned_for_800_hz(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("pid") / "pid.toml"
    done = CliRunner().invoke(app, ["design", "pid", str(MOTOR), "--out", str(out)])
    assert done.exit_code == 0, done.output
    table: dict[str, Any] = read_toml(out, "controller file")["controller"]
    assert table["made_for"]["current_loop"] == {"order": 1, "bandwidth_hz": 800.0}
    return table


def test_a_pid_for_800_hz_on_the_h_infinity_loop_is_told_with_the_figures(
    tuned_for_800_hz: dict[str, Any],
) -> None:
    (told,) = hinf_with(tuned_for_800_hz)
    crossover = tuned_for_800_hz["made_for"]["crossover_rad_s"]
    lost_deg = math.degrees(
        math.atan(crossover / (math.tau * 23.0718)) - math.atan(crossover / (math.tau * 800))
    )
    assert f"about {lost_deg:.0f} degrees" in told
    assert "tuned for a current loop of 800 Hz" in told
    assert "23.07 Hz (drive.axis1.current_control.controller)" in told


def test_without_made_for_the_gains_tell_it(tuned_for_800_hz: dict[str, Any]) -> None:
    (told,) = hinf_with({key: value for key, value in tuned_for_800_hz.items() if key != "made_for"})
    assert "five times as fast" in told
    assert "23.07 Hz" in told


@pytest.mark.parametrize("name", ["azaiz2007_hinf", "azaiz2007", "ling2012", "any_bus", "three_axes"])
def test_the_shipped_benches_go_well_together(name: str) -> None:
    assert Certificates(load_bench(EXAMPLES / f"{name}.toml")).doubts() == []


def test_the_shipped_controller_is_what_the_command_makes(tmp_path: Path) -> None:
    """By the controller's file and by the bench that names it."""
    for source in (
        ["--current-control", str(EXAMPLES / "controllers" / "azaiz2007-kq.toml")],
        ["--bench", str(HINF)],
    ):
        out = tmp_path / source[0]
        assert (
            CliRunner().invoke(app, ["design", "pid", str(MOTOR), *source, "--out", str(out)]).exit_code == 0
        )
        assert out.read_text() == (EXAMPLES / "controllers" / "azaiz2007-speed.toml").read_text()


def test_what_is_not_known_or_not_the_benchs_is_not_judged(tuned_for_800_hz: dict[str, Any]) -> None:
    tables = read_toml(HINF, "bench file")
    tables["drive"]["axis1"]["controller"] = tuned_for_800_hz
    config = bench_from(tables, "bench.toml", EXAMPLES)
    assert Certificates(config, {"axis1"}).doubts() == []
    assert Certificates(config.as_run("socketcan:can0", None)).doubts() == []


def test_the_crossover_of_the_gains_is_close_to_the_designs(tuned_for_800_hz: dict[str, Any]) -> None:
    """The design counts the current loop's 800 Hz in, which changes the gain by half a percent."""
    tables = read_toml(HINF, "bench file")
    tables["drive"]["axis1"]["controller"] = tuned_for_800_hz
    drive = bench_from(tables, "bench.toml", EXAMPLES).drive["axis1"]
    assert drive.controller.kind == "pid"
    found = crossover_rad_s(drive.controller, drive.motor.parameters)
    assert found == pytest.approx(tuned_for_800_hz["made_for"]["crossover_rad_s"], rel=0.02)


def test_two_ways_to_name_the_loop_contradict_each_other() -> None:
    asked = ["design", "pid", str(MOTOR), "--bench", str(HINF), "--current-bandwidth-hz", "100"]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 2
    assert "either --bench or --current-bandwidth-hz" in done.output
