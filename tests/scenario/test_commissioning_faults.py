"""A commissioning of a drive that falls into a fault or sends EMCYs without end, or whose step breaks."""

import json
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.findings import StepOutcome
from servobench.hil.commissioning.report import REPORT_FILE
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.rows.run_files import COMMISSIONING_RECORDING, EVENTS_FILE
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import WrappedStep, unknown_world
from tests.recorded_frames import candump_text

SEED = 3
IN_POLARITY_S = 2.6
"""The shaft is turned by its first pulse."""
REST_AND_RESTORED = {"at_rest": True, "disabled": True, "settings": "restored", "mend": None}


def left(folder: Path) -> dict[str, Any]:
    """How the drive was left by figures.json; the report says the same."""
    found: dict[str, Any] = json.loads((folder / "figures.json").read_text())["left"]
    report = (folder / REPORT_FILE).read_text()
    assert all(sentence in report for sentence in found.pop("text"))
    return found


def test_a_drive_that_falls_into_a_fault_is_left_at_rest_with_a_report(tmp_path: Path) -> None:
    fault = {"nodes": [1], "fault": "over_current", "at_s": IN_POLARITY_S}
    _, result, spy = unknown_world(SEED, tmp_path, faults={"drive_fault": [fault]}, last_step="polarity")
    assert "is in fault" in str(result.error)
    assert "2310h (continuous over-current)" in str(result.error)
    assert left(tmp_path) == REST_AND_RESTORED
    assert spy.drive.power.state is not State.OPERATION_ENABLED
    assert abs(spy.drive.firmware.speed_rad_s) < 1.0


class Breaks(WrappedStep):
    """A step that ends in an error of its own while the drive is enabled."""

    def run(self, session: Session, outcome: StepOutcome) -> None:
        del outcome
        with session.exercising():
            raise ZeroDivisionError("a slip of its author")


def test_a_step_that_breaks_leaves_the_drive_at_rest_and_a_report(tmp_path: Path) -> None:
    servo, truth = unknown_drive(SEED)
    plate = Nameplate.model_validate(truth.nameplate)
    request = CommissionRequest(bus="simulated", node=1, out=tmp_path, nameplate=plate, trust_nameplate=True)

    def steps() -> list[Step]:
        names = [step.name for step in all_steps()]
        chosen = all_steps()[: names.index("polarity") + 1]
        return [Breaks(step) if step.name == "polarity" else step for step in chosen]

    told: list[str] = []
    plan = WorldPlan(parse_bus_spec("simulated"), 1_000_000, seed=SEED)
    with open_world(plan, [servo]) as world, pytest.raises(ZeroDivisionError):
        commission(request, world, Dialog(told.append), EmergencyStop(), steps=steps)
    assert left(tmp_path) == REST_AND_RESTORED
    assert servo.drive.power.state is State.SWITCH_ON_DISABLED
    assert "an error of hil's own" in (tmp_path / REPORT_FILE).read_text()


def test_emcys_without_end_are_a_line_with_the_first_and_one_with_their_number(tmp_path: Path) -> None:
    """Every 10 ms while the drive is enabled."""
    fault = {"nodes": [1], "code": 0x2310, "at_s": 2.2}
    told: list[str] = []
    faults = {"repeated_emergency": [fault]}
    unknown_world(SEED, tmp_path, faults=faults, last_step="polarity", tell=told.append)
    recording = tmp_path / COMMISSIONING_RECORDING
    times = candump_text(recording).count(" 081#1023")
    assert times > 100
    lines = [text.strip() for text in told if "2310h" in text]
    assert lines == [lines[0], f"drive: EMCY 2310h: {times} times in all"]
    assert lines[0].startswith("drive: EMCY 2310h (continuous over-current), register 03h")
    events = map(json.loads, (recording / EVENTS_FILE).read_text().splitlines())
    assert [event["text"] for event in events if "2310h" in event.get("text", "")] == lines
