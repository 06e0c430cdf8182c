"""The logger in this process: what it does when a file cannot be written, and when its input ends."""

import json
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path

import pytest

from servobench.drivers.record import replaced
from servobench.drivers.timebase import Instant
from servobench.hil.loop.cycle_record import row_of
from servobench.hil.recording.logger import Logger
from servobench.hil.recording.logger_process import LineReader
from servobench.hil.rows.side_rows import TextEvent, frame_row
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import VerdictKind
from servobench.virtual_bus.faults.fault_log import BLOCK
from tests.recorded_frames import candump_text
from tests.unit.hil.logger_fakes import Rings, made_rings
from tests.unit.hil.recording_tools import files_below, plan_for, whole_outcome
from tests.unit.hil.synthetic_run import synthetic_records

CYCLES = 300
OUTCOME = json.dumps(asdict(whole_outcome(CYCLES))).encode() + b"\n"


FAULT_BLOCKS = 1 << 4


def fill(rings: Rings, doubled: int = 0) -> None:
    """``doubled``: number of a cycle whose row stands in the place of the next one's too."""
    for record in synthetic_records(CYCLES):
        again = doubled and record.sequence == doubled + 1
        rings.rows.push(row_of(replaced(record, sequence=doubled) if again else record))
        rings.frames.push(frame_row(record.due_at, 0x80, 1, b""))
    rings.tell(TextEvent(Instant(0), "WARN", "load"))


@pytest.fixture
def rings() -> Iterator[Rings]:
    with made_rings(1 << 9, 1 << 9, 1 << 4, FAULT_BLOCKS) as found:
        yield found


def run_logger(
    folder: Path,
    rings: Rings,
    said: bytes,
    within: AbstractContextManager[None] | None = None,
    doubled: int = 0,
) -> Summary:
    """The logger over filled rings, with ``said`` on its input, once it has started ``within`` something."""
    fill(rings, doubled)
    read_end, write_end = os.pipe()
    os.write(write_end, said)
    os.close(write_end)
    try:
        logger = Logger(plan_for(folder), *rings.descriptors)
        with within or nullcontext():
            return logger.run(LineReader(read_end))
    finally:
        os.close(read_end)


def test_a_run_that_ends_as_it_should(tmp_path: Path, rings: Rings) -> None:
    summary = run_logger(tmp_path, rings, OUTCOME)
    assert summary.cycles == CYCLES
    assert summary.verdict.completed
    assert summary.recording_faults == ()


@pytest.mark.parametrize("doubled", [1, 120, CYCLES - 1])
def test_a_run_with_a_row_twice_and_another_missing_has_not_passed(
    tmp_path: Path, rings: Rings, doubled: int
) -> None:
    """As many rows as were planned: only their numbers tell."""
    verdict = run_logger(tmp_path, rings, OUTCOME, doubled=doubled).verdict
    assert verdict.outcome is VerdictKind.CUT_SHORT
    assert not verdict.completed
    assert verdict.reason == f"rows are missing or double behind cycle {doubled}"


def test_an_input_that_ends_means_a_dead_writer(tmp_path: Path, rings: Rings) -> None:
    summary = run_logger(tmp_path, rings, b"")
    assert summary.cycles == CYCLES
    assert not summary.verdict.passed
    assert summary.verdict.reason == "the process of the loop died"


@pytest.mark.parametrize(("lost", "told"), [(1, "1 block"), (2, "2 blocks")])
def test_what_found_its_ring_full_is_counted(tmp_path: Path, rings: Rings, lost: int, told: str) -> None:
    for _ in range(FAULT_BLOCKS + lost):
        rings.faults.push(BLOCK.pack(0, b""))
    (fault,) = run_logger(tmp_path, rings, OUTCOME).recording_faults
    assert fault == f"{told} of injected faults lost, the logger was too slow"


@pytest.mark.parametrize("name", ["frames.arrow", "events.jsonl", "records.arrow"])
def test_a_full_disk_under_one_file_spoils_only_that_file(tmp_path: Path, rings: Rings, name: str) -> None:
    (tmp_path / name).symlink_to("/dev/full")
    summary = run_logger(tmp_path, rings, OUTCOME)
    assert summary.cycles == CYCLES
    (fault,) = summary.recording_faults
    assert fault.startswith(f"{name} is incomplete: ")
    assert json.loads((tmp_path / "summary.json").read_text())["recording_faults"] == [fault]
    for other in {"frames.arrow", "events.jsonl", "records.arrow", "run.rrd"} - {name}:
        assert (tmp_path / other).stat().st_size > 0


def test_a_disk_that_fills_up_under_the_telemetry_is_told(rings: Rings, tmp_path: Path) -> None:
    # the rows have 122 kB as they come, run.rrd with its layout and envelopes 150
    summary = run_logger(tmp_path, rings, OUTCOME, files_below(126_000))
    assert summary.cycles == CYCLES
    (fault,) = summary.recording_faults
    assert fault.startswith("run.rrd is incomplete: the telemetry cannot be written")
    assert len(candump_text(tmp_path).splitlines()) == CYCLES


def test_a_file_that_cannot_be_opened_ends_the_logger(rings: Rings, tmp_path: Path) -> None:
    (tmp_path / "run.rrd").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"run\.rrd: .*No space left"):
        run_logger(tmp_path, rings, OUTCOME)


def test_refused_rows_make_the_run_incomplete(tmp_path: Path, rings: Rings) -> None:
    for record in synthetic_records(512 - CYCLES + 3):
        rings.rows.push(row_of(record))
    summary = run_logger(tmp_path, rings, OUTCOME)
    assert summary.cycles == 512
    assert summary.recording_faults == ("3 cycle records lost, the logger was too slow",)
    assert summary.verdict.outcome is VerdictKind.NOT_RECORDED
    assert not summary.verdict.completed


def test_input_comes_by_lines_however_it_is_cut() -> None:
    read_end, write_end = os.pipe()
    source = LineReader(read_end)
    assert source.line(0.0) is None
    os.write(write_end, b"one\ntw")
    assert source.line(0.0) == "one"
    assert source.line(0.0) is None
    os.write(write_end, b"o\nthree")
    assert source.line(0.0) == "two"
    os.close(write_end)
    assert source.line(0.0) is None
    assert source.ended
    os.close(read_end)
