"""What the verdict of a run counts."""

from hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES


def test_the_settling_time_decides_which_errors_count(servo_bench: BenchRunner) -> None:
    short = {"bench.duration_s": 0.6, "load": {}}
    peaks = [
        servo_bench(
            EXAMPLES / "ling2012.toml", {**short, "verdict.settling_ms": settling_ms}
        ).summary.speed_error.peak_percent
        for settling_ms in (0, 250)
    ]
    assert peaks[0] is not None
    assert peaks[1] is not None
    assert peaks[0] > 90.0, "the step itself"
    assert peaks[1] < 10.0
