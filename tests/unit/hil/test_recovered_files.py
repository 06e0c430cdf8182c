"""A recording that its logger could not end, file by file: what is there is kept, what is missing is said."""

import os
from collections.abc import Sequence
from dataclasses import replace
from errno import ENOSPC
from pathlib import Path
from struct import Struct
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.configuration.network_file import load_network
from servobench.hil.recording import rerun_anew
from servobench.hil.recording.append_file import TAIL_FILE
from servobench.hil.recording.log_files import EventsKeeper, FaultsKeeper, FramesKeeper, RecordsKeeper
from servobench.hil.recording.recovery import Rings, first_cycle, recover, whole_records
from servobench.hil.recording.ring import RingReader, RingWriter
from servobench.hil.recording.run_metadata import Reserve, read_summary
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.arrow_file import is_whole
from servobench.hil.rows.events import BLOCK_DTYPE, FaultEntries, RunZero
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.side_rows import (
    EVENT_DTYPE,
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
    event_row,
)
from servobench.virtual_bus.faults.fault_log import KIND_CODES
from tests.recorded_frames import injected
from tests.rrd_columns import columns, numbers
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_frame_keepers import blocks, frames_at, written
from tests.unit.hil.test_recording_keepers import NO_FRAMES, NO_ROWS, lines, tell

STARTED: Final = Instant(NS_PER_MS)
BEGIN: Final = Instant(3 * NS_PER_MS)
COUNT: Final = 60


def ring(rows: NDArray[np.void], taken: int = 0, refused: int = 0) -> int:
    """The descriptor of a ring that was full once, if rows were ``refused``."""
    shape, capacity = Struct(f"{rows.dtype.itemsize}s"), 128
    writer = RingWriter(shape, capacity)
    taken = capacity if refused else taken
    for _ in range(taken + refused):
        writer.push(bytes(shape.size))
    RingReader(writer.descriptor, rows.dtype).drain()
    for row in rows:
        assert writer.push(row.tobytes())
    return writer.descriptor


def rings(
    rows: Rows = NO_ROWS,
    frames: NDArray[np.void] = NO_FRAMES,
    events: Sequence[RunEvent] = (),
    faults: NDArray[np.void] | None = None,
    rows_before: int = 0,
    refused: int = 0,
) -> Rings:
    """What a dead logger had not taken; the rings end with the process."""
    blocks_left = np.empty(0, BLOCK_DTYPE) if faults is None else faults
    told = np.frombuffer(b"".join(map(event_row, events)), EVENT_DTYPE)
    return Rings(ring(rows, rows_before), ring(frames), ring(told), ring(blocks_left, refused=refused))


@pytest.fixture
def plan(tmp_path: Path) -> RecordingPlan:
    return replace(plan_for(tmp_path), started_at=STARTED)


@pytest.fixture(scope="module")
def rows() -> Rows:
    return rows_of(synthetic_records(COUNT, origin=BEGIN))


def begun(plan: RecordingPlan, rows: Rows, stored: int, *events: RunEvent) -> None:
    """Records, events and frames as a logger leaves them that was killed."""
    folder = Path(cast(Path, plan.folder))
    Sealer(folder)
    keeper = RecordsKeeper(plan, folder)
    keeper.take(rows[:stored], NO_FRAMES, [BeginEvent(BEGIN)])
    keeper.flush()
    keeper.take(rows[stored:], NO_FRAMES, [])
    EventsKeeper(plan, folder).take(NO_ROWS, NO_FRAMES, [*events, BeginEvent(BEGIN)])


def read(folder: Path) -> Rows:
    return np.concatenate([NO_ROWS, *read_records(folder / "records.arrow", BEGIN)])


# ---- records.arrow ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "count", "lost"), [(50, 10, 0), (40, 20, 0), (0, 60, 0), (52, 8, 2), (10, 20, 0)]
)
def test_rows_of_file_tail_and_ring_are_joined_without_a_double(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, before: int, count: int, lost: int
) -> None:
    """30 are stored, 20 in the tail; the ring has ``count`` of them behind the first ``before``."""
    begun(plan, rows[:50], 30)
    told = whole_records(plan, tmp_path, rings(rows[before : before + count], rows_before=before))
    kept = read(tmp_path)["sequence"].tolist()
    expected = [*range(1, 51), *range(max(before, 50) + 1, before + count + 1)]
    assert kept == expected
    assert told == ([f"{lost} cycle records lost with the logger"] if lost else [])
    assert is_whole(tmp_path / "records.arrow")
    assert not (tmp_path / TAIL_FILE).exists()
    assert not (tmp_path / "records.arrow.part").exists()


def test_rows_are_the_same_bytes_before_and_after(plan: RecordingPlan, tmp_path: Path, rows: Rows) -> None:
    begun(plan, rows[:50], 30)
    head = read_metadata(tmp_path / "records.arrow")
    whole_records(plan, tmp_path, rings(rows[50:], rows_before=50))
    assert read(tmp_path).tobytes() == rows.tobytes()
    assert read_metadata(tmp_path / "records.arrow") == head


def test_a_file_that_has_all_is_given_its_end(plan: RecordingPlan, tmp_path: Path, rows: Rows) -> None:
    begun(plan, rows, COUNT)
    assert not is_whole(tmp_path / "records.arrow")
    assert whole_records(plan, tmp_path) == []
    assert is_whole(tmp_path / "records.arrow")
    assert read(tmp_path).tobytes() == rows.tobytes()


@pytest.mark.parametrize("there", [True, False])
def test_where_no_head_was_written_it_is_made_of_what_the_ring_has(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, there: bool
) -> None:
    if there:
        (tmp_path / "records.arrow").write_bytes(b"")
    told: list[RunEvent] = [
        IdentityEvent(STARTED, "axis1", "a drive"),
        BeginEvent(BEGIN),
        TextEvent(BEGIN, "INFO", "x"),
    ]
    assert whole_records(plan, tmp_path, rings(rows[:5], events=told)) == []
    assert read(tmp_path).tobytes() == rows[:5].tobytes()
    head = read_metadata(tmp_path / "records.arrow")
    assert (head["first_cycle_bench_ns"], head["drives"]) == (str(BEGIN), '{"axis1": "a drive"}')
    (tmp_path / "records.arrow").unlink()
    assert whole_records(plan, tmp_path) == []
    assert read(tmp_path).size == 0
    assert read_metadata(tmp_path / "records.arrow")["drives"] == "{}"


def test_the_first_cycle_is_the_head_s_then_the_ring_s_then_the_start(
    plan: RecordingPlan, tmp_path: Path, rows: Rows
) -> None:
    path = tmp_path / "records.arrow"
    late = rings(events=[BeginEvent(Instant(7))])
    found = first_cycle(plan, path, None)
    assert (found.at, found.told) == (STARTED, False)
    found = first_cycle(plan, path, late)
    assert (found.at, found.told) == (7, True)
    begun(plan, rows, 1)
    found = first_cycle(plan, path, late)
    assert (found.at, found.told) == (BEGIN, True)
    path.write_bytes(b"")
    assert not first_cycle(plan, path, None).told


def test_rows_that_cannot_be_written_stay_in_the_tail_and_are_counted(
    plan: RecordingPlan, tmp_path: Path, rows: Rows
) -> None:
    begun(plan, rows[:50], 30)
    (tmp_path / "records.arrow.part").mkdir()
    (told,) = whole_records(plan, tmp_path, rings(rows[50:55], rows_before=50))
    assert told.startswith("records.arrow lacks 25 rows, records.tail may have them: ")
    assert is_whole(tmp_path / "records.arrow")
    assert read(tmp_path).tobytes() == rows[:30].tobytes()
    assert (tmp_path / TAIL_FILE).exists()


# ---- all of it ----------------------------------------------------------------------------------------


def test_a_whole_run_comes_out_of_its_parts(plan: RecordingPlan, tmp_path: Path, rows: Rows) -> None:
    events = (StateEvent(STARTED, "phase", "enabling"), TextEvent(Instant(STARTED + 9), "WARN", "x"))
    begun(plan, rows[:50], 30, *events)
    kept = replace(plan, period_us=1000)
    last = [TextEvent(Instant(BEGIN + 70 * NS_PER_MS), "INFO", "at the end")]
    (tmp_path / "load.csv").write_text(
        "at_ns,axis,torque_nm,speed_rad_s\n5000000,axis1,0.25,10\n6000000,axis1,0.5,1"
    )
    summary = recover(
        kept, whole_outcome(COUNT), ["its logger died"], rings(rows[50:], events=last, rows_before=50)
    )
    assert summary == read_summary(tmp_path)
    assert summary.recording_faults == ("its logger died",)
    assert summary.cycles == COUNT
    assert read(tmp_path).tobytes() == rows.tobytes()
    assert lines(tmp_path / "events.jsonl") == [
        {"at_ns": STARTED - BEGIN, "track": "phase", "state": "enabling"},
        {"at_ns": STARTED + 9 - BEGIN, "level": "WARN", "text": "x"},
        {"at_ns": 0, "begin": True},
        {"at_ns": 70 * NS_PER_MS, "level": "INFO", "text": "at the end"},
    ]
    assert load_network(tmp_path / "network.toml").cycles == COUNT
    # run.rrd has them all too: the line of the load that was cut off is none
    times, _ = numbers(tmp_path / "run.rrd", "/axis1/speed/reference")
    assert times.tolist() == (rows["due_at"] - BEGIN).tolist()
    times, torque = numbers(tmp_path / "run.rrd", "/axis1/torque/brake")
    assert (times.tolist(), torque.tolist()) == ([5_000_000], [250.0])
    times, texts = columns(tmp_path / "run.rrd", "/events", "TextLog:text")
    assert [str(text) for (text,) in texts][:2] == ["-0.002 s  x", "0.070 s  at the end"]
    assert times.tolist()[:3] == [STARTED + 9 - BEGIN, 70 * NS_PER_MS, 70 * NS_PER_MS]
    assert not list(tmp_path.glob(".reserve*"))
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("planned", "missing"), [(None, False), (COUNT, False), (COUNT + 1, True), (0, False)]
)
def test_cycles_that_were_planned_and_are_not_there_are_told(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, planned: int | None, missing: bool
) -> None:
    begun(plan, rows, 40)
    summary = recover(plan, whole_outcome(COUNT), [], None, planned)
    text = f"{COUNT} of {planned} planned cycles are recorded"
    assert summary.recording_faults == ((text,) if missing else ())
    assert not (tmp_path / "network.toml").exists(), "the plan names no period"


def test_a_recording_that_somebody_writes_is_left_alone(
    plan: RecordingPlan, tmp_path: Path, rows: Rows
) -> None:
    begun(plan, rows, 40)
    there = (tmp_path / "records.arrow").read_bytes()
    logger = Reserve(tmp_path)
    with pytest.raises(BlockingIOError):
        recover(plan, whole_outcome(COUNT), [])
    logger.close()
    assert (tmp_path / "records.arrow").read_bytes() == there


def test_frames_behind_the_log_s_are_added_each_with_its_direction(
    plan: RecordingPlan, tmp_path: Path, rows: Rows
) -> None:
    begun(plan, rows, COUNT)
    keeper = FramesKeeper(plan, tmp_path)
    keeper.take(NO_ROWS, frames_at((2_000, 1), (4_000, 0), (9_000, 1)), [BeginEvent(BEGIN)])
    keeper.flush()
    with (tmp_path / "frames.arrow").open("ab") as log:
        log.write(b"\xff\xff\xff\xff\x40\0\0\0half a batch")
    recover(plan, whole_outcome(COUNT), [], rings(frames=frames_at((10_000, 0))))
    assert written(tmp_path) == ["-0.001000 T", "0.001000 R", "0.006000 T", "0.007000 R"]
    assert not (tmp_path / "frames.tail").exists()


def test_without_frames_in_the_plan_none_are_written(plan: RecordingPlan, tmp_path: Path, rows: Rows) -> None:
    begun(plan, rows, COUNT)
    recover(replace(plan, frames=False), whole_outcome(COUNT), [], rings(frames=frames_at((10_000, 0))))
    assert not (tmp_path / "frames.arrow").exists()


def test_a_file_that_cannot_be_written_is_told_and_the_others_are_kept(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(plan, rows, 40)
    (tmp_path / "events.jsonl").write_text("[1]\n")
    monkeypatch.setattr("servobench.hil.recording.recovery.append_frames", full)
    summary = recover(plan, whole_outcome(COUNT), ["why"])
    why, frames, events = summary.recording_faults
    assert (why, frames) == ("why", "frames.arrow ends before the run: No space left on device")
    assert events.startswith("events.jsonl is not in run time: ")
    assert summary.cycles == COUNT


def full(*_arguments: object) -> None:
    """In the place of a write to a disk without room."""
    raise OSError(ENOSPC, os.strerror(ENOSPC))


@pytest.mark.parametrize("kept", [True, False])
def test_faults_that_were_injected_are_kept_where_the_plan_wants_them(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, kept: bool
) -> None:
    begun(plan, rows, COUNT)
    keeper = FaultsKeeper(tmp_path, before := FaultEntries(STARTED))
    before.take(blocks((KIND_CODES["loss"], 900, 0, 0x181, 4)), RunZero(STARTED), at_end=True)
    tell(keeper)
    more = blocks((KIND_CODES["boot"], 500, 3, 0x703, 0))
    summary = recover(replace(plan, faults=kept), whole_outcome(COUNT), [], rings(faults=more, refused=3))
    assert summary.recording_faults == ("3 rows lost after the logger had ended",)
    told = [entry["at_ns"] for entry in injected(tmp_path)]
    assert told == ([900, 500 + STARTED - BEGIN] if kept else []), "the first from faults.tail"
    assert (tmp_path / "faults.tail").exists() is not kept


def test_a_disk_without_room_keeps_the_run_rrd_that_is_there(
    plan: RecordingPlan, tmp_path: Path, rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(plan, rows, COUNT)
    (tmp_path / "run.rrd").write_bytes(b"old")
    needed = (4 << 20) + ROW_DTYPE.itemsize * COUNT
    usage: list[Any] = [SimpleNamespace(free=needed - 1)]
    monkeypatch.setattr("servobench.hil.recording.rerun_anew.shutil.disk_usage", lambda folder: usage[0])
    summary = recover(plan, whole_outcome(COUNT), [])
    assert summary.recording_faults == (
        "run.rrd has no verdict and may lack the last seconds: less than 4 MB are free",
    )
    assert (tmp_path / "run.rrd").read_bytes() == b"old"
    usage[0] = SimpleNamespace(free=needed)
    assert recover(plan, whole_outcome(COUNT), []).recording_faults == ()
    assert (tmp_path / "run.rrd").stat().st_size > 1000


# ---- lines --------------------------------------------------------------------------------------------

MOST: Final = 1 << 62


@pytest.mark.parametrize(
    ("line", "event"),
    [
        ('{"at_ns": 5, "begin": true}', BeginEvent(Instant(5))),
        ('{"at_ns": 1, "level": "WARN", "text": "x"}', TextEvent(Instant(1), "WARN", "x")),
        ('{"at_ns": -5, "track": "phase", "state": "x"}', StateEvent(Instant(-5), "phase", "x")),
        (
            '{"at_ns": 1, "level": "WARN", "text": "a\\u001b[1mb"}',
            None,
        ),
        (f'{{"at_ns": {MOST}, "begin": true}}', BeginEvent(Instant(MOST))),
        (f'{{"at_ns": {-MOST}, "begin": true}}', BeginEvent(Instant(-MOST))),
        (f'{{"at_ns": {MOST + 1}, "begin": true}}', None),
        (f'{{"at_ns": {-MOST - 1}, "begin": true}}', None),
        ('{"at_ns": 1.5, "begin": true}', None),
        ('{"at_ns": 1, "text": "no level"}', None),
        ('{"begin": true}', None),
        ("[1]", None),
        ('{"at_ns": 1, "beg', None),
    ],
)
def test_a_line_that_is_no_event_is_passed_over(tmp_path: Path, line: str, event: RunEvent | None) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(f"{line}\n")
    assert list(rerun_anew._events(path)) == ([] if event is None else [event])


def test_lines_of_a_load_are_numbers_behind_a_head(tmp_path: Path) -> None:
    path = tmp_path / "load.csv"
    assert list(rerun_anew._loads(path)) == []
    path.write_text("at_ns,axis,torque_nm,speed_rad_s\n5,left,0.25,-10\n6,left,0.5\n7,left,x,1\n8,a,1,2\n")
    assert list(rerun_anew._loads(path)) == [
        LoadEvent(Instant(5), "left", 0.25, -10.0),
        LoadEvent(Instant(8), "a", 1.0, 2.0),
    ]
