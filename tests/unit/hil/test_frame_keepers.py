"""What the keepers of frames, network and faults have written after each of their calls."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import Duration, Instant
from servobench.hil.configuration.network_file import load_network
from servobench.hil.recording.append_file import FRAMES_TAIL_FILE, read_tail
from servobench.hil.recording.log_files import (
    FaultsKeeper,
    FramesKeeper,
    NetworkKeeper,
)
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import BLOCK_DTYPE, FaultEntries, RunZero
from servobench.hil.rows.recording_plan import AxisPlan, RecordingPlan, ReviewPlan
from servobench.hil.rows.side_rows import (
    FRAME_DTYPE,
    BeginEvent,
    RunEvent,
    frame_row,
)
from servobench.virtual_bus.faults.fault_log import BLOCK_BYTES, KIND_CODES, FaultLog
from tests.recorded_frames import candump_text, directions, injected
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_log_files import summary_of
from tests.unit.hil.test_recording_keepers import BEGIN, NO_FRAMES, NO_ROWS, STARTED, plan, tell

__all__ = ["plan"]


# ---- frames.arrow -------------------------------------------------------------------------------------


def frames_at(*rows: tuple[int, int]) -> NDArray[np.void]:
    """Of 80h, by instant, us, and what ``sent`` tells of direction and segment."""
    return np.frombuffer(
        b"".join(frame_row(Instant(at * 1_000), 0x80, sent, b"") for at, sent in rows), FRAME_DTYPE
    )


def put(keeper: FramesKeeper, frames: NDArray[np.void], *events: RunEvent) -> None:
    keeper.take(NO_ROWS, frames, events)
    keeper.flush()


def written(folder: Path) -> list[str]:
    """Stamps after the simulated epoch, s, with the directions."""
    if not (folder / "frames.arrow").exists():
        return []
    stamps = [line.split(")")[0][1:] for line in candump_text(folder).splitlines()]
    return [f"{float(stamp) - 1e9:.6f} {way}" for stamp, way in zip(stamps, directions(folder), strict=True)]


def test_in_simulated_time_frames_wait_for_the_first_cycle(plan: RecordingPlan, tmp_path: Path) -> None:
    keeper, tail = FramesKeeper(plan, tmp_path), tmp_path / FRAMES_TAIL_FILE
    early = frames_at((1_000, 1), (2_500, 0))
    put(keeper, early)
    assert written(tmp_path) == []
    assert read_tail(tail, FRAME_DTYPE, 0)["at"].tolist() == [1_000_000, 2_500_000]
    put(keeper, NO_FRAMES, BeginEvent(BEGIN))
    put(keeper, frames_at((3_004, 0)))
    keeper.finish(summary_of())
    assert written(tmp_path) == ["-0.002000 T", "-0.000500 R", "0.000004 R"]
    assert not tail.exists()


def test_a_run_without_a_cycle_keeps_its_frames_all_the_same(plan: RecordingPlan, tmp_path: Path) -> None:
    keeper = FramesKeeper(plan, tmp_path)
    put(keeper, frames_at((1_000, 1), (1_001, 0)))
    keeper.finish(summary_of())
    assert written(tmp_path) == ["0.000000 T", "0.000001 R"], "since the recording began"


def test_in_real_time_they_are_written_at_once_with_the_wall_clock_s_stamp(
    plan: RecordingPlan, tmp_path: Path
) -> None:
    real = replace(plan, bus="socketcan:can0", wall_offset=Duration(1_700_000_000 * 10**9))
    keeper = FramesKeeper(real, tmp_path)
    put(keeper, frames_at((1, 1)))
    put(keeper, frames_at((2_000_000, 0)))
    keeper.finish(summary_of())
    assert candump_text(tmp_path).splitlines() == [
        "(1700000000.000001) can0 080#",
        "(1700000002.000000) can0 080#",
    ]


def test_what_the_tail_has_is_what_the_log_has_not(plan: RecordingPlan, tmp_path: Path) -> None:
    two = replace(plan, segments=("second",))
    keeper, tail = FramesKeeper(two, tmp_path), tmp_path / FRAMES_TAIL_FILE
    first, second = frames_at((4_000, 1), (5_000, 1)), frames_at((4_500, 2))
    put(keeper, first, BeginEvent(BEGIN))
    held = read_tail(tail, FRAME_DTYPE, len(written(tmp_path)))
    assert len(written(tmp_path)) + held.size == 2
    put(keeper, second)
    keeper.finish(summary_of())
    names = [line.split()[1] for line in candump_text(tmp_path).splitlines()]
    assert names == ["simulated", "second", "simulated"]
    assert written(tmp_path) == ["0.001000 T", "0.001500 R", "0.002000 T"]


def test_a_frame_that_came_after_its_time_was_written_is_told(plan: RecordingPlan, tmp_path: Path) -> None:
    keeper = FramesKeeper(plan, tmp_path)
    put(keeper, frames_at((9_000_000, 1)), BeginEvent(BEGIN))
    put(keeper, frames_at((9_900_000, 1)))
    put(keeper, frames_at((4_000, 1)))
    with pytest.raises(OSError, match=r"^1 frames came too late to be put in their place of time$"):
        keeper.finish(summary_of())
    assert len(written(tmp_path)) == 3
    assert not (tmp_path / FRAMES_TAIL_FILE).exists()


# ---- network.toml, faults.arrow -----------------------------------------------------------------------


def test_the_network_of_all_rows_is_written_at_the_end(tmp_path: Path) -> None:
    review = Review(ReviewPlan((AxisPlan("axis1", 1.0),)))
    keeper = NetworkKeeper(tmp_path, review)
    rows = rows_of(synthetic_records(300))
    for chunk in (rows[:100], rows[100:]):
        review.add(chunk)
        tell(keeper, rows=chunk)
    assert list(tmp_path.iterdir()) == []
    keeper.finish(summary_of())
    network = load_network(tmp_path / "network.toml")
    assert (network.period_us, network.cycles) == (1_000, 300)
    assert network.lost == int((rows["fate"] == 1).sum())


def test_without_a_reading_there_is_no_network(tmp_path: Path) -> None:
    NetworkKeeper(tmp_path, Review(ReviewPlan((AxisPlan("axis1", 1.0),)))).finish(summary_of())
    assert list(tmp_path.iterdir()) == []


def blocks(*entries: Sequence[int]) -> NDArray[np.void]:
    """Rows of the ring of faults, with these entries: code, at_ns, link, can_id, n, and its own numbers."""
    log, rows = FaultLog(), np.zeros(1, BLOCK_DTYPE)

    def sink(length: int, block: bytes) -> None:
        rows["length"] = length
        rows["block"] = np.frombuffer(block.ljust(BLOCK_BYTES, b"\0"), np.uint8)

    log.send_to(sink)
    for entry in entries:
        log.note(*entry)
    log.flush()
    return rows


def test_faults_wait_for_the_first_cycle_and_are_told_once(tmp_path: Path) -> None:
    entries = FaultEntries(STARTED)
    keeper, zero = FaultsKeeper(tmp_path, entries), RunZero(STARTED)
    loss, boot = KIND_CODES["loss"], KIND_CODES["boot"]
    assert entries.take(blocks((boot, 500, 3, 0x703, 0), (loss, 900, 0, 0x181, 4)), zero) == []
    tell(keeper)
    assert injected(tmp_path) == []
    zero.look([BeginEvent(BEGIN)])
    told = entries.take(np.empty(0, BLOCK_DTYPE), zero)
    assert [entry.at_ns for entry in told] == [500 + STARTED - BEGIN, 900], (
        "a slow drive counts from power-on"
    )
    tell(keeper)
    entries.take(blocks((loss, 950, 0, 0x181, 5)), zero)
    tell(keeper)
    keeper.finish(summary_of())
    assert [(entry["kind"], entry["at_ns"]) for entry in injected(tmp_path)] == [
        ("boot", 500 + STARTED - BEGIN),
        ("loss", 900),
        ("loss", 950),
    ]


def test_at_the_end_faults_wait_no_more(tmp_path: Path) -> None:
    entries = FaultEntries(STARTED)
    zero = RunZero(STARTED)
    entries.take(blocks((KIND_CODES["late"], 70, 3, 0x703, 0)), zero)
    (late,) = entries.take(np.empty(0, BLOCK_DTYPE), zero, at_end=True)
    assert late.at_ns == 70, "without a cycle times count from the start of the recording"
    assert entries.take(np.empty(0, BLOCK_DTYPE), zero, at_end=True) == []
    del tmp_path
