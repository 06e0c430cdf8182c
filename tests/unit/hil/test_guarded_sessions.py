"""A measurement and a commissioning tell who else speaks on their bus, as a run does."""

from pathlib import Path

import pytest

from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import ForeignNode, put_on_the_bus
from tests.scenario.measuring import measuring_rig

STEPS = 7
"""From the first question to the drive enabled at rest."""
STRANGERS = {
    "heartbeat of node 127 (77Fh) that the bench did not send": Frame(0x77F, b"\x05"),
    "node 5 started": Frame(0x705, b"\0"),
    "1016h of node 1 changed by another": Frame(0x601, bytes.fromhex("2316100200000000")),
}


@pytest.mark.parametrize("what", STRANGERS)
def test_a_measurement_tells(tmp_path: Path, what: str) -> None:
    with measuring_rig(tmp_path) as rig:
        put_on_the_bus(rig.world, ForeignNode(STRANGERS[what], 0.9, times=3))
        measured = rig.measure()
    first, last = rig.said
    assert first.startswith(what)
    assert last.endswith("3 times in all")
    assert list(measured.timing["others"].values()) == [3]


def test_a_measurement_by_itself_sees_nobody(tmp_path: Path) -> None:
    with measuring_rig(tmp_path) as rig:
        assert rig.measure().timing["others"] == {}
    assert rig.said == []


def commissioned(folder: Path, *strangers: ForeignNode) -> list[str]:
    """What is told of others while the first steps are done."""
    servo, truth = unknown_drive(3, 1)
    plate = Nameplate.model_validate(truth.nameplate)
    request = CommissionRequest(bus="simulated", node=1, out=folder, nameplate=plate)
    told: list[str] = []
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 3), [servo]) as world:
        put_on_the_bus(world, *strangers)
        commission(request, world, Dialog(told.append), EmergencyStop(), steps=lambda: all_steps()[:STEPS])
    assert not any("failed" in text for text in told), told
    return [
        text.strip() for text in told if "did not send" in text or "started" in text or "1016h of" in text
    ]


@pytest.mark.long
def test_a_commissioning_by_itself_sees_nobody(tmp_path: Path) -> None:
    assert commissioned(tmp_path) == []


@pytest.mark.long
@pytest.mark.parametrize("what", STRANGERS)
def test_a_commissioning_tells(tmp_path: Path, what: str) -> None:
    first, last = commissioned(tmp_path, ForeignNode(STRANGERS[what], 1.5, times=3))
    assert first.startswith(what)
    assert last.endswith("3 times in all")
