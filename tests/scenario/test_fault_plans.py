"""Fault plans from the user's side: each example runs, leaves what it injected, and replays to the same."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from drivers.errors import BadInput, BenchError, DriveInFault
from hil.bench import run_bench
from hil.cli import app
from hil.configuration.bench_file import load_bench, load_faults
from hil.terminal.progress import no_progress
from tests.scenario.two_processes import run_bench as run_at
from tests.scenario.two_processes import simulated_drive

EXAMPLES = Path(__file__).parents[2] / "examples"
PLANS = sorted(path.stem for path in (EXAMPLES / "faults").glob("*.toml"))
ENDS_IN_FAULT = {"drive_faults": "4310h", "encoder_loss": "7305h", "bus_off": "no usable reading"}
INJECTED = {
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
}


def bench(folder: Path, faults: str, duration_s: float = 2.0) -> Path:
    """The example bench with another fault plan, as a file."""
    text = (EXAMPLES / "ling2012.toml").read_text()
    text = text.replace('"motors/', f'"{EXAMPLES}/motors/').replace("faults/demo.toml", faults)
    path = folder / "bench.toml"
    path.write_text(text.replace("duration_s = 2.0", f"duration_s = {duration_s}"))
    return path


def run(path: Path, record: Path, seed: int | None = None, replay: Path | None = None) -> dict[str, Any]:
    config = load_bench(path)
    if replay is not None:
        config = config.with_faults(load_faults(replay))
    result = run_bench(
        config, bus_spec=None, time=None, seed=seed, record=record, view=False, progress=no_progress
    )
    return result.summary


def entries(folder: Path, *without: str) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in (folder / "faults.jsonl").read_text().splitlines()]
    return [{key: value for key, value in entry.items() if key not in without} for entry in found]


def test_every_example_is_looked_at_here() -> None:
    assert set(PLANS) == set(INJECTED)


@pytest.mark.parametrize("name", PLANS)
def test_each_example_runs_and_replays_to_the_same_digest(name: str, tmp_path: Path) -> None:
    path = bench(tmp_path, f"{EXAMPLES}/faults/{name}.toml")
    summary = _attempt(name, path, tmp_path / "a")
    kinds = {entry["kind"] for entry in entries(tmp_path / "a")}
    assert INJECTED[name] <= kinds
    again = _attempt(name, path, tmp_path / "b", replay=tmp_path / "a" / "faults.jsonl")
    assert again["digest"] == summary["digest"]
    assert entries(tmp_path / "b") == entries(tmp_path / "a")


def _attempt(name: str, path: Path, record: Path, replay: Path | None = None) -> dict[str, Any]:
    """The summary, also of a run that the plan is meant to end."""
    if name not in ENDS_IN_FAULT:
        return run(path, record, replay=replay)
    with pytest.raises(BenchError, match=ENDS_IN_FAULT[name]) as caught:
        run(path, record, replay=replay)
    assert caught.value.exit_status == 3
    found: dict[str, Any] = json.loads((record / "summary.json").read_text())
    assert found["verdict"]["passed"] is False
    return found


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


def test_a_replay_with_another_seed_still_injects_the_same(tmp_path: Path) -> None:
    """The seed still decides what else is random: where the drive's clock starts."""
    (tmp_path / "plan.toml").write_text(EVERYTHING)
    path = bench(tmp_path, "plan.toml", duration_s=0.8)
    path.write_text(path.read_text().replace("at_s = 1.0", "at_s = 0.5"))
    first = run(path, tmp_path / "a")
    again = run(path, tmp_path / "b", replay=tmp_path / "a" / "faults.jsonl")
    other = run(path, tmp_path / "c", seed=99, replay=tmp_path / "a" / "faults.jsonl")
    drawn = run(path, tmp_path / "d", seed=99)
    assert again["digest"] == first["digest"]
    assert {other["seed"], drawn["seed"]} == {99}

    def injected(name: str) -> list[str]:
        return sorted(map(str, entries(tmp_path / name, "at_ns")))

    assert injected("c") == injected("a") != injected("d")
    assert {entry["kind"] for entry in entries(tmp_path / "a")} == {
        *("loss", "delay", "reorder", "duplicate", "corruption", "silence", "clock_step", "boot", "late")
    }


def test_the_command_line_replays_and_the_folder_of_a_run_runs_again(tmp_path: Path) -> None:
    path = bench(tmp_path, f"{EXAMPLES}/faults/noise.toml", duration_s=1.2)
    record = [str(tmp_path / name) for name in "abc"]
    digests = []
    for arguments in (
        [str(path), "--record", record[0]],
        [str(path), "--record", record[1], "--replay-faults", f"{record[0]}/faults.jsonl"],
        [f"{record[1]}/bench.toml", "--record", record[2]],
    ):
        done = CliRunner().invoke(app, ["run", *arguments, "--json"])
        digests.append(json.loads(done.stdout)["digest"])
    assert len(set(digests)) == 1


def test_a_file_to_replay_that_is_not_there_is_named(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["run", str(EXAMPLES / "ling2012.toml"), "--replay-faults", str(tmp_path / "faults.jsonl")]
    )
    assert done.exit_code == 2
    assert "--replay-faults" in done.stderr


def test_faults_of_nodes_are_refused_where_the_nodes_are_not_simulated(tmp_path: Path) -> None:
    config = load_bench(bench(tmp_path, f"{EXAMPLES}/faults/outage.toml"))
    with pytest.raises(BadInput, match="hil simulate --faults"):
        run_bench(
            config,
            bus_spec="virtual:0",
            time=None,
            seed=None,
            record=tmp_path / "r",
            view=False,
            progress=no_progress,
        )


def test_a_drive_fault_names_itself_in_the_error(tmp_path: Path) -> None:
    with pytest.raises(DriveInFault, match="excess temperature of the drive"):
        run(bench(tmp_path, f"{EXAMPLES}/faults/drive_faults.toml"), tmp_path / "r")


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


def test_a_plan_acts_at_the_drives_side_of_a_real_time_bus(tmp_path: Path) -> None:
    """However late the bench comes: it ends by the fault, or finds it there."""
    plan = tmp_path / "plan.toml"
    plan.write_text(AT_THE_DRIVE)
    spec = f"hub:faults-{os.getpid()}"
    with simulated_drive(spec, "--faults", str(plan)):
        status, _, messages = run_at(spec, tmp_path / "r")
    assert status == 3
    assert "2310h (continuous over-current)" in messages
