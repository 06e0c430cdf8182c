"""Fault plans from the user's side: each example runs, leaves what it injected, and replays to the same."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput, BenchError, DriveInFault, PeerFault, PowerLost
from servobench.hil.cli import app
from servobench.hil.execution.bench import run_bench
from servobench.hil.pytest_plugin import StartDrive
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.draws import few_of
from tests.recorded_frames import candump_text, injected
from tests.scenario.processes import EXAMPLES

BENCH = EXAMPLES / "ling2012.toml"
PLANS = sorted(path.stem for path in (EXAMPLES / "faults").glob("*.toml"))
ENDS_IN_FAULT = {
    "drive_faults": "4310h",
    "encoder_loss": "7305h",
    "bus_off": "no usable reading",
    "safe_torque_off": "lost the power of its stage",
    "mode_change": "left cyclic synchronous torque for profile velocity",
    "ignored_commands": "ignores the commands",
}
INJECTED = {
    "adapter": {"full_queue", "link_down", "receive_overflow"},
    "demo": {"delay", "loss", "blackout"},
    "bursts": {"burst"},
    "every_third": {"periodic_loss", "blackout"},
    "jitter": {"delay"},
    "measured": {"delay"},
    "noise": {"error_frame", "duplicate", "reorder"},
    "outage": {"silence"},
    "bus_off": {"bus_off"},
    "drive_faults": {"drive_fault"},
    "encoder_loss": {"drive_fault"},
    "clocks": {"clock_step", "clock_drift"},
    "slow_drive": {"boot", "late"},
    "gateway": {"delay", "loss"},
    "host_stall": {"host_stall"},
    "lss": {"lss_yes_sayer"},
    "safe_torque_off": {"safe_torque_off"},
    "mode_change": {"mode_change"},
    "ignored_commands": {"ignored_commands"},
    "refused_mapping": {"refused_mapping"},
    "repeated_emergency": {"repeated_emergency"},
    "supply_sag": {"supply_sag"},
    "damage": {"chopper_off", "dragging_brake", "hot_motor", "dirty_encoder", "loose_coupling"},
    "signals": {"signal_noise", "signal_scale", "signal_offset", "signal_nowhere"},
}


def entries(folder: Path, *without: str) -> list[dict[str, Any]]:
    return [{key: value for key, value in entry.items() if key not in without} for entry in injected(folder)]


def test_every_example_is_looked_at_here() -> None:
    assert set(PLANS) == set(INJECTED)


@pytest.mark.parametrize("name", PLANS)
def test_each_example_runs_and_the_first_replay_to_the_same_digest(
    name: str, servo_bench: BenchRunner
) -> None:
    run = _attempt(name, servo_bench, EXAMPLES / "faults" / f"{name}.toml")
    kinds = {entry["kind"] for entry in entries(run.folder)}
    assert INJECTED[name] <= kinds
    if name not in few_of(PLANS, 8):
        return
    again = _attempt(name, servo_bench, run.folder / "faults.arrow")
    assert again.digest == run.digest
    assert entries(again.folder) == entries(run.folder)


def _attempt(name: str, servo_bench: BenchRunner, faults: Path) -> Run:
    """A run, also of a plan that is meant to end it."""
    if name not in ENDS_IN_FAULT:
        return servo_bench(BENCH, faults=faults)
    run = servo_bench(BENCH, faults=faults, ends_in=BenchError)
    assert run.error is not None
    assert ENDS_IN_FAULT[name] in str(run.error)
    assert run.error.exit_status == 3
    assert not run.summary.verdict.passed
    return run


def test_a_repeated_emergency_is_told_once_with_how_often_it_came(
    servo_bench: BenchRunner, tmp_path: Path
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text("[[repeated_emergency]]\nat_s = 0.1\ncode = 0x2310\nperiod_ms = 5\nduration_s = 0.2\n")
    run = servo_bench(BENCH, faults=plan)
    sent = candump_text(run.folder).count(" 081#1023")
    assert sent == pytest.approx(40, abs=2)
    (finding,) = [each for each in run.summary.verdict.findings if "EMCY" in each.text]
    assert re.search(rf"EMCY 2310h .* at 0\.10\d s, {sent} times until 0\.29\d s", finding.text)


EVERYTHING = """
[[loss]]
probability = 0.05
[[measured_delay]]
edges_us = [20, 60, 300]
counts = [9, 1]
[[reorder]]
probability = 0.05
held_us = 700
[[duplicate]]
probability = 0.05
later_us = 30
[[corruption]]
probability = 0.02
effect = "lost"
[[silence]]
at_s = 0.4
duration_s = 0.02
[[clock_step]]
probability_per_s = 0.9
step_min_us = -40
step_max_us = 40
[[slow_drive]]
boot_s = 0.2
sdo_delay_min_us = 100
sdo_delay_max_us = 900
tpdo_delay_min_us = 10
tpdo_delay_max_us = 60
"""


def test_a_replay_with_another_seed_still_injects_the_same(servo_bench: BenchRunner) -> None:
    """The seed still decides what else is random: where the drive's clock starts."""
    short = {"bench.duration_s": 0.8, "load.axis1.0.at_s": 0.5}
    plan = tomllib.loads(EVERYTHING)
    first = servo_bench(BENCH, short, faults=plan)
    recorded = first.folder / "faults.arrow"
    again = servo_bench(BENCH, short, faults=recorded)
    other = servo_bench(BENCH, short, faults=recorded, seed=99)
    drawn = servo_bench(BENCH, short, faults=plan, seed=99)
    assert again.digest == first.digest
    assert {other.summary.seed, drawn.summary.seed} == {99}

    def told(run: Run) -> list[str]:
        return sorted(map(str, entries(run.folder, "at_ns")))

    assert told(other) == told(first) != told(drawn)
    assert {entry["kind"] for entry in entries(first.folder)} == {
        *("loss", "delay", "reorder", "duplicate", "corruption", "silence", "clock_step", "boot", "late")
    }


def test_the_command_line_replays_and_the_folder_of_a_run_runs_again(tmp_path: Path) -> None:
    text = BENCH.read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    path = tmp_path / "bench.toml"
    path.write_text(
        text.replace("faults/demo.toml", f"{EXAMPLES}/faults/noise.toml").replace(
            "duration_s = 2.0", "duration_s = 1.2"
        )
    )
    record = [str(tmp_path / name) for name in "abcd"]
    digests = []
    for arguments in (
        [str(path), "--record", record[0]],
        [str(path), "--record", record[1], "--replay-faults", f"{record[0]}/faults.jsonl"],
        [f"{record[1]}/bench.toml", "--record", record[2]],
        [str(path), "--record", record[3], "--replay-faults", f"{record[0]}/faults.arrow"],
    ):
        if record[1] in arguments:
            written = CliRunner().invoke(app, ["export", record[0], "--to", "jsonl", "--json"])
            assert json.loads(written.stdout)["rows"] == len(injected(Path(record[0]))) > 100
        done = CliRunner().invoke(app, ["run", *arguments, "--json"])
        digests.append(json.loads(done.stdout)["digest"])
    assert len(set(digests)) == 1


def test_a_file_to_replay_that_is_not_there_is_named(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["run", str(EXAMPLES / "ling2012.toml"), "--replay-faults", str(tmp_path / "faults.jsonl")]
    )
    assert done.exit_code == 2
    assert "--replay-faults" in done.stderr


@pytest.mark.parametrize(
    ("plan", "remedy"),
    [
        ("outage", "hil simulate --faults"),
        ("gateway", "hil simulate --faults"),
        ("host_stall", "--bus simulated"),
    ],
)
def test_faults_that_cannot_act_on_a_real_time_bus_are_refused_with_what_to_do(
    plan: str, remedy: str, servo_bench: BenchRunner, tmp_path: Path
) -> None:
    config = servo_bench.load(BENCH, faults=EXAMPLES / "faults" / f"{plan}.toml")
    with pytest.raises(BadInput, match=remedy):
        run_bench(
            config,
            bus_spec="virtual:0",
            record=tmp_path / "r",
        )


def test_a_drive_without_torque_ends_a_run_by_an_end_of_its_own(servo_bench: BenchRunner) -> None:
    plan = EXAMPLES / "faults" / "safe_torque_off.toml"
    run = servo_bench(BENCH, faults=plan, ends_in=PowerLost)
    assert not [event for event in run.events if "EMCY" in event.get("text", "")], "it is no fault"
    told = [event for event in run.events if "lost the power of its stage" in event.get("text", "")]
    assert told
    assert "safe torque off: 60FDh shows an interlock" in told[0]["text"]
    (drive,) = run.summary.drives
    assert drive.at_rest


def test_a_drive_fault_names_itself_in_the_error(servo_bench: BenchRunner) -> None:
    with pytest.raises(DriveInFault, match="excess temperature of the drive"):
        servo_bench(BENCH, faults=EXAMPLES / "faults" / "drive_faults.toml")


AT_THE_DRIVE = """
[[slow_drive]]
boot_s = 0.3
sdo_delay_us = 800
[[loss]]
direction = "drive_to_host"
probability = 0.05
[[drive_fault]]
fault = "over_current"
at_s = 3.5
"""


@pytest.mark.xdist_group("real time")
@pytest.mark.servo_bus("hub")
def test_a_plan_acts_at_the_drives_side_of_a_real_time_bus(
    servo_bench: BenchRunner, servo_process: StartDrive
) -> None:
    """However late the bench comes: it ends by the fault, or finds it there."""
    servo_process(1, faults=tomllib.loads(AT_THE_DRIVE))
    run = servo_bench(EXAMPLES / "any_bus.toml", ends_in=PeerFault)
    assert "2310h (continuous over-current)" in str(run.error)
