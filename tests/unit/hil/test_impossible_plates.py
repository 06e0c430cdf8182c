"""A nameplate that contradicts itself is refused before anything is sent, whoever is to be trusted."""

import math
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.design.motor import CONVENTIONS
from servobench.hil.cli import app
from servobench.hil.commissioning.findings import StepRecord, StepVerdict
from servobench.hil.commissioning.report import Commissioned
from servobench.hil.commissioning.request import PlateMotor
from servobench.hil.configuration.config_files import toml_text
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import unknown_world

SEED = 7
"""Its drive tells twice its rated torque, so a plate that is mended by the drive has twice the torque."""
TRUE_SEED = 5
"""It tells everything truly."""


def plate(**rating: float) -> dict[str, Any]:
    """The seed's own without the constant of the flux, with ratings changed."""
    _, truth = unknown_drive(SEED)
    own = truth.nameplate
    motor = {key: value for key, value in own["motor"].items() if key not in CONVENTIONS}
    return {"motor": motor, "rating": own["rating"] | rating}


def commissioned(tables: dict[str, Any], folder: Path, *options: str) -> tuple[int, str]:
    file = folder / "plate.toml"
    file.write_text(toml_text(tables), encoding="utf-8")
    asked = ["commission", "--bus", "simulated", "--node", "1", "--rehearse", str(SEED), "--yes"]
    done = CliRunner().invoke(app, [*asked, "--motor", str(file), "--out", str(folder / "out"), *options])
    return done.exit_code, done.output


@pytest.mark.parametrize("options", [(), ("--trust-nameplate",)])
@pytest.mark.parametrize(
    ("torque_nm", "told"),
    [
        (3.684, "torque and speed make 655.8 W, volts and amperes 642.6 VA at most"),
        (1842.0, "rated torque 1.842 N m (N mm taken for N m)"),
    ],
)
def test_twice_the_torque_and_newton_millimetres_are_refused(
    torque_nm: float, told: str, options: tuple[str, ...], tmp_path: Path
) -> None:
    status, said = commissioned(plate(torque_nm=torque_nm), tmp_path, *options)
    assert status == 2
    assert f"{tmp_path / 'plate.toml'}: rating.torque_nm, rating.speed_rpm" in said
    assert told in said
    assert not (tmp_path / "out").exists()


def test_twice_the_torque_is_told_beside_what_the_other_figures_make(tmp_path: Path) -> None:
    own = unknown_drive(SEED)[1].nameplate
    status, said = commissioned({**own, "rating": own["rating"] | {"torque_nm": 3.684}}, tmp_path)
    assert status == 2
    assert "rated torque 3.684 N m and rated current 10.93 A rms: " in said
    assert "with ke_line_vrms_krpm this current makes 1.842 N m" in said
    assert "no unit or convention explains it: one of them is misread, or another motor's" in said


def test_a_plate_of_a_program_is_refused_before_anything_moves(tmp_path: Path) -> None:
    _, result, _ = unknown_world(SEED, tmp_path, plate=plate(torque_nm=3.684))
    assert result.records[-1].name == "units"
    assert "the nameplate contradicts itself" in result.records[-1].reason
    assert result.error is not None


@pytest.mark.long
def test_a_torque_alone_that_the_drives_current_and_voltage_cannot_make_is_refused_though_trusted(
    tmp_path: Path,
) -> None:
    """The plate has no current: the drive's 6075h and 6079h make 643 VA, not 328 kW."""
    tables = {"rating": {"torque_nm": 1842.0, "speed_rpm": 1700.0}}
    _, result, _ = unknown_world(SEED, tmp_path, plate=tables, trust_nameplate=True, last_step="units")
    assert result.records[-1].name == "units"
    assert "the nameplate's cannot be" in result.records[-1].reason


def test_a_drive_whose_torque_cannot_be_is_not_believed_and_nobody_is_asked(tmp_path: Path) -> None:
    """6076h tells 3.684 N m, which the plate's volts and amperes do not make."""
    result, units = units_step(plate(), tmp_path)
    assert units.reason == ""
    assert any("6076h cannot be: " in fault for fault in units.outcome.faults)
    assert result.findings.override.rated_torque_nm == 1.842


def units_step(tables: dict[str, Any], folder: Path, seed: int = SEED) -> tuple[Commissioned, StepRecord]:
    """A commissioning that ends with the step in which nameplate and drive meet; nobody is trusted."""
    _, result, _ = unknown_world(seed, folder, plate=tables, trust_nameplate=False, last_step="units")
    return result, next(record for record in result.records if record.name == "units")


@pytest.mark.long
def test_stall_torque_and_current_beside_the_drives_rated_ones_are_of_one_motor(tmp_path: Path) -> None:
    """The unit of 6077h is 6076h, whichever point the plate is of."""
    own = unknown_drive(TRUE_SEED)[1].nameplate
    rating = own["rating"]
    stall = {"torque_nm": 1.4 * rating["torque_nm"], "current_a": 1.4 * rating["current_a"]}
    result, units = units_step({**own, "rating": rating | stall}, tmp_path, TRUE_SEED)
    assert units.verdict is StepVerdict.DONE
    assert any("two rated points of one motor" in line for line in units.outcome.lines)
    assert result.findings.override.rated_torque_nm is None
    assert units.outcome.faults == []


def test_ac_volts_for_those_of_the_dc_bus_are_a_finding(tmp_path: Path) -> None:
    own = unknown_drive(TRUE_SEED)[1].nameplate
    rating = own["rating"]
    ac_v = rating["dc_bus_voltage_v"] / math.sqrt(2.0)
    result, units = units_step({**own, "rating": rating | {"dc_bus_voltage_v": ac_v}}, tmp_path, TRUE_SEED)
    assert result.error is None
    (fault,) = units.outcome.faults
    assert "rating.dc_bus_voltage_v" in fault
    assert "an AC voltage taken for that of the DC bus?" in fault


def test_a_speed_in_rad_s_is_a_finding_with_its_reading(tmp_path: Path) -> None:
    own = unknown_drive(TRUE_SEED)[1].nameplate
    slow = own["rating"]["speed_rpm"] * math.pi / 30.0
    result, units = units_step({**own, "rating": own["rating"] | {"speed_rpm": slow}}, tmp_path, TRUE_SEED)
    assert result.error is None
    assert any("(rad/s taken for r/min)" in fault for fault in units.outcome.faults)


def test_a_plate_takes_every_constant_of_the_flux() -> None:
    assert set(CONVENTIONS) <= set(PlateMotor.model_fields)
