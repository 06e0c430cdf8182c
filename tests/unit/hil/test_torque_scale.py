"""What every torque rests on is said beside each figure, and a scale that the flux contradicts is found."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from servobench.design.motor import CONVENTIONS
from servobench.hil.commissioning.report import Commissioned, summary_of, write_report
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import unknown_world

pytestmark = pytest.mark.long

SEED = 5
"""It tells everything truly."""
UNMEASURED = "rests on the rated torque of {by}, {rated:.4g} N m, which nothing measured"


def plate(constant: bool, **rating: float) -> dict[str, Any]:
    """The drive's own, with or without its constant of the flux."""
    own = unknown_drive(SEED)[1].nameplate
    motor = {key: value for key, value in own["motor"].items() if constant or key not in CONVENTIONS}
    return {"motor": motor, "rating": own["rating"] | rating}


def commissioned(
    folder: Path, tables: dict[str, Any], last_step: str = "mechanics"
) -> tuple[CommissionRequest, Commissioned]:
    _, result, _ = unknown_world(SEED, folder, plate=tables, period_us=4000, last_step=last_step)
    assert result.error is None
    request = CommissionRequest("simulated", 1, folder, nameplate=Nameplate.model_validate(tables))
    return request, result


def test_without_a_witness_it_is_said_beside_each_figure_and_no_zero_faults_are_found(tmp_path: Path) -> None:
    request, result = commissioned(tmp_path, plate(constant=False))
    rated = unknown_drive(SEED)[1].rated_torque_nm
    sentence = UNMEASURED.format(by="6076h and the nameplate", rated=rated)
    first, second = summary_of(request, result)
    assert "no faults found with a torque scale that nothing measured" in first
    assert second == f"each of inertia, friction and gains {sentence}"
    write_report(request, result)
    figures = json.loads((tmp_path / "figures.json").read_text())
    (mechanics,) = [step for step in figures["steps"] if step["name"] == "mechanics"]
    stated = {each["name"]: each for each in mechanics["quantities"]}
    assert stated["inertia"]["rests_on"] == sentence
    assert stated["inertia"]["scale_uncertainty"] is None
    assert stated["inertia"]["uncertainty"] < 0.01 * stated["inertia"]["value"]
    assert figures["torque_scale"]["witness"] == ""
    assert "rating.torque_nm" in figures["header"]["by the nameplate alone"]
    page = (tmp_path / "report.html").read_text()
    assert "of the torque scale, k = 2" in page
    assert "<td>unknown</td>" in page
    for name in ("report.md", "report.html", "drive.toml", "motor.toml"):
        assert sentence in (tmp_path / name).read_text(), name


def test_a_printed_constant_is_a_witness_and_no_measurement(tmp_path: Path) -> None:
    request, result = commissioned(tmp_path, plate(constant=True))
    first, second = summary_of(request, result)
    assert "0 faults found" in first
    assert "which nothing measured; the nameplate's ke_line_vrms_krpm makes" in second
    assert second.endswith("+- 12 %")


@pytest.mark.parametrize("factor", [1.0, math.sqrt(2.0)])
def test_where_the_voltage_gives_out_it_measures_the_torque(factor: float, tmp_path: Path) -> None:
    """A plate that is wrong by sqrt(2) and has no constant that would tell it; its rotor has half of the
    inertia that is measured then, or more than all of it."""
    truth = unknown_drive(SEED)[1]
    motor = truth.motor
    rpm = 30.0 / math.pi * motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)
    tables = plate(constant=False, torque_nm=factor * truth.rated_torque_nm)
    tables["rating"].pop("speed_rpm")  # which would contradict it
    tables["motor"]["inertia_kg_m2"] = (2.0 if factor != 1.0 else 0.7) * motor.inertia_kg_m2
    tables["limits"] = {"speed_max_rpm": 1.3 * rpm}
    request, result = commissioned(tmp_path, tables, "voltage_constant")
    _, second = summary_of(request, result)
    assert "the measured voltage constant makes" in second
    measured = float(second.split(" makes ")[1].split()[0])
    assert measured == pytest.approx(truth.rated_torque_nm, rel=0.05)
    faults = [fault for record in result.records for fault in record.outcome.faults]
    named = [
        fault for fault in faults if "torque constant and DC link contradict each other by 1.39" in fault
    ]
    assert len(named) == (0 if factor == 1.0 else 1)
    assert any("less than that of the rotor alone" in fault for fault in faults) == bool(named)
    assert not named or "effective current taken for peak current" in named[0]
