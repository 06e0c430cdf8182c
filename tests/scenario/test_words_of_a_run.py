"""One run that loses readings and commands: every door gives the same figure under the same word.

The witness is the fault injector's log of the frames that it lost, counted in plain Python by their cycles.
"""

import json
import tomllib
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.recording.run_metadata import read_summary
from servobench.hil.testing.run import Run
from tests.recorded_frames import injected
from tests.scenario.test_lost_samples_certified import bench

READING, COMMAND = 0x181, 0x201
PERIOD_NS, CYCLES = 1_000_000, 1_000
CERTIFIED: Final = 5
"""Losses in a row, of the predictor."""
LOST: Final = [
    {"direction": "drive_to_host", "frames": [READING], "probability": 0.4},
    {"direction": "host_to_drive", "frames": [COMMAND], "probability": 0.3},
]


class Recorded(NamedTuple):
    """A run, and what its injector lost."""

    folder: Path
    printed: str
    readings: int
    """Lost in a row."""
    commands: int


def told(*arguments: object) -> Any:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    return json.loads(done.stdout)


def longest(lost: list[bool]) -> int:
    return max((len(list(group)) for gone, group in groupby(lost) if gone), default=0)


def lost_cycles(folder: Path, can_id: int) -> list[bool]:
    cycles = {line["at_ns"] // PERIOD_NS for line in injected(folder) if line["can_id"] == can_id}
    return [cycle in cycles for cycle in range(CYCLES)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("words")
    path = folder / "bench.toml"
    tables = {**bench("predictor", 1), "faults": {"loss": LOST}}
    path.write_text(toml_text(tables))
    done = CliRunner().invoke(app, ["run", str(path), "--allow-uncertified", "--record", str(folder / "run")])
    assert done.exit_code == 0, done.output
    readings, commands = (longest(lost_cycles(folder / "run", each)) for each in (READING, COMMAND))
    assert readings > CERTIFIED
    assert commands > 2
    assert readings != commands
    return Recorded(folder / "run", done.output, readings, commands)


def test_losses_in_a_row_are_those_of_the_injector_at_every_door(run: Recorded) -> None:
    apart = {
        "reading_losses_in_a_row": run.readings,
        "command_losses_in_a_row": run.commands,
        "command_losses_in_a_row_least": run.commands,
    }
    summary = json.loads((run.folder / "summary.json").read_text())
    reviewed = told("review", run.folder)
    for door in (summary, reviewed):
        assert {key: door[key] for key in apart} == apart
        both = {
            "certified": CERTIFIED,
            "seen": run.readings + run.commands,
            "seen_at_most": run.readings + run.commands,
        }
        assert door["certificates"]["axis1"]["losses_together"] == both
    network = tomllib.loads((run.folder / "network.toml").read_text())["network"]
    assert network["losses_in_a_row_max"] == len(network["losses_in_a_row"]) == run.readings
    assert network["command_losses_in_a_row_max"] == run.commands
    for compared in told("compare", run.folder, run.folder)["runs"]:
        figures = compared["figures"]
        assert [figures[key] for key in list(apart)[:2]] == [run.readings, run.commands]
    assert f"Lost in a row    {run.readings} readings, {run.commands} commands " in run.printed


def test_the_pytest_api_bounds_readings_lost_in_a_row_by_the_same_count(run: Recorded) -> None:
    of_test = Run(load_bench(run.folder / "bench.toml"), run.folder)
    of_test.assert_dropouts_handled(in_a_row_max=run.readings)
    with pytest.raises(AssertionError, match=f"{run.readings} readings lost in a row"):
        of_test.assert_dropouts_handled(in_a_row_max=run.readings - 1)
    assert of_test.summary.reading_losses_in_a_row == run.readings


def test_the_warning_tells_the_first_count_beyond_the_certified_one(run: Recorded) -> None:
    summary = read_summary(run.folder)
    assert [note for note in summary.network_notes if "in a row" in note] == [
        f"axis1: the network is worse than its controller's: {CERTIFIED + 1} readings lost in a row, "
        f"made for at most {CERTIFIED} readings and commands"
    ]
    (left,) = [text for text in summary.certificates["axis1"]["premises_left"] if text.startswith("losses:")]
    both = run.readings + run.commands
    assert left == f"losses: {both} in a row, readings and commands together, made for at most {CERTIFIED}"


def test_both_delays_are_the_same_at_every_door(run: Recorded) -> None:
    summary, reviewed = json.loads((run.folder / "summary.json").read_text()), told("review", run.folder)
    network = tomllib.loads((run.folder / "network.toml").read_text())["network"]
    figures = told("compare", run.folder, run.folder)["runs"][0]["figures"]
    for name in ("reading_delay_us", "action_delay_us", "action_delay_least_us"):
        assert summary[name] == reviewed[name]
        assert {key: network[name][key] for key in summary[name]} == pytest.approx(summary[name], abs=0.1)
    for name in ("reading_delay", "action_delay"):
        assert figures[f"{name}_p99_us"] == summary[f"{name}_us"]["p99"]
    certified = summary["certificates"]["axis1"]["action_delay_us"]
    assert certified["seen"] == summary["action_delay_least_us"]["max"]
    assert certified["seen_at_most"] == summary["action_delay_us"]["max"]
    assert summary["reading_delay_us"]["max"] < 200 < summary["action_delay_us"]["p50"]


def test_a_summary_with_the_keys_of_before_is_read(run: Recorded, tmp_path: Path) -> None:
    plain = json.loads((run.folder / "summary.json").read_text())
    whole = read_summary(run.folder)
    plain["delay_us"], plain["losses_in_a_row"] = (
        plain.pop("reading_delay_us"),
        plain.pop("reading_losses_in_a_row"),
    )
    for key in (
        "action_delay_us",
        "action_delay_least_us",
        "command_losses_in_a_row",
        "command_losses_in_a_row_least",
    ):
        del plain[key]
    (tmp_path / "summary.json").write_text(json.dumps(plain))
    old = read_summary(tmp_path)
    assert old.reading_delay_us == whole.reading_delay_us
    assert (old.reading_losses_in_a_row, old.command_losses_in_a_row) == (run.readings, None)
