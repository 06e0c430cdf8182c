"""``hil runs``: whole, killed, running, damaged, old and later recordings, each told as what it is."""

import fcntl
import json
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from typer.testing import CliRunner, Result

from servobench.drivers.timebase import Instant
from servobench.hil.cli import app
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.rows.run_files import FORMAT, RECORDS_FILE
from servobench.hil.verdict.verdict import VerdictKind
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records

BENCH = '[bench]\nname = "{0}"\n[drive.a]\nnode = 1\n[drive.a.controller]\nkind = "{1}"\n'
DRIVE = "Maker X (vendor 00000001h, product 00000002h, serial 3)"


def listed(*arguments: str) -> list[dict[str, Any]]:
    result = runs(*arguments, "--json")
    assert result.exit_code == 0, result.output
    found: list[dict[str, Any]] = json.loads(result.stdout)["runs"]
    return found


def runs(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["runs", *arguments])


def make(
    folder: Path, name: str, at: datetime, verdict: str = "passed", kind: str = "pid", commit: str = "abc123"
) -> Path:
    """A recording in real time with ten rows."""
    folder.mkdir(parents=True)
    (folder / "bench.toml").write_text(BENCH.format(name, kind))
    summary = {"cycles": 10, "verdict": {"outcome": verdict, "reason": ""}}
    (folder / "summary.json").write_text(json.dumps(summary))
    writer = RecordsWriter(folder / RECORDS_FILE)
    epoch_ns = int(at.timestamp()) * 10**9
    told = {"bench": name, "commit": commit, "drives": json.dumps({"a": DRIVE}), "time": "real"}
    writer.begin({**told, "first_cycle_epoch_ns": str(epoch_ns), "bus": "hub:x"}, Instant(0))
    writer.write(rows_of(synthetic_records(10)))
    writer.close()
    return sealed(folder)


def sealed(folder: Path) -> Path:
    """With a seal over what is in it now."""
    Sealer(folder).finish()
    return folder


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Three whole recordings on three days, not in order of their names, one in a folder of its own."""
    make(tmp_path / "c", "first", datetime(2026, 1, 1, tzinfo=UTC))
    make(tmp_path / "day" / "a", "second", datetime(2026, 1, 2, tzinfo=UTC), "not passed", "hinf", "def456")
    make(tmp_path / "b", "third", datetime(2026, 1, 3, tzinfo=UTC), "cut short")
    (tmp_path / "no recording").mkdir()
    (tmp_path / "no recording" / "bench.toml").write_text(BENCH.format("x", "pid"))
    return tmp_path


def test_they_are_listed_by_time_with_what_they_are(lab: Path) -> None:
    found = listed(str(lab))
    assert [run["bench"] for run in found] == ["first", "second", "third"]
    assert found[1] == {
        "path": str(lab / "day" / "a"),
        "at": "2026-01-02T00:00:00+00:00", "state": "whole", "bench": "second",
        "drives": [DRIVE], "controllers": ["hinf"], "verdict": "not passed", "reason": "", "cycles": 10,
        "commit": "def456", "servobench": "", "bus": "hub:x", "note": "",
        "seal": "sealed",
    }  # fmt: skip
    lines = runs(str(lab)).stdout.splitlines()
    assert lines[0].split() == ["time", "bench", "verdict", "controller", "drive", "commit", "recording"]
    assert [line.split()[-1] for line in lines[1:]] == [run["path"] for run in found]
    assert "Maker X " in lines[2]
    assert "vendor" not in lines[2]


@pytest.mark.parametrize(
    ("arguments", "benches"),
    [
        (["--bench", "IR"], ["first", "third"]),
        (["--verdict", "not"], ["second"]),
        (["--verdict", "cut short"], ["third"]),
        (["--controller", "hinf"], ["second"]),
        (["--drive", "maker x"], ["first", "second", "third"]),
        (["--drive", "maker y"], []),
        (["--commit", "def"], ["second"]),
        (["--since", "2026-01-01T12:00"], ["second", "third"]),
        (["--since", "2027-01-01"], []),
    ],
)
def test_they_are_chosen_by(lab: Path, arguments: list[str], benches: list[str]) -> None:
    assert [run["bench"] for run in listed(str(lab), *arguments)] == benches


def test_nothing_below_a_recording_and_nothing_deep_down_is_looked_at(lab: Path) -> None:
    make(lab / "c" / "inside", "inside", datetime(2026, 1, 4, tzinfo=UTC))
    make(lab.joinpath(*"123456"), "deep", datetime(2026, 1, 5, tzinfo=UTC))
    make(lab.joinpath(*"1234567"), "too deep", datetime(2026, 1, 6, tzinfo=UTC))
    assert [run["bench"] for run in listed(str(lab))] == ["first", "second", "third", "deep"]


def test_who_asks_for_passed_is_not_shown_what_passed_disturbed(lab: Path) -> None:
    for kind, found in (VerdictKind.PASSED, True), (VerdictKind.PASSED_DISTURBED, False):
        outcome = {"cycles": 1, "verdict": {"outcome": kind.value}}
        (lab / "c" / "summary.json").write_text(json.dumps(outcome))
        sealed(lab / "c")
        assert ("first" in [run["bench"] for run in listed(str(lab), "--verdict", "Passed")]) is found


def test_every_verdict_can_be_asked_for(lab: Path) -> None:
    for kind in VerdictKind:
        path = lab / "c" / "summary.json"
        path.write_text(json.dumps({"cycles": 1, "verdict": {"outcome": kind.value}}))
        sealed(path.parent)
        assert "first" in [run["bench"] for run in listed(str(lab), "--verdict", kind.value)]


def test_a_run_whose_recorder_was_killed_is_told_with_the_remedy(lab: Path) -> None:
    killed = lab / "c"
    (killed / "summary.json").unlink()
    whole = (killed / RECORDS_FILE).read_bytes()
    (killed / RECORDS_FILE).write_bytes(whole[: len(whole) // 2])
    run = listed(str(lab), "--verdict", "no summary")[0]
    assert (run["state"], run["bench"], run["verdict"]) == ("no summary", "first", "")
    assert run["note"].endswith(f"hil recover {killed}")
    assert f"hil recover {killed}" in runs(str(lab)).stderr
    (killed / "summary.json").write_text('{"cycles": 1')
    assert listed(str(lab))[0]["state"] == "no summary"


def test_a_run_that_goes_on_is_no_killed_one(lab: Path) -> None:
    (lab / "c" / "summary.json").unlink()
    descriptor = os.open(lab / "c" / ".reserve", os.O_RDWR | os.O_CREAT)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        assert (listed(str(lab))[0]["state"], listed(str(lab))[0]["note"]) == ("being recorded", "")
    finally:
        os.close(descriptor)
    assert listed(str(lab))[0]["state"] == "no summary"


def test_damaged_files_are_told_and_stop_nothing(lab: Path) -> None:
    whole = (lab / "c" / RECORDS_FILE).read_bytes()
    for content, note in ((whole[:-10], "has no end"), (b"", "has no end"), (None, "is missing")):
        (lab / "c" / RECORDS_FILE).unlink(missing_ok=True)
        if content is not None:
            (lab / "c" / RECORDS_FILE).write_bytes(content)
        (run,) = listed(str(lab), "--verdict", "damaged")
        assert (run["verdict"], note in run["note"], run["bench"]) == ("", True, "first")
    for name in ("bench.toml", "summary.json", RECORDS_FILE):
        (lab / "c" / name).write_bytes(b"\xff\x00[")
    assert len(listed(str(lab))) == 3


def test_a_later_format_is_told_by_its_number_and_an_earlier_one_is_read(lab: Path) -> None:
    for name, number in (("c", "1"), ("b", str(int(FORMAT) + 1))):
        path = lab / name / RECORDS_FILE
        table = pa.ipc.open_file(path).read_all()
        changed = table.replace_schema_metadata({**table.schema.metadata, b"format": number.encode()})
        with pa.ipc.new_file(path, changed.schema) as sink:
            sink.write_table(changed)
        if name == "b":
            sealed(lab / name)
        else:
            (lab / name / "seal").unlink()
    found = listed(str(lab))
    assert [run["state"] for run in found] == ["whole", "whole", "later format"]
    assert found[0]["seal"] == "unsealed: recorded by an older version"
    assert found[2]["note"] == f"format {int(FORMAT) + 1}: expected a recording of format {FORMAT} or earlier"


def test_a_run_in_simulated_time_has_the_time_of_its_bench_file(lab: Path) -> None:
    table = pa.ipc.open_file(lab / "c" / RECORDS_FILE).read_all()
    changed = table.replace_schema_metadata({**table.schema.metadata, b"time": b"simulated"})
    with pa.ipc.new_file(lab / "c" / RECORDS_FILE, changed.schema) as sink:
        sink.write_table(changed)
    at = datetime(2026, 5, 4, tzinfo=UTC).timestamp()
    os.utime(lab / "c" / "bench.toml", (at, at))
    assert listed(str(lab))[-1]["at"] == "2026-05-04T00:00:00+00:00"


def test_what_the_recording_lacks_is_told(lab: Path) -> None:
    summary = {
        "cycles": 10,
        "verdict": {"outcome": "not recorded"},
        "recording_faults": ["the disk was full"],
    }
    (lab / "c" / "summary.json").write_text(json.dumps(summary))
    sealed(lab / "c")
    assert listed(str(lab))[0]["note"] == "the disk was full"


def test_a_run_that_was_altered_has_no_verdict_unless_it_is_asked_for(lab: Path) -> None:
    (lab / "c" / "summary.json").write_text('{"cycles": 10, "verdict": {"outcome": "passed", "reason": "!"}}')
    assert [run["bench"] for run in listed(str(lab), "--verdict", "passed")] == []
    (run,) = listed(str(lab), "--verdict", "damaged")
    assert (run["verdict"], run["reason"], run["cycles"]) == ("", "", None)
    assert run["note"].startswith(f"{lab / 'c' / 'summary.json'}: bytes 0 to ")
    (run,) = listed(str(lab), "--verdict", "passed", "--unsealed")
    assert (run["state"], run["seal"]) == ("whole", "unsealed: requested by --unsealed")


def test_no_folder_is_refused_and_an_empty_one_is_not(tmp_path: Path) -> None:
    assert runs(str(tmp_path / "none")).exit_code == 2
    assert listed(str(tmp_path)) == []
    shutil.rmtree(tmp_path)
