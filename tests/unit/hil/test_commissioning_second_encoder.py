"""What commissioning finds of a second encoder, 60E4h:1, beside the first."""

from dataclasses import replace
from pathlib import Path

import pytest

from servobench.design.mechanism import Coupling, Mechanism
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.findings import StepOutcome
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.unknown_drive import nameplate_of
from tests.motors import LING

HALF = 0.5 * LING.inertia_kg_m2


def found(folder: Path, factor: int = 1, divisor: int = 1) -> StepOutcome:
    """Of the step that compares velocity and position; the drive tells 60E4h:1 by another factor."""
    shaft = Coupling(HALF, HALF, 2000.0, 0.3, second_encoder=True)
    servo = SimulatedServo(1, replace(LING, mechanism=Mechanism(shaft)))
    told: Variable = servo.dictionary.variable(Object.ADDITIONAL_POSITION, 1)
    own = told.provider
    assert own is not None
    told.provider = lambda: own() * factor // divisor
    request = CommissionRequest(
        bus="simulated", node=1, out=folder, nameplate=Nameplate.model_validate(nameplate_of(LING))
    )
    steps = [step for step in all_steps() if step.name not in ("stop",)]
    last = [step.name for step in steps].index("motion_units")
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 1), [servo]) as world:
        result = commission(
            request, world, Dialog(lambda _text: None), EmergencyStop(), steps=lambda: steps[: last + 1]
        )
    [outcome] = [record.outcome for record in result.records if record.name == "motion_units"]
    return outcome


def test_a_second_encoder_on_the_same_shaft_tells_the_same_path(tmp_path: Path) -> None:
    outcome = found(tmp_path)
    assert outcome.figures["second_over_first_encoder"] == pytest.approx(1.0, abs=0.002)
    [line] = [each for each in outcome.lines if "second encoder" in each]
    assert line.startswith("second encoder 60E4h:1: 1 of the path of 6064h (+")
    assert outcome.faults == []


@pytest.mark.parametrize(
    ("factor", "divisor", "said"), [(-1, 1, "counts against 6064h"), (3, 2, "tells 1.5 of the path")]
)
def test_another_direction_and_another_unit_are_found(
    tmp_path: Path, factor: int, divisor: int, said: str
) -> None:
    outcome = found(tmp_path, factor=factor, divisor=divisor)
    assert outcome.figures["second_over_first_encoder"] == pytest.approx(factor / divisor, abs=0.003)
    [fault] = outcome.faults
    assert said in fault
