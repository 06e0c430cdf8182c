"""What each keeper of a recording has written after each of its calls, file by file."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.recording.append_file import TAIL_FILE, read_tail
from servobench.hil.recording.log_files import (
    EventsKeeper,
    Keeper,
    LoadKeeper,
    RecordsKeeper,
    RowBlocks,
)
from servobench.hil.recording.logger import open_keepers
from servobench.hil.recording.page_keepers import LiveKeeper, RerunKeeper
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.arrow_file import is_whole
from servobench.hil.rows.events import FaultEntries, RunZero
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.side_rows import (
    FRAME_DTYPE,
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
)
from servobench.hil.verdict.summary import Summary
from tests.unit.hil.recording_tools import files_below, plan_for
from tests.unit.hil.row_tools import plain_rows, rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_log_files import summary_of, viewers

__all__ = ["viewers"]

NO_ROWS: Final = np.empty(0, ROW_DTYPE)
NO_FRAMES: Final = np.empty(0, FRAME_DTYPE)
BEGIN: Final = Instant(3 * NS_PER_MS)
STARTED: Final = Instant(NS_PER_MS)


@pytest.fixture
def plan(tmp_path: Path) -> RecordingPlan:
    """Of a simulated run whose recording began at 1 ms."""
    return replace(plan_for(tmp_path), started_at=STARTED)


def tell(keeper: Keeper, *events: RunEvent, rows: Rows = NO_ROWS) -> None:
    keeper.take(rows, NO_FRAMES, events)


def lines(path: Path) -> list[object]:
    return [json.loads(line) for line in path.read_text().splitlines()]


# ---- events.jsonl -------------------------------------------------------------------------------------


def test_events_count_from_the_start_until_the_first_cycle_is_known(
    plan: RecordingPlan, tmp_path: Path
) -> None:
    keeper, path = EventsKeeper(plan, tmp_path), tmp_path / "events.jsonl"
    tell(keeper, TextEvent(Instant(STARTED + 5), "INFO", "set up"))
    tell(keeper, StateEvent(STARTED, "phase", "enabling"))
    early = [
        {"at_ns": 5, "level": "INFO", "text": "set up"},
        {"at_ns": 0, "track": "phase", "state": "enabling"},
    ]
    assert lines(path) == early
    tell(keeper, BeginEvent(BEGIN), TextEvent(Instant(BEGIN + 7), "WARN", "late"))
    moved = [{**entry, "at_ns": int(str(entry["at_ns"])) - 2 * NS_PER_MS} for entry in early]
    last = [{"at_ns": 0, "begin": True}, {"at_ns": 7, "level": "WARN", "text": "late"}]
    assert lines(path) == [*moved, *last]
    tell(keeper, StateEvent(Instant(BEGIN - 1), "phase", "stopped"))
    assert lines(path)[4:] == [{"at_ns": -1, "track": "phase", "state": "stopped"}]


def test_what_a_load_machine_measures_and_who_a_drive_is_are_no_entries(
    plan: RecordingPlan, tmp_path: Path
) -> None:
    keeper = EventsKeeper(plan, tmp_path)
    tell(keeper, LoadEvent(BEGIN, "axis1", 0.1, 2.0), IdentityEvent(BEGIN, "axis1", "a drive"))
    keeper.finish(summary_of())
    assert (tmp_path / "events.jsonl").read_bytes() == b""


def test_a_known_first_cycle_goes_on_behind_what_the_file_has(plan: RecordingPlan, tmp_path: Path) -> None:
    (tmp_path / "events.jsonl").write_text('{"at_ns": 1}\n{"at')
    zero = RunZero(STARTED)
    zero.at, zero.told = BEGIN, True
    tell(EventsKeeper(plan, tmp_path, zero, fresh=False), TextEvent(BEGIN, "INFO", "x"))
    assert lines(tmp_path / "events.jsonl") == [{"at_ns": 1}, {"at_ns": 0, "level": "INFO", "text": "x"}]
    tell(EventsKeeper(plan, tmp_path), TextEvent(BEGIN, "INFO", "y"))
    assert len(lines(tmp_path / "events.jsonl")) == 1, "a fresh one begins anew"


# ---- load.csv -----------------------------------------------------------------------------------------


def test_measured_loads_are_told_in_run_time(plan: RecordingPlan, tmp_path: Path) -> None:
    keeper, path = LoadKeeper(plan, tmp_path), tmp_path / "load.csv"
    tell(keeper, BeginEvent(BEGIN), TextEvent(BEGIN, "INFO", "x"))
    assert not path.exists(), "nothing was measured"
    tell(keeper, LoadEvent(Instant(BEGIN + 5), "axis1", 0.123456789, -10.0))
    tell(keeper, LoadEvent(Instant(BEGIN + 6), "axis2", 1.0, 1e-7))
    head = "at_ns,axis,torque_nm,speed_rad_s\n"
    assert path.read_text() == f"{head}5,axis1,0.123457,-10\n6,axis2,1,1e-07\n"
    keeper.finish(summary_of())
    with pytest.raises(OSError, match="Bad file descriptor"):
        tell(keeper, LoadEvent(BEGIN, "axis1", 0.0, 0.0))


def test_a_load_machine_that_measured_nothing_leaves_no_file(plan: RecordingPlan, tmp_path: Path) -> None:
    LoadKeeper(plan, tmp_path).finish(summary_of())
    assert list(tmp_path.iterdir()) == []


# ---- records.arrow ------------------------------------------------------------------------------------


def stored(folder: Path) -> Rows:
    return np.concatenate([NO_ROWS, *read_records(folder / "records.arrow")])


def test_records_have_their_head_with_the_first_cycle_and_all_drives(
    plan: RecordingPlan, tmp_path: Path
) -> None:
    keeper, path = RecordsKeeper(plan, tmp_path), tmp_path / "records.arrow"
    tell(keeper, IdentityEvent(STARTED, "axis1", "a drive"), IdentityEvent(STARTED, "axis2", "another"))
    assert path.read_bytes() == b""
    tell(keeper, BeginEvent(BEGIN))
    head = read_metadata(path)
    assert head["drives"] == '{"axis1": "a drive", "axis2": "another"}'
    assert head["first_cycle_bench_ns"] == str(BEGIN)
    assert head["bench_start_ns"] == str(STARTED - BEGIN)
    tell(keeper, IdentityEvent(STARTED, "axis3", "too late"), BeginEvent(Instant(BEGIN + 1)))
    assert read_metadata(path) == head, "written once"


def test_rows_wait_in_the_tail_until_they_are_a_batch(plan: RecordingPlan, tmp_path: Path) -> None:
    keeper, tail = RecordsKeeper(plan, tmp_path), tmp_path / TAIL_FILE
    rows = rows_of(synthetic_records(60, origin=BEGIN))
    tell(keeper, BeginEvent(BEGIN), rows=rows[:20])
    tell(keeper, rows=rows[20:50])
    assert read_tail(tail, ROW_DTYPE, 0).tobytes() == rows[:50].tobytes()
    assert stored(tmp_path).size == 0
    keeper.flush()
    assert stored(tmp_path)["sequence"].tolist() == list(range(1, 51))
    assert read_tail(tail, ROW_DTYPE, 50).size == 0
    tell(keeper, rows=rows[50:])
    assert read_tail(tail, ROW_DTYPE, 50).tobytes() == rows[50:].tobytes()
    assert read_tail(tail, ROW_DTYPE, 49).size == 0, "it begins behind the 50 that are stored"
    keeper.finish(summary_of())
    found = stored(tmp_path)
    assert found["due_at"].tolist() == (rows["due_at"] - BEGIN).tolist()
    assert is_whole(tmp_path / "records.arrow")
    assert not tail.exists()


@pytest.mark.parametrize(("count", "at_once"), [(8_191, False), (8_192, True)])
def test_8192_rows_are_a_batch(plan: RecordingPlan, tmp_path: Path, count: int, at_once: bool) -> None:
    rows = plain_rows(count)
    blocks = RowBlocks()
    assert not blocks.add(rows[:100])
    assert not blocks.add(rows[:0])
    assert blocks.add(rows[100:]) is at_once
    keeper = RecordsKeeper(plan, tmp_path)
    tell(keeper, BeginEvent(Instant(0)), rows=rows)
    assert stored(tmp_path).size == (count if at_once else 0)


@pytest.mark.parametrize("count", [100, 8192, 20_000])
def test_as_many_rows_as_fit_are_kept_of_those_that_fill_a_disk(
    plan: RecordingPlan, tmp_path: Path, count: int
) -> None:
    keeper, room = RecordsKeeper(plan, tmp_path), 20_000
    tell(keeper, BeginEvent(BEGIN))
    rows = plain_rows(count, velocity=np.random.default_rng(1).standard_normal(count))
    with files_below(room), pytest.raises(OSError, match="File too large"):
        tell(keeper, rows=rows)
    kept = read_tail(tmp_path / TAIL_FILE, ROW_DTYPE, 0)
    assert keeper.stored == 0
    assert kept.size == (room - 24) // ROW_DTYPE.itemsize
    assert kept.tobytes() == rows[: kept.size].tobytes()


def test_a_run_without_a_cycle_has_records_all_the_same(plan: RecordingPlan, tmp_path: Path) -> None:
    keeper = RecordsKeeper(plan, tmp_path)
    keeper.flush()
    assert (tmp_path / "records.arrow").read_bytes() == b""
    keeper.finish(summary_of())
    assert is_whole(tmp_path / "records.arrow")
    assert read_metadata(tmp_path / "records.arrow")["first_cycle_bench_ns"] == str(STARTED)
    assert stored(tmp_path).size == 0


# ---- run.rrd and the live view ------------------------------------------------------------------------


class Shown:
    """In the place of what writes to Rerun: what it was given, in order."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, object]] = []
        self.observed = self

    def take(self, frames: NDArray[np.void]) -> None:
        self.calls.append(("frames", frames.size))

    def take_events(self, events: Sequence[RunEvent]) -> None:
        self.calls.append(("events", len(events)))

    def take_rows(self, rows: Rows) -> None:
        self.calls.append(("rows", rows.size))

    def show_running(self, review: Review) -> None:
        self.calls.append(("running", review))

    def flush(self) -> None:
        self.calls.append(("flush", None))

    def finish(self, summary: Summary, review: Review) -> None:
        self.calls.append(("finish", (summary, review)))


def frames(count: int) -> NDArray[np.void]:
    """So many of them."""
    return np.zeros(count, FRAME_DTYPE)


def shown_by(keeper: RerunKeeper | LiveKeeper) -> list[tuple[str, object]]:
    """What the keeper shows from now on."""
    shown = Shown()
    keeper._telemetry = shown  # type: ignore[assignment]
    return shown.calls


def test_run_rrd_gets_rows_in_blocks(plan: RecordingPlan, tmp_path: Path, viewers: list[list[str]]) -> None:
    review, summary = Review(plan.review), summary_of()
    keeper = RerunKeeper(replace(plan, view=True), tmp_path, "x", review)
    calls, event = shown_by(keeper), TextEvent(BEGIN, "INFO", "x")
    keeper.take(plain_rows(100), frames(1), [event])
    keeper.take(plain_rows(8_092), NO_FRAMES, [event, event])
    keeper.take(plain_rows(7), NO_FRAMES, [])
    keeper.flush()
    keeper.flush()
    keeper.take(plain_rows(1), NO_FRAMES, [])
    keeper.finish(summary)
    assert calls == [
        *[("events", 1), ("frames", 1)],
        *[("events", 2), ("frames", 0), ("rows", 8_192)],
        *[("events", 0), ("frames", 0), ("rows", 7), ("flush", None), ("flush", None)],
        *[("events", 0), ("frames", 0), ("rows", 1), ("finish", (summary, review))],
    ]
    assert [command[-1] for command in viewers] == [str(tmp_path / "run.rrd")]


def test_the_live_view_gets_rows_as_they_come(
    plan: RecordingPlan, tmp_path: Path, viewers: list[list[str]]
) -> None:
    review, summary = Review(plan.review), summary_of()
    keeper = LiveKeeper(replace(plan, real_time=True, view=True), "x", review)
    (command,) = viewers
    assert command[-2] == "--connect"
    calls = shown_by(keeper)
    keeper.take(plain_rows(3), frames(2), [])
    keeper.flush()
    keeper.finish(summary)
    assert calls == [
        *[("events", 0), ("frames", 2), ("rows", 3)],
        *[("running", review), ("flush", None), ("finish", (summary, review))],
    ]
    assert len(viewers) == 1
    del tmp_path


ALWAYS: Final = ["records.arrow", "events.jsonl", "load.csv"]


@pytest.mark.parametrize(
    ("wish", "names"),
    [
        ({}, [*ALWAYS, "frames.arrow", "run.rrd"]),
        ({"frames": False}, [*ALWAYS, "run.rrd"]),
        ({"faults": True}, [*ALWAYS, "frames.arrow", "faults.arrow", "run.rrd"]),
        ({"period_us": 1000}, [*ALWAYS, "frames.arrow", "network.toml", "run.rrd"]),
        ({"view": True}, [*ALWAYS, "frames.arrow", "run.rrd"]),
        ({"view": True, "real_time": True, "frames": False}, [*ALWAYS, "run.rrd", "live view"]),
        ({"folder": None}, []),
    ],
)
def test_the_plan_says_what_is_kept_and_rerun_comes_last(
    plan: RecordingPlan, viewers: list[list[str]], wish: dict[str, object], names: list[str]
) -> None:
    wanted = replace(plan, **wish)  # type: ignore[arg-type]
    opened = open_keepers(wanted, Review(wanted.review), FaultEntries(wanted.started_at))
    assert [keeper.name for keeper in opened] == names
    assert len(viewers) == names.count("live view")
