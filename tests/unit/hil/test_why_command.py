"""``hil why``: the guilty cycles and frames of a run that did not pass, as records and trace have them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app
from servobench.hil.loop.cycle_record import FATE_SAMPLE
from servobench.hil.recorded.explanation import Bursts, brief
from servobench.hil.recorded.judgement import judge_run
from servobench.hil.recorded.recorded_run import open_run
from servobench.hil.rows.records_file import read_records
from tests.told import ROOT
from tests.unit.hil.recorded_runs import short_run

pytestmark = pytest.mark.usefixtures("forked_children")

EXAMPLES = ROOT / "examples"
HALF = "[verdict]\ndropouts_percent_max = 50.0\n"
LIMITS = """
[verdict]
overshoot_percent_max = 10.0
settling_time_ms_max = 100.0
speed_error_peak_percent_max = 2.0
dropouts_percent_max = 1.0
delay_p99_us_max = 100.0
"""


def hil(*arguments: object) -> Result:
    without_display = {"DISPLAY": None, "WAYLAND_DISPLAY": None}
    return CliRunner().invoke(app, [str(each) for each in arguments], env=without_display)


def bench_file(folder: Path, limits: str, faults: str = "") -> Path:
    """The example with a blackout of 30 ms in a step."""
    text = (EXAMPLES / "blackout.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    path = folder / "bench.toml"
    path.write_text(text.partition("[verdict]")[0] + faults + limits)
    return path


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run that broke three limits, and what its command printed."""
    folder = tmp_path_factory.mktemp("why")
    ended = hil("run", bench_file(folder, LIMITS), "--record", folder / "run")
    assert ended.exit_code == 1, ended.output
    return folder / "run", ended.stdout


def explained(run: Path, *more: str) -> dict[str, Any]:
    ended = hil("why", run, "--json", *more)
    told: dict[str, Any] = json.loads(ended.stdout)
    assert ended.exit_code == told["exit_status"]
    return told


def test_the_guilty_cycles_are_those_of_the_records(ran: tuple[Path, str]) -> None:
    run, _ = ran
    told = explained(run)
    assert (told["exit_status"], told["verdict"], told["notes"]) == (1, "not passed", [])
    rows = next(batch for batch in read_records(run / "records.arrow") if batch.size)
    lost = rows[rows["fate"] != FATE_SAMPLE]
    first, last = int(lost["sequence"][0]), int(lost["sequence"][-1])
    assert last - first + 1 == lost.size == 30
    (place,) = [each for each in told["places"] if "dropouts [%]: 5, at most 1" in each["told"]]
    assert f"axis1: no reading in cycles {first} to {last} (30 lost)" in place["told"]
    shown = [each["sequence"] for each in place["cycles"] if each["fate"] == "lost"]
    assert shown == lost["sequence"].tolist()
    around = {each["sequence"] for each in place["cycles"]}
    assert {first - 50, last + 50} <= around
    assert any("injected from here: blackout" in line for line in place["before"])


def test_the_limits_that_are_told_are_those_of_the_review(ran: tuple[Path, str]) -> None:
    run, _ = ran
    limits = json.loads(hil("review", run, "--json").stdout)["verdict"]["limits"]
    told = [text for place in explained(run)["places"] for text in place["told"]]
    for check in limits:
        value = f": {check['value']:.4g}, at most {check['limit']:g}"
        assert any(value in text for text in told) == (check["result"] == "broken"), check
    (overshoot,) = [each["at_ns"] for each in limits if each["metric"].startswith("overshoot")]
    assert explained(run)["places"][0]["begin_s"] == overshoot / 1e9


def test_the_frames_are_those_of_the_trace(ran: tuple[Path, str]) -> None:
    run, _ = ran
    for place in explained(run)["places"]:
        times = ["--from", repr(place["begin_s"] - 0.05), "--to", repr(place["end_s"] + 0.05)]
        traced = [json.loads(line) for line in hil("trace", run, "--json", *times).stdout.splitlines()]
        assert place["frames"] == traced
        assert len(traced) > 100


def test_a_reader_sees_cycles_frames_and_the_commands_that_open_them(ran: tuple[Path, str]) -> None:
    run, _ = ran
    lines = hil("why", run).stdout.splitlines()
    assert lines[0] == "NOT PASSED"
    (burst,) = [line for line in lines if "no reading in cycles" in line]
    first = int(burst.split("cycles ")[1].split()[0])
    guilty = [int(line.split()[2]) for line in lines if line.startswith(" > ")]
    assert first in guilty
    assert any(f"{first - 2}" in line.split() for line in lines if line.startswith("   axis1"))
    assert any(line.startswith(f"   hil view {run} --at 0.1") for line in lines)
    assert any(line.startswith(f"   hil trace {run} --from 0.0") for line in lines)
    assert any(" heartbeat " in line for line in lines)
    everything = hil("why", run, "--all").stdout.splitlines()
    assert len(everything) > 1000 > 150 > len(lines)


@pytest.mark.long
def test_the_end_of_a_run_that_did_not_pass_says_it_in_short(ran: tuple[Path, str], tmp_path: Path) -> None:
    run, printed = ran
    why = [line for line in printed.splitlines() if line.startswith("Why ")]
    assert "axis1: overshoot of a step [%]: 50.9" in why[0]
    assert why[-1] == f"Why        hil why {run} shows the guilty cycles and frames"
    assert any("seen: " in line and "injected from here: blackout" in line for line in printed.splitlines())
    passed = hil("run", bench_file(tmp_path, HALF), "--record", tmp_path / "run")
    assert (passed.exit_code, "Why " in passed.stdout) == (0, False)
    fine = hil("why", tmp_path / "run")
    assert fine.exit_code == 0
    assert "no reading in cycles" in fine.stdout, "a burst is worth telling all the same"


@pytest.mark.long
def test_a_drive_fault_is_found_by_its_time(tmp_path: Path) -> None:
    fault = '[[faults.drive_fault]]\nnodes = [1]\nat_s = 0.3\nfault = "over_temperature"\n\n'
    ended = hil("run", bench_file(tmp_path, HALF, fault), "--record", tmp_path / "run")
    assert ended.exit_code == 3, ended.output
    told = explained(tmp_path / "run")
    assert told["exit_status"] == 3
    (place,) = [each for each in told["places"] if "bus, drive or safety" in " ".join(each["told"])]
    assert place["begin_s"] == pytest.approx(0.3, abs=0.01)
    assert any(frame["kind"] == "emcy" for frame in place["frames"])
    assert any("injected" in line for line in place["before"])
    summary = judge_run(open_run(tmp_path / "run")).summary
    other = replace(summary.verdict.findings[0], text="what no event tells")
    unplaced = replace(summary, verdict=replace(summary.verdict, findings=(other,)))
    short = brief(unplaced, tmp_path / "run")
    assert short.places == (), "the fault of the drive is an ERROR among the events, and another matter"
    assert [text for text in short.elsewhere if "what no event tells" in text] != []


def test_other_limits_have_places_of_their_own(ran: tuple[Path, str], tmp_path: Path) -> None:
    run, _ = ran
    (tmp_path / "limits.toml").write_text("[verdict]\nspeed_error_peak_percent_max = 0.001\n")
    told = explained(run, "--against", str(tmp_path / "limits.toml"))
    assert any("speed error, peak [%]" in text for place in told["places"] for text in place["told"])
    assert not any("overshoot" in text for place in told["places"] for text in place["told"])


@pytest.mark.long
def test_nothing_went_wrong_with_a_run_that_passed(tmp_path: Path) -> None:
    (tmp_path / "limits.toml").write_text("[verdict]\nlosses_in_a_row_max = 20\n")
    ended = hil("why", short_run(tmp_path / "run"), "--against", tmp_path / "limits.toml")
    assert ended.exit_code == 0
    assert ended.stdout.splitlines()[0] == "PASSED"


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    assert hil("why", tmp_path).exit_code == 2


def test_a_viewer_is_told_where_to_open(ran: tuple[Path, str]) -> None:
    run, _ = ran
    ended = hil("view", run, "--at", "0.11", "--span", "0.1")
    assert f"hil picture {run} page.png --at 0.11 --span 0.1" in ended.stderr
    refused = hil("view", run, "--span", "0.1")
    assert (refused.exit_code, "--at beside it" in refused.stderr) == (2, True)


def test_bursts_go_over_the_borders_of_batches(ran: tuple[Path, str]) -> None:
    run, _ = ran
    rows = next(batch for batch in read_records(run / "records.arrow") if batch.size)
    whole, parts = Bursts(["axis1"]), Bursts(["axis1"])
    whole.add(rows)
    for begin in range(0, rows.size, 7):
        parts.add(rows[begin : begin + 7])
    assert parts.found() == whole.found()
    assert [burst.cycles for burst in whole.found()] == [30]
