"""At the end of a run every shaft rests, seen from inside the drives, whatever load the bench asked for."""

import csv

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.rest import REST_RAD_S
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES
from tests.swarm.witness import DriveWitness, witnessed

LOADED = {
    "bench.duration_s": 0.4,
    "reference": {f"axis{n}": [{"at_s": 0.0, "kind": "step", "speed_rpm": 500.0}] for n in (1, 2, 3)},
    "load": {f"axis{n}": [{"at_s": 0.1, "torque_nm": 1.0}] for n in (1, 2, 3)},
}


def test_no_load_turns_the_shaft_of_a_drive_that_was_disabled(servo_bench: BenchRunner) -> None:
    witnesses: list[DriveWitness] = []
    with witnessed(witnesses):
        run = servo_bench(EXAMPLES / "three_axes.toml", LOADED)
    assert [drive.at_rest for drive in run.summary.drives] == [True] * 3
    told = [witness.testimony() for witness in witnesses]
    assert [drive.states[-1][1] for drive in told] == [State.SWITCH_ON_DISABLED] * 3
    assert max(abs(drive.speed_rad_s) for drive in told) < REST_RAD_S


def test_no_drive_runs_on_while_another_is_brought_to_rest(servo_bench: BenchRunner) -> None:
    witnesses: list[DriveWitness] = []
    with witnessed(witnesses):
        servo_bench(EXAMPLES / "three_axes.toml", LOADED)
    stopped_at = [
        next(at for at, state in witness.testimony().states if state is State.QUICK_STOP)
        for witness in witnesses
    ]
    assert max(stopped_at) - min(stopped_at) < 10 * NS_PER_MS


def test_a_drive_that_is_gone_does_not_keep_the_next_one_turning(servo_bench: BenchRunner) -> None:
    """Its heartbeat is missed, and it is asked in vain, for half a second a time."""
    witnesses: list[DriveWitness] = []
    silent = {"faults.silence": [{"nodes": [2], "at_s": 0.2, "duration_s": 10.0}], "bench.duration_s": 1.0}
    with witnessed(witnesses), pytest.raises(PeerFault):
        servo_bench(EXAMPLES / "three_axes.toml", LOADED | silent)
    stopped_at = [
        next(at for at, state in witness.testimony().states if state is State.QUICK_STOP)
        for witness in (witnesses[0], witnesses[2])
    ]
    assert max(stopped_at) - min(stopped_at) < 10 * NS_PER_MS


def test_rest_is_told_after_the_brake_of_an_instrument_was_seen_open(servo_bench: BenchRunner) -> None:
    still = {"bench.duration_s": 0.4, "reference": {}, "load.axis1": [{"at_s": 0.1, "torque_nm": 1.0}]}
    run = servo_bench(EXAMPLES / "load_machine.toml", still)
    (rested_ns,) = [event["at_ns"] for event in run.events if event.get("text") == "axis1: at rest"]
    with (run.folder / "load.csv").open() as file:
        *_, last = csv.DictReader(file)
    assert float(last["torque_nm"]) < 0.1
    assert float(last["at_ns"]) < rested_ns
