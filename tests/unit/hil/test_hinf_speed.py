"""The H-infinity controller of examples/controllers on whole runs: near the floor, quiet, no steady error."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.network_guard import Certificates
from tests.floor_runs import LOAD_AT_S, Case, lost_ratio
from tests.shaft_run import ShaftRun, run_watched

pytestmark = pytest.mark.long

FILE = Path("examples/controllers/ling2012-hinf.toml")
CASE = Case("ling2012", LING2012.model_dump(mode="json"), 1e-3)


def table(made_for: bool = False) -> dict[str, Any]:
    """[controller]; without what it was made for it is tried on another inertia, too."""
    tables: dict[str, Any] = tomllib.loads(FILE.read_text(encoding="utf-8"))["controller"]
    if not made_for:
        del tables["made_for"]
    return tables


@pytest.fixture(scope="module")
def runs() -> list[ShaftRun]:
    """The load step at two instants of a period."""
    config = CASE.config(table())
    return [run_watched(config, LOAD_AT_S + 0.5e-3 * phase, CASE.load_nm) for phase in range(2)]


def test_the_speed_peaks_near_the_floor_and_returns(runs: list[ShaftRun]) -> None:
    for run in runs:
        assert 0.7 < run.peak_rad_s(0.1) / CASE.floor_rad_s() < 1.3
        error = run.rows["reference_rad_s"][-100:] - run.rows["velocity_rad_s"][-100:]
        assert abs(np.mean(error)) < 0.05
        assert np.std(run.commands_nm(LOAD_AT_S - 0.3, LOAD_AT_S)) < 0.12


def test_a_ramp_is_followed(runs: list[ShaftRun]) -> None:
    """Behind by the delay and the filter: on the ramp 10 ms stand for a tenth of the speed."""
    rows = runs[0].rows
    slope = (rows["reference_rad_s"][80] - rows["reference_rad_s"][40]) / 40e-3
    behind = rows["reference_rad_s"][40:80] - rows["velocity_rad_s"][40:80]
    assert np.max(behind) / slope < 4e-3
    over = np.max(rows["velocity_rad_s"][:400]) - np.max(rows["reference_rad_s"])
    assert over < 1.0


def test_with_five_readings_lost_it_stays_near_its_own_floor(runs: list[ShaftRun]) -> None:
    """Through the loss the last reading is held, noise and all."""
    assert lost_ratio(CASE, table(), runs[0], 0.1) < 1.2


def test_a_loop_that_saturates_winds_nothing_up() -> None:
    config = CASE.config(table())
    drive = config.drive["axis1"]
    weak = drive.model_copy(update={"limits": drive.limits.model_copy(update={"torque_max_nm": 0.9})})
    run = run_watched(config.model_copy(update={"drive": {"axis1": weak}}), LOAD_AT_S, 0.6)
    assert np.max(np.abs(run.rows["command_torque_nm"])) == pytest.approx(0.9)
    assert np.max(run.rows["velocity_rad_s"][:700] - np.max(run.rows["reference_rad_s"])) < 3.0


def test_a_run_refuses_a_motor_that_it_was_not_made_for() -> None:
    heavier = LING2012.model_dump(mode="json")
    assert Certificates(CASE.config(table(made_for=True))).faults({}) == []
    heavier["mechanics"]["inertia_kg_m2"] *= 2.0
    (fault,) = Certificates(Case("heavier", heavier, 1e-3).config(table(made_for=True))).faults({})
    assert isinstance(fault, BadInput)
    assert "inertia" in str(fault)
