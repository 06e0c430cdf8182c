"""A drive that falls into a fault ends the run, and what came before stands in the run's folder."""

from servobench.drivers.errors import DriveInFault
from servobench.hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES

FAULT = {"drive_fault": [{"nodes": [1], "fault": "over_current", "at_s": 0.1}]}


def test_the_error_and_the_folder_tell_what_happened(servo_bench: BenchRunner) -> None:
    changes = {"bench.duration_s": 0.5, "verdict": {}, "load": {}}
    run = servo_bench(EXAMPLES / "ling2012.toml", changes, faults=FAULT, ends_in=DriveInFault)
    error = str(run.error)
    assert "is in fault" in error
    assert "error code 2310h (continuous over-current)" in error
    assert "EMCY 2310h (continuous over-current), register 03h (generic, current)" in error
    report = (run.folder / "fault.txt").read_text()
    assert error in report
    emergencies, _, frames = report.partition("The last")
    assert "node 1: EMCY 2310h" in emergencies
    assert "EMCY of node 1, 2310h continuous over-current" in frames
    assert "TPDO1 of node 1" in frames
