"""The voltage constant against the DC link: it shows wrong ratings, which torque and current cannot."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.commissioning.findings import StepFailed, StepRecord, StepVerdict
from servobench.hil.commissioning.request import Nameplate
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_voltage import VoltageConstant, dc_link_v
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import unknown_world

pytestmark = pytest.mark.long

LAST = "voltage_constant"
SEED = 5
"""It tells everything truly."""


def plate(**rating: float) -> dict[str, Any]:
    """The drive's own, with ratings changed."""
    _, truth = unknown_drive(SEED)
    return {**truth.nameplate, "rating": {**truth.nameplate["rating"], **rating}}


def step_of(folder: Path, changed: dict[str, Any]) -> StepRecord:
    """The step in a commissioning that ends with it."""
    _, result, _ = unknown_world(SEED, folder, plate=changed, period_us=4000, last_step=LAST)
    return next(record for record in result.records if record.name == LAST)


def test_where_the_voltage_gives_out_it_is_measured(tmp_path: Path) -> None:
    _, truth = unknown_drive(SEED)
    motor = truth.motor
    constant = motor.pole_pairs * motor.flux_linkage_wb
    rpm = motor.voltage_max_v / constant / RAD_S_PER_RPM
    step = step_of(tmp_path, {**plate(), "limits": {"speed_max_rpm": 1.3 * rpm}})
    assert step.verdict is StepVerdict.DONE, step.reason
    found = step.outcome.figures
    assert found["voltage_constant"] == pytest.approx(constant, rel=0.02)
    assert abs(found["voltage_constant"] - constant) < found["voltage_constant_error"]
    assert found["voltage_constant_error"] < 0.06 * constant
    assert found["dc_link_v"] == motor.dc_bus_voltage_v
    assert found["speed_rad_s"] == pytest.approx(rpm * RAD_S_PER_RPM, rel=0.03)


def test_a_plate_whose_torque_is_ten_times_too_large_is_contradicted_by_the_voltage(tmp_path: Path) -> None:
    """It was trusted, and says neither a speed nor a constant of the flux that would contradict it before."""
    _, truth = unknown_drive(SEED)
    rating = {key: value for key, value in truth.nameplate["rating"].items() if key != "speed_rpm"}
    step = step_of(tmp_path, {"rating": rating | {"torque_nm": 10.0 * truth.rated_torque_nm}})
    assert step.verdict is StepVerdict.FAILED
    assert step.reason.startswith("torque constant and DC link contradict each other by")
    assert "torque_nm" in step.reason


def told(raw_mv: int | None, **rating: float) -> Session:
    """A session with a drive that tells so much of its DC link."""
    objects = SimpleNamespace(read_if_there=lambda _index: raw_mv)
    request = SimpleNamespace(nameplate=Nameplate.model_validate({"rating": rating}))
    return cast(Session, SimpleNamespace(objects=objects, request=request, torque_mode=lambda: True))


@pytest.mark.parametrize(("raw", "rating"), [(320, {}), (320_000, {"dc_bus_voltage_v": 48.0})])
def test_a_dc_link_that_cannot_be_is_refused(raw: int, rating: dict[str, float]) -> None:
    """Told in volts, or not of the motor on the plate."""
    with pytest.raises(StepFailed, match="6079h tells"):
        dc_link_v(told(raw, **rating))
    assert dc_link_v(told(320_000, dc_bus_voltage_v=310.0)) == 320.0


@pytest.mark.parametrize("raw", [None, 0])
def test_without_6079h_it_is_said(raw: int | None) -> None:
    reason = VoltageConstant().left_out(told(raw))
    assert reason == "the drive tells no DC link voltage 6079h: its voltage constant cannot be measured"
