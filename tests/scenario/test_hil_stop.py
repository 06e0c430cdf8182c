"""``hil stop`` beside a run of another process."""

import json
from pathlib import Path

import pytest

from servobench.drivers.cia402.profile import State
from tests.scenario.processes import (
    hub_name,
    long_bench,
    observer,
    run_command,
    simulated_drive,
    start_run,
)
from tests.warm.start import hil


@pytest.mark.xdist_group("real time")
def test_a_run_in_another_process_ends_at_rest_and_says_why(tmp_path: Path) -> None:
    bus = hub_name("stop")
    with simulated_drive(bus):
        process = start_run(long_bench(tmp_path), bus, tmp_path / "run", by=hil())
        with observer(bus) as watching:
            watching.until_turning(20.0)
        done = run_command([*hil(), "stop", "--bus", bus, "--json"])
        out, said = process.communicate(timeout=30)
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        assert told["at_rest"] is True
        assert [node["node"] for node in told["nodes"]] == [1]
        with observer(bus) as watching:  # another, which has no answers to others in its queue
            assert abs(watching.velocity_rad_s()) < 1.0
            assert watching.state() is State.SWITCH_ON_DISABLED
    assert process.returncode == 3, said
    summary = json.loads(out)
    (drive,) = summary["drives"]
    assert drive["at_rest"] is True
    events = (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8")
    assert "fell out of operation" in events
