"""examples/cabinet.toml: a controller made for the machine passes, the demo's PID does not."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench import Bench, LimitExceeded, run
from servobench.hil.cli import app

EXAMPLES = Path(__file__).parents[2] / "examples"
CABINET = Bench.load(EXAMPLES / "cabinet.toml")
PID = {
    "drive.axis1.controller": Bench.load(EXAMPLES / "ling2012.toml").tables["drive"]["axis1"]["controller"]
}
RIGID = {f"drive.axis1.motor.{table}": None for table in ("coupling", "friction", "cogging")}


def test_the_controller_that_was_made_for_it_passes() -> None:
    assert run(CABINET).verdict.outcome == "passed"
    assert run(CABINET, RIGID).verdict.outcome == "passed"


@pytest.mark.parametrize("notch_hz", [120.0, 141.0])
def test_and_with_a_notch_that_is_somewhat_off(notch_hz: float) -> None:
    changes = {"drive.axis1.controller.parameters.notch_hz": notch_hz}
    assert run(CABINET, changes).verdict.outcome == "passed"


def test_the_pid_of_the_demo_passes_on_a_rigid_shaft_alone() -> None:
    assert run(CABINET, {**PID, **RIGID}).verdict.outcome == "passed"
    with pytest.raises(LimitExceeded):
        run(CABINET, PID)


def test_the_same_seed_gives_the_same_run() -> None:
    assert run(CABINET).digest == run(CABINET).digest


@pytest.mark.parametrize(("motor", "told"), [("cabinet", True), ("ling2012", False)])
def test_a_design_says_that_it_knows_no_coupling(motor: str, told: bool) -> None:
    asked = ["design", "pid", str(EXAMPLES / "motors" / f"{motor}.toml"), "--current-bandwidth-hz", "800"]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 0
    assert ("a rigid shaft is assumed, the coupling's resonance at 134 Hz left out" in done.stderr) is told
