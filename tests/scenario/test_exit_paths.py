"""Every way out of a run ends with the drive at rest; shown with processes on a hub."""

import json
import signal
from pathlib import Path

import pytest

from drivers.profile402 import State
from drivers.timebase import NS_PER_S
from tests.scenario.processes import hub_name, long_bench, observer, simulated_drive, start_run

TURNING_RAD_S = 90.0
HEARTBEAT_TIMEOUT_S = 0.5
"""Of examples/any_bus.toml."""
QUICK_STOP_S = 104.7 / 1250.0
"""1000 r/min at the simulated drive's default 6085h for [Ling2012]'s motor: 0.5 * 2 N m / 0.0008 kg m^2."""
MARGIN_S = 1.0
"""For two shared cores; the heartbeat's and the ramp's time are what counts."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stop_signal_ends_in_rest_with_the_recording_whole(tmp_path: Path, number: signal.Signals) -> None:
    bus = hub_name(number.name.lower())
    folder = tmp_path / "run"
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(long_bench(tmp_path), bus, folder)
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        process.send_signal(number)
        out, said = process.communicate(timeout=20)
        assert watching.time_to_rest(at, QUICK_STOP_S + MARGIN_S) > 0
        assert watching.state() is State.SWITCH_ON_DISABLED
    assert process.returncode == 1, said
    summary = json.loads(out)
    assert summary["verdict"]["reason"] == f"ended by {number.name}"
    assert not summary["verdict"]["passed"]
    assert (folder / "run.rrd").stat().st_size > 0
    assert json.loads((folder / "summary.json").read_text())["cycles"] == summary["cycles"] > 0


def test_a_killed_controller_leaves_the_drive_to_its_own_heartbeat_consumer(tmp_path: Path) -> None:
    bus = hub_name("kill")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(long_bench(tmp_path), bus, tmp_path / "run")
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        process.kill()
        took = watching.time_to_rest(at, HEARTBEAT_TIMEOUT_S + QUICK_STOP_S + MARGIN_S)
        assert took > 0.05 * NS_PER_S, "it stopped before it could have known"
        assert watching.state() is not State.OPERATION_ENABLED
        process.communicate(timeout=20)


def test_a_stopped_controller_is_a_lost_host_too(tmp_path: Path) -> None:
    bus = hub_name("stop")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(long_bench(tmp_path), bus, tmp_path / "run")
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        process.send_signal(signal.SIGSTOP)
        try:
            watching.time_to_rest(at, HEARTBEAT_TIMEOUT_S + QUICK_STOP_S + MARGIN_S)
        finally:
            process.send_signal(signal.SIGCONT)
        _, said = process.communicate(timeout=20)
        assert process.returncode == 3, said
        assert watching.state() is not State.OPERATION_ENABLED


def test_a_drive_that_dies_ends_the_run_with_a_named_fault(tmp_path: Path) -> None:
    bus = hub_name("dies")
    folder = tmp_path / "run"
    with simulated_drive(bus) as drive, observer(bus) as watching:
        process = start_run(long_bench(tmp_path), bus, folder)
        watching.until_turning(TURNING_RAD_S)
        drive.kill()
        out, said = process.communicate(timeout=20)
    assert process.returncode == 3
    assert out == ""
    assert "axis1" in said
    assert "Traceback" not in said
    assert json.loads((folder / "summary.json").read_text())["verdict"]["completed"] is False


def test_a_lost_bus_ends_the_run_and_the_drive_process(tmp_path: Path) -> None:
    bus = hub_name("lost")
    with simulated_drive(bus) as drive:
        with observer(bus) as watching:
            process = start_run(long_bench(tmp_path), bus, tmp_path / "run")
            watching.until_turning(TURNING_RAD_S)
        broker_pid(bus.removeprefix("hub:"))
        _, said = process.communicate(timeout=20)
        assert process.returncode == 3, said
        assert "Traceback" not in said
        assert drive.wait(timeout=20) == 3


def broker_pid(name: str) -> None:
    """Kill the broker process of a hub, as a pulled cable would end the bus for all."""
    import os

    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        words = (entry / "cmdline").read_bytes().split(b"\0")
        if b"virtual_bus.can_bus.hub_broker" in b" ".join(words) and name.encode() in words:
            os.kill(int(entry.name), signal.SIGKILL)
            return
    raise AssertionError(f"hub {name} has no broker")
