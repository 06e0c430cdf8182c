"""Three drives at 1 kHz on one bus."""

from typing import Any

import pytest

from servobench.hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES

PRODUCER: dict[str, Any] = {
    "loop.sync": "foreign",
    "bus.background": [{"can_id": 0x080, "bytes_max": 0, "period_us": 1000}],
}


def test_three_axes_keep_their_limits_on_one_bus(servo_bench: BenchRunner) -> None:
    run = servo_bench(EXAMPLES / "three_axes.toml")
    run.assert_passed()
    run.assert_no_unintended_frame()
    assert run.summary.cycles == 2000
    assert run.summary.dropouts.total == 0
    assert 60.0 < (run.summary.bus_load_percent or 0.0) < 75.0


@pytest.mark.parametrize("changes", [{"loop.sync": "kernel"}, PRODUCER], ids=["kernel", "foreign"])
def test_three_axes_follow_the_syncs_of_others(servo_bench: BenchRunner, changes: dict[str, Any]) -> None:
    run = servo_bench(EXAMPLES / "three_axes.toml", changes)
    run.assert_passed()
    assert run.summary.dropouts.total == 0
    assert run.rows["certain"].all()
