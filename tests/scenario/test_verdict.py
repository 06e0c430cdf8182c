"""What the verdict of a run counts, and what keeps it from being passed."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from servobench import Command, Context, Controller, SetPoint, TorqueSetPoint
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.errors import BadInput, DriveInFault
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.simulated_drives import simulated_drives
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.verdict.verdict import LimitResult, VerdictKind
from servobench.virtual_bus.drive.servo import SimulatedServo
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


BENCH = EXAMPLES / "ling2012.toml"
SHORT = {"bench.duration_s": 0.6, "load": {}, "verdict": {"dropouts_percent_max": 50.0}}
NO_LIMITS = SHORT | {"verdict": {}}
BLIND = {"drive.axis1.simulation.lacks": ["1016", "100C", "1400:5"], "drive.axis1.unwatched": True}
"""A drive that does not notice that its host is gone."""


def stall(at_s: float, late_us: int) -> dict[str, object]:
    return {"host_stall": [{"at_s": at_s, "late_us": late_us}]}


@pytest.mark.parametrize("changes", [SHORT, NO_LIMITS])
def test_a_drive_that_stopped_itself_while_the_host_was_away_at_the_end_is_found(
    servo_bench: BenchRunner, changes: dict[str, object]
) -> None:
    run = servo_bench(BENCH, changes, faults=stall(0.58, 4_000_000), ends_in=DriveInFault)
    verdict = run.summary.verdict
    assert (verdict.outcome, verdict.exit_status) == (VerdictKind.PEER_FAULT, 3)
    assert any("EMCY 8130h" in text and "at 0." in text for text in verdict.of(VerdictKind.PEER_FAULT))
    assert not verdict.completed
    assert all(check.result is LimitResult.NOT_MEASURED for check in verdict.limits)
    assert run.summary.dropouts.missed == 20, "the cycles are accounted for all the same"


@pytest.mark.parametrize("changes", [SHORT, NO_LIMITS])
def test_a_host_that_was_away_at_the_end_does_not_pass_with_a_drive_that_did_not_notice(
    servo_bench: BenchRunner, changes: dict[str, object]
) -> None:
    run = servo_bench(BENCH, changes | BLIND, faults=stall(0.58, 4_000_000))
    verdict = run.summary.verdict
    assert (verdict.outcome, verdict.exit_status) == (VerdictKind.CUT_SHORT, 6)
    assert "came back 398" in verdict.reason
    (drive,) = run.summary.drives
    assert drive.after_last_cycle == "operation enabled"
    assert drive.at_rest
    with pytest.raises(AssertionError, match=rf"cut short: the host [^|]*\nrecording: {run.folder}$"):
        run.assert_passed()


def test_missed_cycles_are_judged_by_limits_and_without_any_not_let_pass(servo_bench: BenchRunner) -> None:
    runs = [servo_bench(BENCH, changes, faults=stall(0.3, 5_000)) for changes in (SHORT, NO_LIMITS)]
    assert [run.summary.dropouts.missed for run in runs] == [5, 5]
    assert [run.summary.verdict.outcome for run in runs] == [VerdictKind.PASSED, VerdictKind.NOT_MEASURED]
    assert runs[1].summary.verdict.exit_status == 6


def test_of_a_run_without_limits_nothing_was_asked(servo_bench: BenchRunner) -> None:
    run = servo_bench(BENCH, NO_LIMITS, faults={})
    verdict = run.summary.verdict
    assert (verdict.outcome, verdict.exit_status, verdict.passed) == (VerdictKind.NOTHING_ASKED, 0, False)
    with pytest.raises(AssertionError, match="no limit in"):
        run.assert_passed()


def test_a_drive_that_fails_behind_the_last_cycle_is_found(servo_bench: BenchRunner) -> None:
    """Its fault comes with the last SYNC: no command is computed any more that would look at it."""
    fault = {"drive_fault": [{"nodes": [1], "fault": "over_temperature", "at_s": 0.5998}]}
    run = servo_bench(BENCH, SHORT, faults=fault, ends_in=DriveInFault)
    verdict = run.summary.verdict
    assert verdict.exit_status == 3
    assert len(verdict.findings) == 1, "the EMCY is the plan's own"
    assert run.summary.cycles == 600


class Still(Controller):
    """A controller that asks for no torque."""

    def output(self, _context: Context) -> SetPoint:
        return TorqueSetPoint(0.0)


class Warned(Still):
    """Sees to it that the drive sends a warning in the tenth cycle: an EMCY, and it goes on."""

    def __init__(self, drives: list[SimulatedServo]) -> None:
        self._drives = drives
        self._cycles = 0

    def update(self, _context: Context, _command: Command) -> None:
        self._cycles += 1
        if self._cycles == 10:
            self._drives[0].raise_error(0x3110, ErrorRegister.VOLTAGE | ErrorRegister.GENERIC)


def test_an_emcy_that_nobody_planned_keeps_a_run_from_passing(
    servo_bench: BenchRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    drives: list[SimulatedServo] = []

    def made(config: BenchConfig) -> list[SimulatedServo]:
        drives[:] = simulated_drives(config)
        return drives

    monkeypatch.setattr("servobench.hil.execution.simulated_drives.simulated_drives", made)
    run = servo_bench(BENCH, SHORT, faults={}, controllers={"axis1": Warned(drives)})
    verdict = run.summary.verdict
    assert (verdict.outcome, verdict.exit_status) == (VerdictKind.PEER_FAULT, 3)
    assert verdict.reason.startswith("axis1: EMCY 3110h")
    assert verdict.reason.endswith("at 0.010 s")
    assert verdict.completed
    assert run.summary.cycles == 600


def test_a_limit_on_what_the_run_never_did_is_not_measured(servo_bench: BenchRunner) -> None:
    run = servo_bench(BENCH, SHORT | {"verdict": {"after_load_percent_max": 5.0}}, faults={})
    (check,) = run.summary.verdict.limits
    assert (check.value, check.result) == (None, LimitResult.NOT_MEASURED)
    assert (run.summary.verdict.outcome, run.summary.verdict.exit_status) == (VerdictKind.NOT_MEASURED, 6)


def test_a_controller_for_an_axis_that_is_not_there_is_refused(servo_bench: BenchRunner) -> None:
    with pytest.raises(BadInput, match="controllers: found 'axsi1', expected one of the bench's axes: axis1"):
        servo_bench(BENCH, SHORT, controllers={"axsi1": Still()})


def test_a_bench_runs_in_any_thread(servo_bench: BenchRunner) -> None:
    here = servo_bench(BENCH, SHORT)
    with ThreadPoolExecutor(1) as pool:
        there = pool.submit(servo_bench, BENCH, SHORT).result()
    assert there.digest == here.digest
    assert there.summary.verdict.passed
