"""A bench over a serial adapter: the drive on a hub, the host on an emulated SLCAN adapter's serial port."""

import json
import os
import signal
from pathlib import Path

import pytest

from servobench.drivers.cia402.profile import State
from tests.scenario.processes import EXAMPLES, hub_name, long_bench, observer, run, simulated_drive, start_run
from tests.scenario.serial_processes import adapter_process
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")

TURNING_RAD_S = 90.0
HEARTBEAT_TIMEOUT_S = 0.5
"""Of examples/any_bus.toml."""
QUICK_STOP_S = 104.7 / 1250.0
MARGIN_S = 1.0


def test_the_bench_that_runs_on_any_bus_passes_over_serial(tmp_path: Path) -> None:
    bus = hub_name("serial")
    link = tmp_path / "can-adapter"
    with simulated_drive(bus), adapter_process(bus, "--link", str(link)) as adapter:
        assert adapter.port == str(link)
        assert os.readlink(link).startswith("/dev/pts/")
        status, summary, _ = run(EXAMPLES / "any_bus.toml", adapter.bus, tmp_path / "run")
    assert status == 0, json.dumps(summary["verdict"])
    assert not link.is_symlink(), "the link outlived the adapter"


def test_spoilt_lines_cost_frames_and_nothing_else(tmp_path: Path) -> None:
    bus = hub_name("spoilt")
    faults = ["garble=0.005", "truncate=0.005", "noise=0.01", "lose=0.003", "baud=230400"]
    options = [word for fault in faults for word in ("--fault", fault)]
    with simulated_drive(bus), adapter_process(bus, *options, "--seed", "7") as adapter:
        status, summary, said = run(EXAMPLES / "any_bus.toml", adapter.bus, tmp_path / "run")
    # a line with a digit spoilt can be a frame that nobody sent: 4, disturbed
    assert status in (0, 1, 4), said
    assert summary["verdict"]["completed"], said
    assert 0 < sum(summary["dropouts"].values()) < 0.3 * summary["cycles"]
    assert "spoilt lines from the adapter" in (tmp_path / "run" / "events.jsonl").read_text()


def test_an_adapter_pulled_out_in_mid_run_is_a_named_fault_and_the_drive_stops_by_itself(
    tmp_path: Path,
) -> None:
    bus = hub_name("pulled")
    with simulated_drive(bus), observer(bus) as watching, adapter_process(bus) as adapter:
        process = start_run(long_bench(tmp_path), adapter.bus, tmp_path / "run", by=hil())
        watching.until_turning(TURNING_RAD_S)
        at = watching.now()
        adapter.pull_out()
        watching.time_to_rest(at, HEARTBEAT_TIMEOUT_S + QUICK_STOP_S + MARGIN_S)
        assert watching.state() is not State.OPERATION_ENABLED
        out, said = process.communicate(timeout=20)
    assert process.returncode == 3, said
    assert json.loads(out)["verdict"]["exit_status"] == 3
    assert "the adapter was unplugged" in said
    assert adapter.bus in said
    assert "Traceback" not in said
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["verdict"]["completed"] is False


def test_an_adapter_stopped_by_ctrl_c_ends_like_an_unplugged_one(tmp_path: Path) -> None:
    bus = hub_name("ended")
    with simulated_drive(bus), observer(bus) as watching, adapter_process(bus) as adapter:
        process = start_run(long_bench(tmp_path), adapter.bus, tmp_path / "run", by=hil())
        watching.until_turning(TURNING_RAD_S)
        adapter.process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=20)
        assert process.returncode == 3, said
        assert "the adapter was unplugged" in said
        assert adapter.process.wait(20) == 0
