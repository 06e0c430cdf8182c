"""The writer's side, with the real logger process behind it."""

import io
import json
import os
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.record import replaced
from servobench.drivers.timebase import Instant
from servobench.hil.recording.recorder import ROWS_CAPACITY, Recorder, new_folder, start_recording
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.records_file import read_records
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import VerdictKind
from tests.recorded_frames import candump_text, directions
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import record_of
from tests.unit.hil.synthetic_run import synthetic_records

pytestmark = pytest.mark.long

CYCLES = 500


def play(recorder: Recorder | MemoryRecorder, cycles: int = CYCLES) -> Summary:
    """A short run, with what a loop would say of it."""
    tap = recorder.tap()
    recorder.event(Instant(-5), "INFO", "set up")
    recorder.begin(Instant(0))
    for record in synthetic_records(cycles):
        recorder.record(record)
        tap.frame("tx", 0x80, b"", False, False, record.due_at)
        tap.frame("rx", 0x181, b"\x37\x16", False, False, record.due_at)
    recorder.state(Instant(3), "phase", "stop")
    return recorder.close(whole_outcome(CYCLES))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Summary]:
    folder = tmp_path_factory.mktemp("runs") / "made" / "new"
    return folder, play(start_recording(plan_for(folder)))


def test_both_recorders_give_the_same_summary(run: tuple[Path, Summary]) -> None:
    folder, summary = run
    in_memory = play(MemoryRecorder(plan_for(folder)))
    assert summary == replace(in_memory, recording=str(folder))
    assert summary.cycles == CYCLES
    assert summary.verdict.passed


def test_a_run_of_which_nothing_is_kept_has_the_same_figures(
    run: tuple[Path, Summary], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    recorder = start_recording(replace(plan_for(tmp_path), folder=None))
    recorder.confirm(lambda: None)
    assert play(recorder) == replace(run[1], recording="")
    assert list(tmp_path.iterdir()) == []


def test_the_folder_holds_the_run(run: tuple[Path, Summary]) -> None:
    folder, summary = run
    found = {path.name for path in folder.iterdir()}
    expected = {"run.rrd", "frames.arrow", "records.arrow", "bench.toml", "summary.json", "events.jsonl"}
    assert found == expected | {"frames.index", "logger.log", "seal"}
    assert (folder / "logger.log").read_text() == ""
    assert (folder / "bench.toml").read_text() == "# resolved\n"
    assert from_plain(Summary, json.loads((folder / "summary.json").read_text())) == summary


def test_the_records_are_all_there_in_order(run: tuple[Path, Summary]) -> None:
    rows = np.concatenate(list(read_records(run[0] / "records.arrow")))
    assert [record_of(row) for row in rows] == list(synthetic_records(CYCLES))


def test_frames_and_events_are_there(run: tuple[Path, Summary]) -> None:
    lines = candump_text(run[0]).splitlines()
    assert len(lines) == 2 * CYCLES
    assert lines[:2] == ["(1000000000.000000) simulated 080#", "(1000000000.000000) simulated 181#3716"]
    assert directions(run[0]) == ["T", "R"] * CYCLES
    events = [json.loads(line) for line in (run[0] / "events.jsonl").read_text().splitlines()]
    assert events == [
        {"at_ns": -5, "level": "INFO", "text": "set up"},
        {"at_ns": 0, "begin": True},
        {"at_ns": 3, "track": "phase", "state": "stop"},
    ]


def test_simulated_time_waits_for_the_logger_and_loses_nothing(tmp_path: Path) -> None:
    recorder = start_recording(replace(plan_for(tmp_path / "run"), frames=False))
    record = next(synthetic_records(1))
    count = 2 * ROWS_CAPACITY + 100
    for sequence in range(count):
        recorder.record(replaced(record, sequence=sequence))
    summary = recorder.close(whole_outcome(CYCLES))
    assert summary.cycles == count
    assert not (tmp_path / "run" / "frames.arrow").exists()


def test_real_time_counts_what_a_stopped_logger_costs(tmp_path: Path) -> None:
    recorder = start_recording(plan_for(tmp_path / "run", real_time=True))
    logger = recorder.logger_process_id
    record = next(synthetic_records(1))
    os.kill(logger, signal.SIGSTOP)
    for _ in range(3 * ROWS_CAPACITY):
        recorder.record(record)
    assert recorder.trouble() == f"{2 * ROWS_CAPACITY} rows lost, the logger was too slow"
    os.kill(logger, signal.SIGCONT)
    summary = recorder.close(whole_outcome(CYCLES))
    assert ROWS_CAPACITY <= summary.cycles < 3 * ROWS_CAPACITY
    assert not summary.verdict.passed
    lost = 3 * ROWS_CAPACITY - summary.cycles
    fault = f"{lost} cycle records lost, the logger was too slow"
    assert summary.recording_faults == (fault,)
    assert summary.verdict.outcome is VerdictKind.NOT_RECORDED
    assert summary.verdict.reason == fault


@pytest.mark.parametrize("real_time", [False, True])
def test_a_dead_logger_is_told_and_what_the_rings_hold_is_kept(tmp_path: Path, real_time: bool) -> None:
    recorder = start_recording(plan_for(tmp_path / "run", real_time))
    recorder.confirm(lambda: None)
    assert recorder.trouble() == ""
    os.kill(recorder.logger_process_id, signal.SIGKILL)
    wait_for_exit(recorder.logger_process_id)
    assert recorder.trouble() == "the logger was killed by SIGKILL"
    record = next(synthetic_records(1))
    for sequence in range(ROWS_CAPACITY + 10):
        recorder.record(replaced(record, sequence=sequence))
    summary = recorder.close(whole_outcome(ROWS_CAPACITY + 10))
    assert summary.cycles == ROWS_CAPACITY
    assert not summary.verdict.passed
    assert summary.verdict.reason.startswith("the logger was killed by SIGKILL")
    assert "10 rows lost after the logger had ended" in summary.recording_faults


def test_rows_of_a_killed_logger_are_in_the_files_once_each(tmp_path: Path) -> None:
    recorder = start_recording(plan_for(tmp_path / "run", real_time=True))
    recorder.begin(Instant(0))
    records = list(synthetic_records(2 * CYCLES))
    for record in records[:CYCLES]:
        recorder.record(record)
        recorder.tap().frame("tx", 0x80, b"", False, False, record.due_at)
    recorder.confirm(lambda: None)
    os.kill(recorder.logger_process_id, signal.SIGKILL)
    wait_for_exit(recorder.logger_process_id)
    for record in records[CYCLES:]:
        recorder.record(record)
        recorder.tap().frame("tx", 0x80, b"", False, False, record.due_at)
    summary = recorder.close(whole_outcome(2 * CYCLES))
    rows = np.concatenate(list(read_records(tmp_path / "run" / "records.arrow")))
    assert [record_of(row) for row in rows] == records
    assert summary.digest == play(MemoryRecorder(plan_for(tmp_path)), 2 * CYCLES).digest
    assert len(candump_text(tmp_path / "run").splitlines()) == 2 * CYCLES
    assert from_plain(Summary, json.loads((tmp_path / "run" / "summary.json").read_text())) == summary
    assert not (tmp_path / "run" / "records.tail").exists()


def test_interrupts_do_not_end_the_logger(tmp_path: Path) -> None:
    recorder = start_recording(plan_for(tmp_path / "run"))
    recorder.wait_ready()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(recorder.logger_process_id, number)
    assert play(recorder).cycles == CYCLES


def test_the_bench_file_is_in_utf_8_in_every_locale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(io, "text_encoding", lambda encoding, *_: encoding or "ascii")
    monkeypatch.setattr("servobench.hil.recording.recorder.Recorder", lambda plan: plan)
    text = 'name = "Prüfstand"\n'
    start_recording(replace(plan_for(tmp_path), bench_toml=text))
    assert (tmp_path / "bench.toml").read_bytes() == text.encode()


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(BadInput, match="new or empty folder"):
        start_recording(plan_for(tmp_path))


def test_two_runs_within_a_second_have_a_folder_each(tmp_path: Path) -> None:
    asked = tmp_path / "runs" / "bench-20260101T000000Z"
    made = [new_folder(asked) for _ in range(3)]
    assert [folder.name for folder in made] == [asked.name, f"{asked.name}-2", f"{asked.name}-3"]
    assert all(folder.is_dir() for folder in made)


def test_a_folder_that_cannot_be_made_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="a folder that can be made"):
        start_recording(plan_for(tmp_path / "file" / "run"))


WRITER = """
import os, signal, sys
from pathlib import Path
from servobench.drivers.timebase import Instant
from servobench.hil.recording.recorder import start_recording
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.synthetic_run import synthetic_records

recorder = start_recording(plan_for(Path(sys.argv[1]), real_time=True))
recorder.begin(Instant(0))
for record in synthetic_records(300):
    recorder.record(record)
    recorder.tap().frame("tx", 0x80, b"", False, False, record.due_at)
print(recorder.logger_process_id, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_writer_leaves_a_whole_recording(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    writer = subprocess.run([sys.executable, "-c", WRITER, str(folder)], stdout=subprocess.PIPE, check=False)
    assert writer.returncode == -signal.SIGKILL
    wait_for_exit(int(writer.stdout))
    summary = from_plain(Summary, json.loads((folder / "summary.json").read_text()))
    assert summary.cycles == 300
    assert not summary.verdict.passed
    assert summary.verdict.reason == "the process of the loop died"
    assert sum(rows.size for rows in read_records(folder / "records.arrow")) == 300
    assert len(candump_text(folder).splitlines()) == 300


def wait_for_exit(process_id: int) -> None:
    """Until a process that is no child of ours has ended."""
    try:
        descriptor = os.pidfd_open(process_id)
    except ProcessLookupError:
        return
    try:
        assert select.select([descriptor], [], [], 60)[0]
    finally:
        os.close(descriptor)
