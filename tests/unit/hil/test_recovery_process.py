"""The process that finishes a dead logger's recording, and what it does on a disk that is full."""

import errno
import io
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.recording import recovery, rerun_anew
from servobench.hil.recording.append_file import TAIL_FILE
from servobench.hil.recording.recovery import Rings, main, recover, whole_records
from servobench.hil.recording.ring import RingReader
from servobench.hil.recording.run_metadata import read_summary
from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.rows.arrow_file import is_whole
from servobench.hil.rows.events import BLOCK_DTYPE
from servobench.hil.rows.recording_plan import ObservedDrive, RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.rows.side_rows import EVENT_DTYPE, FRAME_DTYPE, BeginEvent, TextEvent, frame_row
from tests.rrd_columns import columns
from tests.unit.hil import test_drawn_rows as drawn
from tests.unit.hil.logger_fakes import EVENTS, LOSS, ROWS, put_faults, rings
from tests.unit.hil.logger_fakes import Rings as Written
from tests.unit.hil.recording_tools import whole_outcome
from tests.unit.hil.test_recovered_files import BEGIN, COUNT, begun, full, plan, read, rows
from tests.unit.hil.test_recovered_files import rings as left

__all__ = ["plan", "rings", "rows"]

TOLD: Final = TextEvent(Instant(BEGIN + NS_PER_MS), "WARN", "x")


def written(rings: Written, rows: Rows) -> None:
    """What a logger had not taken: of 20 rows the last 5, a frame, two events, a fault."""
    rings.cycles(rows[:15])
    RingReader(rings.rows.descriptor, ROW_DTYPE).drain()
    rings.cycles(rows[15:20])
    rings.frames.push(frame_row(Instant(BEGIN), 0x80, 1, b""))
    rings.tell(BeginEvent(BEGIN), TOLD)
    put_faults(rings, LOSS)


def test_what_a_logger_had_not_taken_is_read_off_its_rings(rings: Written, rows: Rows) -> None:
    written(rings, rows)
    found = Rings(*rings.descriptors)
    assert found.rows_before == 15
    assert found.rows.tobytes() == rows[15:20].tobytes()
    assert found.frames["can_id"].tolist() == [0x80]
    assert found.events == [BeginEvent(BEGIN), TOLD]
    assert found.fault_blocks["length"].tolist() == [64]
    assert found.refused == 0
    again = Rings(*rings.descriptors)
    assert (again.rows_before, again.rows.size, again.events) == (20, 0, []), "taken once"
    dtypes = (ROW_DTYPE, FRAME_DTYPE, EVENT_DTYPE, BLOCK_DTYPE)
    for ring, dtype in zip(rings, dtypes, strict=True):
        assert RingReader(ring.descriptor, dtype).drain().size == 0


def test_what_found_any_of_the_rings_full_is_counted(rings: Written, rows: Rows) -> None:
    for _ in range(EVENTS + 2):
        rings.tell(TOLD)
    for _ in range(ROWS // COUNT + 1):
        rings.cycles(rows)
    assert Rings(*rings.descriptors).refused == 2 + (ROWS // COUNT + 1) * COUNT - ROWS


def test_the_program_finishes_the_recording_and_prints_its_summary(
    plan: RecordingPlan,
    rings: Written,
    rows: Rows,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    begun(plan, rows[:15], 15)
    written(rings, rows)
    policies: list[tuple[int, int, int]] = []
    wanted = {"plan": plan.as_json(), "outcome": asdict(whole_outcome(20)), "trouble": "its logger died"}
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(wanted) + "\nand more"))
    monkeypatch.setattr(sys, "argv", ["recovery", *map(str, rings.descriptors), "something else"])
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda *to: policies.append((to[0], to[1], to[2].sched_priority))
    )
    assert main() == 0
    summary = read_summary(tmp_path)
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(summary.as_json()))
    assert (summary.cycles, summary.recording_faults) == (20, ("its logger died",))
    assert read(tmp_path).tobytes() == rows[:20].tobytes()
    assert policies == [(0, os.SCHED_OTHER, 0)], "it does not compete with a real-time loop"


@pytest.mark.parametrize(("wanted", "frames"), [(True, True), (False, True), (True, False)])
def test_what_a_drive_told_beside_is_drawn_anew_from_the_frames(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, wanted: bool, frames: bool
) -> None:
    """Of the frames, in run time; without them there are none."""
    begun(plan, rows, COUNT)
    told = drawn.frames(*drawn.MAPPING, drawn.pdo(-250, 48_000, BEGIN + 5_000))
    observed = {"axis1": ObservedDrive(3, 0, (drawn.TEMPERATURE,))} if wanted else {}
    recover(replace(plan, observed=observed, frames=frames), whole_outcome(COUNT), [], left(frames=told))
    times, celsius = columns(tmp_path / "run.rrd", "/axis1/observed/2030h_1", "Scalars:scalars")
    expected = ([5_000], [[pytest.approx(-25.0)]]) if wanted and frames else ([], [])
    assert (times.tolist(), celsius) == expected


# ---- a full disk ----------------------------------------------------------------------------------------


def test_faults_that_cannot_be_written_are_told(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(plan, rows, COUNT)
    monkeypatch.setattr(recovery, "append_faults", full)
    kept = replace(plan, faults=True)
    told = recover(kept, whole_outcome(COUNT), ["why"], left(refused=1)).recording_faults
    words = "faults.arrow ends before the run: No space left on device"
    assert told == ("why", "1 rows lost after the logger had ended", words)
    assert recover(plan, whole_outcome(COUNT), [], left()).recording_faults == (), "none are wanted"
    del tmp_path


def test_a_run_rrd_that_cannot_be_finished_leaves_the_one_that_is_there(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(plan, rows, COUNT)
    (tmp_path / "run.rrd").write_bytes(b"old")
    monkeypatch.setattr(Telemetry, "finish", full)
    summary = recover(plan, whole_outcome(COUNT), [])
    assert summary.recording_faults == (
        "run.rrd has no verdict and may lack the last seconds: [Errno 28] No space left on device",
    )
    assert (tmp_path / "run.rrd").read_bytes() == b"old"
    assert not (tmp_path / "run.rrd.part").exists()
    assert read_summary(tmp_path) == summary


@pytest.mark.parametrize("fails", ["write", "close"])
def test_records_that_find_the_disk_full_are_left_as_they_were(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    begun(plan, rows[:50], 30)
    ends: list[str] = []
    drop: Callable[[RecordsWriter], None] = RecordsWriter.drop

    def dropped(writer: RecordsWriter) -> None:
        ends.append("dropped")
        drop(writer)

    monkeypatch.setattr(RecordsWriter, "drop", dropped)
    monkeypatch.setattr(RecordsWriter, fails, full)
    told = whole_records(plan, tmp_path, left(rows[50:55], rows_before=50))
    assert told == [
        f"records.arrow lacks 25 rows, records.tail may have them: [Errno {errno.ENOSPC}] "
        "No space left on device"
    ]
    assert ends == ["dropped"], "a file that is open keeps its room"
    assert not (tmp_path / "records.arrow.part").exists()
    assert is_whole(tmp_path / "records.arrow")
    assert read(tmp_path).tobytes() == rows[:30].tobytes()
    assert (tmp_path / TAIL_FILE).exists()
    assert rerun_anew.ROOM_BYTES == 4 << 20
