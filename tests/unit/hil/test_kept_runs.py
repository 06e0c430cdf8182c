"""Runs as they are kept: in memory for the test that ran them, and in a folder for who opens them later."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.loop.cycle_record import NAMES
from servobench.hil.recorded.recorded_run import RecordedRun, open_run, signals_of
from servobench.hil.recording.run_metadata import write_summary
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.recording_plan import PlannedSetPoint
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.rows.run_files import FORMAT
from servobench.hil.rows.side_rows import BeginEvent, LoadEvent, StateEvent, TextEvent
from servobench.hil.testing.run import Run
from servobench.hil.testing.wire import SeenFrame
from servobench.virtual_bus.faults.fault_log import KIND_CODES
from tests.unit.hil.made_runs import BENCH
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_frame_keepers import blocks
from tests.unit.hil.test_report import summary

pytestmark = pytest.mark.usefixtures("forked_children")

ZERO: Final = Instant(3 * NS_PER_MS)
RECORDS: Final = list(synthetic_records(20, origin=ZERO))
PLAN: Final = replace(
    plan_for(Path()), folder=None, started_at=Instant(NS_PER_MS), channels={"axis1": ("a", "b")}
)


# ---- in memory -----------------------------------------------------------------------------------------


def recorded(keep_all: bool = True) -> MemoryRecorder:
    """A short run with something of everything."""
    planned = (PlannedSetPoint(Duration(2 * NS_PER_MS), 0, "now 100 r/min"),)
    recorder = MemoryRecorder(replace(PLAN, set_points=planned), keep_all=keep_all)
    recorder.event(Instant(ZERO - 5), "INFO", "set up")
    recorder.begin(ZERO)
    recorder.tap(1).frame("rx", 0x181, b"\x37", False, False, Instant(ZERO + 900))
    recorder.tap().frame("tx", 0x80, b"", False, False, Instant(ZERO + 7))
    for record in RECORDS:
        recorder.record(record)
    (row,) = blocks((KIND_CODES["bus_off"], 4 * NS_PER_MS, 3, 0, 0, 2 * NS_PER_MS))
    recorder.fault_block(int(row["length"]), row["block"].tobytes())
    recorder.load(Instant(ZERO + NS_PER_MS), "axis1", 0.5, 1.0)
    recorder.state(Instant(ZERO + 5 * NS_PER_MS), "phase", "stopping")
    return recorder


def in_memory() -> Run:
    recorder = recorded()
    return Run(BENCH, recorder, summary=recorder.close(whole_outcome(len(RECORDS))))


def test_a_run_in_memory_has_the_rows_of_its_recording_in_run_time() -> None:
    run = in_memory()
    expected = rows_of(RECORDS)
    assert run.rows["due_at"].tolist() == (expected["due_at"] - ZERO).tolist()
    assert run.column("sequence").tolist() == expected["sequence"].tolist()
    assert run.axis().channel("b").tolist() == expected["channel_1"].tolist()
    assert (run.summary.cycles, run.digest) == (20, run.summary.digest)


def test_a_run_in_memory_tells_what_events_jsonl_would() -> None:
    sent = RECORDS[2].sending
    assert sent is not None
    bus_off = "injected bus off: node 3"
    assert in_memory().events == [
        {"at_ns": -5, "level": "INFO", "text": "set up"},
        {"at_ns": 0, "begin": True},
        {"at_ns": sent.handed_at - ZERO, "level": "INFO", "text": "now 100 r/min"},
        {
            "at_ns": 4 * NS_PER_MS,
            "level": "WARN",
            "text": "injected: bus off, node 3, it recovers after 2 ms",
        },
        {"at_ns": 4 * NS_PER_MS, "track": bus_off, "state": "active"},
        {"at_ns": 5 * NS_PER_MS, "track": "phase", "state": "stopping"},
    ], "the bus off lasts beyond the last thing that anybody said"


def test_a_fault_that_was_over_by_the_last_event_is_over() -> None:
    recorder = recorded()
    recorder.event(Instant(ZERO + 6 * NS_PER_MS), "INFO", "the end")
    told, zero = recorder.told()
    assert zero == ZERO
    assert told[-2:] == [
        TextEvent(Instant(ZERO + 6 * NS_PER_MS), "INFO", "the end"),
        StateEvent(Instant(ZERO + 6 * NS_PER_MS), "injected bus off: node 3", "-"),
    ]
    assert LoadEvent(Instant(ZERO + NS_PER_MS), "axis1", 0.5, 1.0) in told


def test_what_is_not_kept_is_not_told() -> None:
    told, _ = recorded(keep_all=False).told()
    assert [event for event in told if isinstance(event, StateEvent)] == [
        StateEvent(Instant(ZERO + 5 * NS_PER_MS), "phase", "stopping")
    ]
    assert BeginEvent(ZERO) in told


def test_a_run_in_memory_has_its_frames_in_order_of_time() -> None:
    wire = in_memory().wire
    assert wire.frames == [
        SeenFrame(Instant(7), True, 0x80, b""),
        SeenFrame(Instant(900), False, 0x181, b"\x37"),
    ]
    assert (wire.zero, wire.recording) == (0, None)


def test_a_run_in_memory_has_no_folder_to_look_into() -> None:
    run = in_memory()
    with pytest.raises(ValueError, match=r"^this run was not recorded; run it with record=DIR$"):
        run.folder  # noqa: B018
    assert run.place == "\nrecording: none was asked for"
    with pytest.raises(AssertionError) as caught:
        run.wire.assert_seen("7..#05")
    assert str(caught.value).splitlines()[0] == "no frame 7..#05 among 2:"


# ---- in a folder ---------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run as a logger leaves it."""
    (tmp_path / "bench.toml").write_text(BENCH.resolved_text())
    write(tmp_path, {"first_cycle_bench_ns": str(ZERO), "bench": "ling2012"})
    write_summary(tmp_path, summary())
    Sealer(tmp_path).finish()
    return tmp_path


def write(folder: Path, metadata: dict[str, str]) -> None:
    writer = RecordsWriter(folder / "records.arrow")
    writer.begin(metadata, ZERO)
    writer.write(rows_of(RECORDS))
    writer.close()


def test_a_run_is_opened_by_its_folder_or_a_file_of_it(folder: Path) -> None:
    opened = open_run(folder)
    for name in ("records.arrow", "summary.json", "run.rrd"):
        assert open_run(folder / name) == opened
    assert opened.folder == folder
    assert opened.metadata["first_cycle_bench_ns"] == str(ZERO)
    assert (opened.axes, opened.first_cycle, opened.summary) == (("axis1",), ZERO, summary())
    assert opened.cycles_planned == BENCH.bench.duration_s * 1_000
    assert opened.title() == f"ling2012 ({folder})"
    (axis,) = opened.review.axes
    assert axis.acceleration_max_rad_s2 == pytest.approx(
        BENCH.drive["axis1"].limits.torque_max_nm / BENCH.drive["axis1"].motor.parameters.inertia_kg_m2
    )
    assert opened.review.limits == BENCH.verdict.limits


def test_its_rows_are_in_run_time_or_on_the_bench_s_clock(folder: Path) -> None:
    run = open_run(folder)
    due = rows_of(RECORDS)["due_at"]
    assert np.concatenate([rows["due_at"] for rows in run.rows()]).tolist() == (due - ZERO).tolist()
    assert np.concatenate([rows["due_at"] for rows in run.bench_rows()]).tolist() == due.tolist()
    signals = signals_of(run)
    assert signals.deadline_ns == BENCH.loop.deadline
    times, values = signals.signals["axis1/speed/reference"].points()
    assert times.tolist() == (due - ZERO).tolist()
    assert values.tolist() == [0.0] * 20


Spoil = Callable[[Path], object]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (
            lambda at: (at / "bench.toml").unlink(),
            "{0}: found 'no bench.toml', expected the folder of a recording; hil runs DIR lists them",
        ),
        (
            lambda at: (at / "records.arrow").unlink(),
            "{0}: found 'no records.arrow', expected the folder of a recording; hil runs DIR lists them",
        ),
        (
            lambda at: (at / "summary.json").unlink(),
            "RUN: found '{0}', expected a run with its summary.json; hil recover ends it",
        ),
    ],
)
def test_what_is_no_whole_run_is_refused(folder: Path, spoil: Spoil, told: str) -> None:
    spoil(folder)
    with pytest.raises(BadInput) as caught:
        open_run(folder)
    assert str(caught.value) == told.format(folder)


@pytest.mark.parametrize(
    ("written_in", "read"),
    [("1", True), ("2", True), ("3", True), (str(int(FORMAT) + 1), False), ("0", False), ("x", False)],
)
def test_a_recording_of_another_format_is_refused(folder: Path, written_in: str, read: bool) -> None:
    (folder / "seal").unlink()
    write(folder, {"first_cycle_bench_ns": "0", "format": written_in})
    if read:
        run = open_run(folder)
        assert isinstance(run, RecordedRun)
        assert (len(NAMES) - 1 in run.review.digested) is (written_in == "3")  # the last column
        return
    with pytest.raises(BadInput) as caught:
        open_run(folder)
    assert (
        str(caught.value)
        == f"RUN: format: found '{written_in}', expected a recording of format 1 to {FORMAT}"
    )


@pytest.mark.parametrize("left", [b"", b"ARROW1"])
def test_records_whose_head_was_cut_off_are_told_by_file(folder: Path, left: bytes) -> None:
    (folder / "seal").unlink()
    (folder / "records.arrow").write_bytes(left)
    with pytest.raises(BadInput) as caught:
        open_run(folder)
    assert str(caught.value) == (
        f"{folder / 'records.arrow'}: found 'no head in {len(left)} bytes', "
        "expected cycle records as they were written: it is damaged"
    )
