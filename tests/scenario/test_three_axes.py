"""Three drives at 1 kHz on one bus."""

from hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES


def test_three_axes_keep_their_limits_on_one_bus(servo_bench: BenchRunner) -> None:
    run = servo_bench(EXAMPLES / "three_axes.toml")
    run.assert_passed()
    run.assert_no_unintended_frame()
    assert run.summary.cycles == 2000
    assert run.summary.dropouts.total == 0
    assert run.summary.bus_load_percent is not None
    assert 60.0 < run.summary.bus_load_percent < 75.0
