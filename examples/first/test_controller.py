"""What the controller promises, tried on a simulated drive: run ``pytest``."""

from pathlib import Path

from servobench import BenchError

BENCH = Path(__file__).parent / "bench.toml"


def test_speed_settles_after_the_ramp_and_after_the_load(servo_bench):
    run = servo_bench(BENCH)
    run.assert_passed()
    run.assert_settles(within_s=0.25, band_percent=2)


def test_lost_readings_are_lived_with(servo_bench):
    run = servo_bench(BENCH, faults={"loss": [{"probability": 0.05, "direction": "drive_to_host"}]})
    run.assert_dropouts_handled(at_least=10)
    run.assert_settles(within_s=0.3, band_percent=3)


def test_a_drive_that_falls_silent_ends_the_run(servo_bench):
    faults = {"silence": [{"nodes": [1], "at_s": 0.5, "duration_s": 1.0}]}
    servo_bench(BENCH, faults=faults, ends_in=BenchError)  # at rest: a run that leaves a drive moving fails
