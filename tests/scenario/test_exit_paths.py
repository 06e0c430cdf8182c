"""Every way out of a run ends with the drive at rest; shown with processes on a hub."""

import json
import os
import signal
from pathlib import Path

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.pytest_plugin import StartDrive
from tests.draws import few_of
from tests.scenario.processes import broker_of, changed_bench, long_bench, loop_of, observer, start_run
from tests.warm.start import hil

pytestmark = [pytest.mark.servo_bus("hub"), pytest.mark.xdist_group("real time")]

TURNING_RAD_S = 90.0
HEARTBEAT_TIMEOUT_S = 0.5
"""Of examples/any_bus.toml."""
QUICK_STOP_S = 104.7 / 1250.0
"""1000 r/min at the simulated drive's default 6085h for [Ling2012]'s motor: 0.5 * 2 N m / 0.0008 kg m^2."""
MARGIN_S = 1.0
"""For two shared cores; the heartbeat's and the ramp's time are what counts."""


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is looked at."""


@pytest.mark.parametrize("number", few_of([signal.SIGTERM, signal.SIGINT, signal.SIGHUP], 1))
def test_a_stop_signal_ends_in_rest_with_the_recording_whole(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path, number: signal.Signals
) -> None:
    folder = tmp_path / "run"
    servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(long_bench(tmp_path), servo_bus, folder, by=hil())
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        process.send_signal(number)
        out, said = process.communicate(timeout=20)
        assert watching.time_to_rest(at, QUICK_STOP_S + MARGIN_S) > 0
        assert watching.state() is State.SWITCH_ON_DISABLED
    assert process.returncode == 130, said
    summary = json.loads(out)
    assert summary["verdict"]["reason"] == f"ended by {number.name}"
    assert not summary["verdict"]["passed"]
    assert (folder / "run.rrd").stat().st_size > 0
    assert json.loads((folder / "summary.json").read_text())["cycles"] == summary["cycles"] > 0


def test_a_stop_signal_is_heard_while_no_drive_answers(servo_bus: str, tmp_path: Path) -> None:
    bench = changed_bench(tmp_path, connect_timeout_s=60.0)
    process = start_run(bench, servo_bus, tmp_path / "run", by=hil())
    assert process.stderr is not None
    assert process.stderr.readline() == "connecting\n"
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=20)
    assert process.returncode == 130, said
    told = json.loads(out)
    assert (told["verdict"]["outcome"], told["verdict"]["exit_status"]) == ("interrupted", 130)
    assert (told["cycles"], told["bus_load_percent"]) == (0, None)
    assert "ended by SIGINT" in said


def test_a_killed_controller_leaves_the_drive_to_its_own_heartbeat_consumer(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path
) -> None:
    servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(long_bench(tmp_path), servo_bus, tmp_path / "run")
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        process.kill()
        took = watching.time_to_rest(at, HEARTBEAT_TIMEOUT_S + QUICK_STOP_S + MARGIN_S)
        assert took > 0.05 * NS_PER_S, "it stopped before it could have known"
        assert watching.state() is not State.OPERATION_ENABLED
        process.communicate(timeout=20)


def test_a_stopped_controller_is_a_lost_host_too(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path
) -> None:
    servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(long_bench(tmp_path), servo_bus, tmp_path / "run")
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        loop = loop_of(process.pid)
        os.kill(loop, signal.SIGSTOP)
        try:
            watching.time_to_rest(at, HEARTBEAT_TIMEOUT_S + QUICK_STOP_S + MARGIN_S)
        finally:
            os.kill(loop, signal.SIGCONT)
        _, said = process.communicate(timeout=20)
        assert process.returncode == 3, said
        assert watching.state() is not State.OPERATION_ENABLED


def test_a_drive_that_dies_ends_the_run_with_a_named_fault(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    drive = servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(long_bench(tmp_path), servo_bus, folder, by=hil())
        watching.until_turning(TURNING_RAD_S)
        drive.kill()
        out, said = process.communicate(timeout=20)
    assert process.returncode == 3
    assert "axis1" in said
    assert "Traceback" not in said
    told = json.loads(out)
    assert told == json.loads((folder / "summary.json").read_text())
    verdict, (drive_end,) = told["verdict"], told["drives"]
    assert (verdict["exit_status"], verdict["completed"]) == (3, False)
    assert {check["result"] for check in verdict["limits"]} == {"not measured"}
    assert (drive_end["after_last_cycle"], drive_end["at_rest"]) == (None, False)


def test_a_lost_bus_ends_the_run_and_the_drive_process(
    servo_bus: str, servo_process: StartDrive, tmp_path: Path
) -> None:
    drive = servo_process(1)
    with observer(servo_bus) as watching:
        process = start_run(long_bench(tmp_path), servo_bus, tmp_path / "run", by=hil())
        watching.until_turning(TURNING_RAD_S)
    os.kill(broker_of(servo_bus), signal.SIGKILL)  # as a pulled cable ends the bus for all
    _, said = process.communicate(timeout=20)
    assert process.returncode == 3, said
    assert "Traceback" not in said
    assert drive.wait(20.0) == 3
