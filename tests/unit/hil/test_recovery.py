"""``hil recover``, after host and logger were killed at once: what is in the files counts."""

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.drivers.timebase import Instant
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.recording import rerun_anew
from servobench.hil.recording.log_files import EventsKeeper, RecordsKeeper
from servobench.hil.recording.run_metadata import Reserve
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.records_file import read_records
from servobench.hil.rows.side_rows import FRAME_DTYPE, BeginEvent, StateEvent
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary
from tests.recorded_frames import candump_text
from tests.rrd_columns import columns, numbers
from tests.stillness import Witness
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_telemetry import RPM

pytestmark = pytest.mark.long

TRIES = 3

BENCH = Path(__file__).parents[3] / "examples" / "ling2012.toml"
PERIOD_S = 0.001
CYCLES = 1_500
WRITER = """
import os, signal, sys, time
from dataclasses import replace
from pathlib import Path
from servobench.drivers.timebase import Instant
from servobench.hil.recording.recorder import start_recording
from tests.rrd_columns import columns, numbers
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.synthetic_run import synthetic_records

plan = replace(plan_for(Path(sys.argv[1]), real_time=True), bench_toml=Path(sys.argv[2]).read_text())
recorder = start_recording(plan)
recorder.begin(Instant(0))
began = time.monotonic()
for number, record in enumerate(synthetic_records(int(sys.argv[3]))):
    time.sleep(max(0.0, began + number * float(sys.argv[4]) - time.monotonic()))
    recorder.record(record)
    recorder.tap().frame("tx", 0x80, b"", False, False, record.due_at)
os.kill(recorder.logger_process_id, signal.SIGKILL)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 1.5 s at 1 kHz whose logger and loop were killed in the same instant.

    Where other work kept the logger waiting its last rows say nothing: it is run again, three times in all.
    """
    witness = Witness()
    for _ in range(TRIES):
        folder = tmp_path_factory.mktemp("runs") / "run"
        resolved = folder.with_name("resolved.toml")
        resolved.write_text(load_bench(BENCH).resolved_text())
        arguments = [str(folder), str(resolved), str(CYCLES), str(PERIOD_S)]
        witness.begin()
        writer = subprocess.run([sys.executable, "-c", WRITER, *arguments], check=False)
        assert writer.returncode == -signal.SIGKILL
        assert not (folder / "summary.json").exists()
        if not witness.late_ms():
            break
    witness.stop()
    return folder


@pytest.fixture
def run(killed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(killed, tmp_path / "run"))


def recover(folder: Path, *options: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["recover", str(folder), *options])
    return result.exit_code, result.output


def test_all_but_the_last_200_ms_are_there(run: Path) -> None:
    status, said = recover(run, "--json")
    assert status == 0, said
    summary = from_plain(Summary, json.loads(said))
    assert summary == from_plain(Summary, json.loads((run / "summary.json").read_text()))
    rows = np.concatenate(list(read_records(run / "records.arrow")))
    wanted = [record.sequence for record in synthetic_records(CYCLES)]
    assert rows["sequence"].tolist() == wanted[: rows.size]
    assert CYCLES - rows.size <= 0.2 / PERIOD_S
    assert summary.cycles == rows.size
    frames = candump_text(run)
    assert CYCLES - frames.count("\n") <= 0.2 / PERIOD_S
    assert frames.endswith("\n")
    assert not (run / "records.tail").exists()
    assert not (run / ".reserve").exists()


def test_events_of_a_logger_that_had_only_begun_the_records_are_put_into_run_time(tmp_path: Path) -> None:
    """Killed between the two: the events count from the start of the bench, and lack the first cycle."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "bench.toml").write_text(load_bench(BENCH).resolved_text())
    plan = replace(plan_for(folder), started_at=Instant(1_000))
    records, events = RecordsKeeper(plan, folder), EventsKeeper(plan, folder)
    no_rows, no_frames = np.empty(0, ROW_DTYPE), np.empty(0, FRAME_DTYPE)
    events.take(no_rows, no_frames, [StateEvent(Instant(201_000), "phase", "enabling")])
    records.take(no_rows, no_frames, [BeginEvent(Instant(301_000))])
    records.take(rows_of(synthetic_records(10, origin=301_000)), no_frames, [])
    assert recover(folder)[0] == 0
    told = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    assert told == [{"at_ns": -100_000, "track": "phase", "state": "enabling"}, {"at_ns": 0, "begin": True}]


@pytest.mark.parametrize("left", ["logger.log", "seal", ".reserve"])
def test_a_run_that_was_killed_before_its_first_row_is_ended(tmp_path: Path, left: str) -> None:
    """What its logger makes first shows that a run began; a bench file alone does not."""
    (tmp_path / "bench.toml").write_text(load_bench(BENCH).resolved_text())
    assert recover(tmp_path)[0] == 2
    (tmp_path / left).touch()
    status, said = recover(tmp_path, "--json")
    assert status == 0
    assert json.loads(said)["cycles"] == 0


def test_run_rrd_is_made_anew_from_the_other_files(run: Path) -> None:
    before = json.loads(recover(run, "--json")[1])
    rows = np.concatenate(list(read_records(run / "records.arrow")))
    times, reference = numbers(run / "run.rrd", "/axis1/speed/reference")
    np.testing.assert_array_equal(times, rows["due_at"])
    np.testing.assert_allclose(reference, rows["reference_rad_s"] * RPM)
    (((shown,),),) = [columns(run / "run.rrd", "/summary", "TextDocument:text")[1]]
    assert json.loads(str(shown)) == before
    assert not any("run.rrd" in fault for fault in before["recording_faults"])
    assert not (run / "run.rrd.part").exists()


def test_run_rrd_is_left_alone_where_there_is_no_room_for_it(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = (run / "run.rrd").read_bytes()
    monkeypatch.setattr(rerun_anew, "ROOM_BYTES", 1 << 60)
    assert recover(run)[0] == 0
    faults = json.loads((run / "summary.json").read_text())["recording_faults"]
    assert any(fault.startswith("run.rrd has no verdict") for fault in faults)
    assert (run / "run.rrd").read_bytes() == there


def test_the_verdict_says_what_is_missing(run: Path) -> None:
    status, said = recover(run)
    assert status == 0, said
    summary = from_plain(Summary, json.loads((run / "summary.json").read_text()))
    assert not summary.verdict.passed
    assert not summary.verdict.completed
    assert summary.verdict.reason.startswith("the end of the run is not known")
    assert f"{summary.cycles} of 2000 planned cycles are recorded" in summary.recording_faults
    assert summary.bus_load_percent is None
    assert "planned cycles are recorded" in " ".join(said.split())


def test_half_entries_are_cut_off_and_a_torn_batch_is_made_up_for(run: Path) -> None:
    records = run / "records.arrow"
    with open(records, "ab") as file:
        file.write(b"\xff\xff\xff\xff\x40\0\0\0half a batch")
    with open(run / "frames.arrow", "ab") as frames:
        frames.write(b"\xff\xff\xff\xff\x40\0\0\0half a batch")
    before = (run / "records.tail").stat().st_size
    assert before > 24, "some rows are in no batch yet"
    assert recover(run)[0] == 0
    rows = np.concatenate(list(read_records(records)))
    assert CYCLES - rows.size <= 0.2 / PERIOD_S
    assert candump_text(run).endswith("080#\n")


def test_a_whole_recording_is_not_touched(run: Path) -> None:
    assert recover(run)[0] == 0
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    status, said = recover(run)
    assert status == 2
    assert "this one is whole" in said
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


def test_a_run_that_is_still_recorded_is_not_touched(run: Path) -> None:
    logger = Reserve(run)
    status, said = recover(run)
    assert status == 2
    assert "its logger still writes" in said
    assert not (run / "summary.json").exists()
    logger.close()


def test_another_folder_is_bad_input(tmp_path: Path) -> None:
    status, said = recover(tmp_path)
    assert status == 2
    assert "the folder of a recording" in said
