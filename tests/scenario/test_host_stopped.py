"""A host that stands still: what it did not see cannot have passed, and the run tells for how long it did."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.draws import few_of
from tests.scenario.processes import (
    changed_bench,
    family_of,
    hub_name,
    loop_of,
    observer,
    simulated_drive,
    start_run,
)
from tests.stillness import Untrue

pytestmark = pytest.mark.xdist_group("real time")

DURATION_S, STOPPED_S = 2.0, 4.0
LEFT_S = 0.8
"""Of the run when the host stops; time enough for a test that is late itself."""


def test_a_host_stopped_across_the_end_never_passes(tmp_path: Path) -> None:
    """Nothing was asked: each limit would only be one more reason not to pass."""
    bench = changed_bench(tmp_path, duration_s=DURATION_S, dropouts_consecutive_max=1000)
    text = bench.read_text(encoding="utf-8")
    bench.write_text(text.partition("[verdict]")[0], encoding="utf-8")
    bus = hub_name("stopped")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(bench, bus, tmp_path / "run")
        watching.until_turning(50.0)  # rad/s: 0.44 s after the run began
        watching.wait(DURATION_S - 0.44 - LEFT_S)
        loop = loop_of(process.pid)
        os.kill(loop, signal.SIGSTOP)
        watching.wait(STOPPED_S)
        speed_rad_s = watching.velocity_rad_s()
        os.kill(loop, signal.SIGCONT)
        out, said = process.communicate(timeout=60)
    assert abs(speed_rad_s) < 1.0, "the drive stopped itself"
    told = json.loads(out)
    verdict = told["verdict"]
    if process.returncode == 0 or verdict["completed"]:
        raise Untrue(out)
    assert process.returncode == verdict["exit_status"] == 3, (out, said)
    assert told["dropouts"]["missed"] > 10
    assert told == json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("stopped_s", "status"),
    few_of([pytest.param(0.5, 0, id="within the drive's watchdog"), pytest.param(4.0, 3, id="beyond it")], 1),
)
def test_a_machine_that_is_suspended_is_named(tmp_path: Path, stopped_s: float, status: int) -> None:
    """Bench and logger stand still together; drive and bus do not. Two seconds of silence are borne."""
    bench = changed_bench(tmp_path, duration_s=5.0, dropouts_consecutive_max=200)
    text = bench.read_text(encoding="utf-8").replace("timeout_ms = 500", "timeout_ms = 2000")
    bench.write_text(f"{text.partition('[verdict]')[0]}[verdict]\ndropouts_percent_max = 100.0\n", "utf-8")
    bus = hub_name("suspended")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(bench, bus, tmp_path / "run")
        watching.until_turning(50.0)
        processes = family_of(process.pid)
        for number in (signal.SIGSTOP, signal.SIGCONT):
            for each in processes:
                os.kill(each, number)
            watching.wait(stopped_s if number == signal.SIGSTOP else 0.0)
        at_rest = abs(watching.velocity_rad_s()) < 1.0
        out, said = process.communicate(timeout=60)
    assert process.returncode == status, (out, said)
    assert at_rest is (status == 3), "the drive stops itself, and only then"
    told = json.loads(out)
    assert told["dropouts"]["missed"] >= (stopped_s - 0.1) * 100 / (1 + status), "100 Hz"
    assert told["verdict"]["completed"] is (status == 0)
    events = (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8")
    assert "this host stood still for" in events
    assert ("prevent it from being suspended or stopped" in said) is (status == 3)
