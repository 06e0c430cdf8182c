"""The predictor of examples/controllers on whole runs: at the floor, quiet, without a steady error."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.configuration.predicting_controllers import PredictingController
from servobench.hil.execution.network_guard import Certificates
from tests import floor_runs
from tests.floor_runs import LOAD_AT_S, PERIOD_S, Case, lost_ratio
from tests.shaft_run import ShaftRun, run_watched

pytestmark = pytest.mark.long

FILE = Path("examples/controllers/ling2012-predictor.toml")
CASE = Case("ling2012", LING2012.model_dump(mode="json"), 1e-3)


def table() -> dict[str, Any]:
    """[controller] without what it was made for: it is tried on another inertia, too."""
    tables: dict[str, Any] = tomllib.loads(FILE.read_text(encoding="utf-8"))["controller"]
    del tables["made_for"]
    return tables


@pytest.fixture(scope="module")
def runs() -> list[ShaftRun]:
    """The load step at eight instants: each quarter of a period twice, 7 ms apart."""
    config = CASE.config(table())
    return [
        run_watched(config, LOAD_AT_S + 0.25e-3 * (step % 4) + 7e-3 * (step // 4), CASE.load_nm)
        for step in range(8)
    ]


def test_the_speed_peaks_at_the_floor(runs: list[ShaftRun]) -> None:
    ratios = [run.peak_rad_s(0.1) / CASE.floor_rad_s() for run in runs]
    assert np.median(ratios) < 1.13
    assert max(ratios) < 1.35  # the shaft's own noise at the instant of the step is up to a fifth of the peak
    assert min(ratios) > 0.7  # else the floor is none


def test_the_torque_is_quiet_and_the_load_leaves_no_error(runs: list[ShaftRun]) -> None:
    for run in runs:
        assert np.std(run.commands_nm(LOAD_AT_S - 0.3, LOAD_AT_S)) < 0.12
        error = run.rows["reference_rad_s"][-100:] - run.rows["velocity_rad_s"][-100:]
        assert abs(np.mean(error)) < 0.05
        assert np.mean(run.rows["channel_0"][-100:]) == pytest.approx(CASE.load_nm, abs=0.03)


def test_with_five_readings_lost_it_stays_at_its_own_floor(
    runs: list[ShaftRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The median: the shaft's own noise at the instant of the step is up to a fifth of the peak."""
    ratios = []
    for step in range(5):
        monkeypatch.setattr(floor_runs, "LOAD_AT_S", LOAD_AT_S + 7e-3 * step)
        ratios.append(lost_ratio(CASE, table(), runs[0], 0.1))
    assert np.median(ratios) < 1.06
    assert max(ratios) < 1.2


@pytest.mark.parametrize("inertia", [0.7, 1.3])
def test_another_inertia_costs_little(inertia: float) -> None:
    run = run_watched(CASE.config(table(), inertia), LOAD_AT_S, CASE.load_nm)
    assert run.peak_rad_s(0.1) / CASE.floor_rad_s(inertia) < 1.3


@pytest.mark.parametrize("name", ["predictor", "fused"])
def test_a_run_refuses_a_drive_and_a_period_that_it_was_not_made_for(name: str) -> None:
    controller = load_controller(FILE.with_name(f"ling2012-{name}.toml"))
    assert isinstance(controller, PredictingController)
    assert controller.made_for is not None
    whole = controller.model_dump(mode="json", exclude_none=True)
    assert Certificates(CASE.config(whole)).faults({}) == []
    heavier = copy.deepcopy(CASE.motor)
    heavier["mechanics"]["inertia_kg_m2"] *= 2.0
    (fault,) = Certificates(Case("heavier", heavier, PERIOD_S).config(whole)).faults({})
    assert isinstance(fault, BadInput)
    assert "inertia" in str(fault)


def test_a_loop_that_saturates_winds_nothing_up() -> None:
    config = CASE.config(table())
    drive = config.drive["axis1"]
    weak = drive.model_copy(update={"limits": drive.limits.model_copy(update={"torque_max_nm": 0.9})})
    config = config.model_copy(update={"drive": {"axis1": weak}})
    run = run_watched(config, LOAD_AT_S, 0.6)
    overshoot = np.max(run.rows["velocity_rad_s"][:700] - np.max(run.rows["reference_rad_s"]))
    assert np.max(np.abs(run.rows["command_torque_nm"])) == pytest.approx(0.9)
    assert overshoot < 2.0
