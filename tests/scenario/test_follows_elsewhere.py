"""A drive that leaves its mode is noticed in a measurement and in a commissioning as in a run."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import DriveInFault
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.cli import app
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import ForeignNode, put_on_the_bus
from tests.scenario.measuring import measuring_rig

LEFT = "left cyclic synchronous torque for profile velocity"
TO_PV = Frame(0x601, bytes.fromhex("2F60600003000000"))
"""Another master writes 6060h of node 1."""
STEPS = 8
"""From the first question to a drive that was enabled."""


LEAVES = {"mode_change": [{"nodes": [1], "mode": "pv", "at_s": 0.1}]}
COMES_BACK = {"mode_change": [{"nodes": [1], "mode": "pv", "at_s": 0.1, "duration_s": 0.005}]}
IGNORES = {"ignored_commands": [{"nodes": [1], "holds": "zero", "at_s": 0.1}]}
SILENT = {"ignored_commands": [{"nodes": [1], "holds": "last", "at_s": 0.1, "bit_12_cleared": False}]}
STUCK = {"signal": [{"object": "target_torque", "how": "stuck", "from_s": 0.1}]}
ENDS = [
    (LEAVES, f"{LEFT}; 6061h is 3, 10 was commanded"),
    (COMES_BACK, f"{LEFT}; 6061h is 3, 10 was commanded"),
    (IGNORES, "ignores the commands of cyclic synchronous torque; bit 12 of its statusword is 0"),
    (SILENT, "no longer follows its commands"),
    (STUCK, "no longer follows its commands"),
]


@pytest.mark.parametrize(
    ("faults", "why"), ENDS, ids=["left", "came back", "bit 12", "no word", "stuck frames"]
)
def test_a_measurement_with_enabled_drives_ends(tmp_path: Path, faults: dict[str, Any], why: str) -> None:
    with measuring_rig(tmp_path, faults) as rig:
        with pytest.raises(DriveInFault, match=why):
            rig.measure(cycles=500, enable=True)
        drive = rig.servos[0].drive
        assert drive.power.state is State.SWITCH_ON_DISABLED
        assert abs(drive.firmware.speed_rad_s) < 1.0


def test_the_command_leaves_with_3_and_names_the_mode(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(toml_text(LEAVES), encoding="utf-8")
    asked = [
        "measure",
        "--bus",
        "simulated",
        "--node",
        "1",
        "--enable",
        "--cycles",
        "500",
        "--faults",
        str(plan),
    ]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 3
    assert LEFT in done.stderr


def test_a_step_of_commissioning_ends_with_the_drive_at_rest(tmp_path: Path) -> None:
    servo, truth = unknown_drive(3, 1)
    plate = Nameplate.model_validate(truth.nameplate)
    request = CommissionRequest(bus="simulated", node=1, out=tmp_path, nameplate=plate)
    told: list[str] = []
    meddler = ForeignNode(TO_PV, 1.0, times=2000)
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 3), [servo]) as world:
        put_on_the_bus(world, meddler)
        commission(request, world, Dialog(told.append), EmergencyStop(), steps=lambda: all_steps()[:STEPS])
    assert any(LEFT in text for text in told), told
    assert servo.drive.power.state is State.SWITCH_ON_DISABLED
    assert abs(servo.drive.firmware.speed_rad_s) < 1.0
