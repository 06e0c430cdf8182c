"""A host that stands still across the end of its run: what it did not see cannot have passed."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.scenario.processes import changed_bench, hub_name, loop_of, observer, simulated_drive, start_run
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
