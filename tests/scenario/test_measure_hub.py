"""``hil measure`` as a process beside a drive's, on the hub."""

import json
from pathlib import Path

import pytest

from servobench.drivers.cia402.profile import State
from servobench.hil.pytest_plugin import StartDrive
from tests.scenario.processes import observer, run_command
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")

CYCLES = 200
PERIOD_US = 10_000


@pytest.mark.servo_bus("hub")
def test_a_drive_of_another_process_is_measured_and_left_as_it_was(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path
) -> None:
    """600 us behind the bus, where no echo tells of them."""
    late = {"direction": "host_to_drive", "frames": ["pdo"], "delay_us": 600}
    drive = servo_process(1, faults={"delay": [late]})
    out = tmp_path / "network.toml"
    options = [
        "--cycles",
        str(CYCLES),
        "--period-us",
        str(PERIOD_US),
        "--enable",
        "--out",
        str(out),
        "--json",
    ]
    with observer(servo_bus) as watching:
        done = run_command([*hil(), "measure", "--bus", servo_bus, "--node", "1", *options])
        assert done.returncode == 0, done.stderr
        assert watching.state() is State.SWITCH_ON_DISABLED
    found = json.loads(done.stdout)
    assert found["echoes"] == "bus"
    (node,) = found["drives"]
    # The hub loses nothing; what is later than two periods, on two shared cores, is given up.
    assert node["losses"]["readings"]["percent"] < 5.0
    assert node["losses"]["commands"]["percent"] < 5.0
    stages = {**found["host"], **node["stages"]}
    assert all(stage["measured"] for stage in stages.values())
    assert stages["wake_up"]["p50_us"] > 0.0
    # Later than told by what the drive's process takes to wake: two shared cores.
    assert 590.0 < stages["command_acting"]["p50_us"] < 2000.0
    assert node["clock"]["drift_error_ppm"] < 10.0
    assert out.exists()
    assert drive.stop() == 0
