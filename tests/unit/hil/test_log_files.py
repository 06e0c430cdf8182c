"""The keepers beyond what the recorder's tests show: blocks, the live view, and starting a viewer."""

import socket
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.hil.recording.log_files import FramesKeeper, RowBlocks
from servobench.hil.recording.logger import open_keepers
from servobench.hil.recording.page_keepers import LiveKeeper, RerunKeeper
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.events import FaultEntries
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.run_files import RERUN_FILE
from servobench.hil.rows.side_rows import FRAME, FRAME_DTYPE
from servobench.hil.verdict.figures import Figures
from servobench.hil.verdict.summary import Summary, summarise
from tests.recorded_frames import candump_text, directions
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import rows_of
from tests.unit.hil.synthetic_run import synthetic_records
from tests.unit.hil.test_summary import FIGURES

NO_FRAMES = np.empty(0, FRAME_DTYPE)


@pytest.fixture
def viewers(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Command lines of the viewers that would have been started."""
    found: list[list[str]] = []

    start = subprocess.Popen

    def pretend(command: list[str], **options: Any) -> Any:
        if command[0] == "git":
            return start(command, **options)
        found.append(command)
        return None

    monkeypatch.setattr(subprocess, "Popen", pretend)
    return found


def summary_of(figures: Figures = FIGURES) -> Summary:
    return summarise(figures, whole_outcome(figures.cycles), plan_for(Path()).review.limits, "", 1)


def test_the_live_view_is_served_on_the_loopback_and_needs_no_viewer(
    tmp_path: Path, viewers: list[list[str]]
) -> None:
    plan = replace(plan_for(tmp_path, real_time=True), view=True)
    keeper = LiveKeeper(plan, "a-recording", Review(plan.review))
    (command,) = viewers
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    uri = command[command.index("--connect") + 1]
    host, _, port = uri.removeprefix("rerun+http://").removesuffix("/proxy").partition(":")
    assert host == "127.0.0.1"
    with socket.create_connection((host, int(port)), timeout=5):
        pass
    keeper.take(rows_of(synthetic_records(100)), NO_FRAMES, [])
    keeper.flush()
    keeper.finish(summary_of())


@pytest.mark.parametrize("abandoned", [True, False])
def test_a_page_that_is_given_up_takes_no_more_room(tmp_path: Path, abandoned: bool) -> None:
    plan, other = plan_for(tmp_path), tmp_path / "other"
    keeper = RerunKeeper(plan, tmp_path, "a-recording", Review(plan.review))
    keeper.flush()
    size = (tmp_path / RERUN_FILE).stat().st_size
    with other.open("w") as file:
        if abandoned:
            keeper.abandon()
        keeper.take(rows_of(synthetic_records(100)), NO_FRAMES, [])
        keeper.flush()
        assert ((tmp_path / RERUN_FILE).stat().st_size == size) is abandoned
        file.write("there")
    assert other.read_text() == "there"


@pytest.mark.parametrize(("view", "real_time", "live"), [(True, True, 1), (True, False, 0), (False, True, 0)])
def test_only_a_viewed_real_time_run_is_served_live(
    tmp_path: Path, viewers: list[list[str]], view: bool, real_time: bool, live: int
) -> None:
    plan = replace(plan_for(tmp_path, real_time), view=view)
    keepers = open_keepers(plan, Review(plan.review), FaultEntries(plan.started_at))
    assert sum(isinstance(keeper, LiveKeeper) for keeper in keepers) == live == len(viewers)
    for keeper in keepers:
        keeper.finish(summary_of())
    shown = [command for command in viewers if command[-1] == str(tmp_path / "run.rrd")]
    assert len(shown) == (view and not real_time)


def test_rows_are_collected_into_blocks() -> None:
    blocks = RowBlocks()
    assert blocks.take() is None
    rows = rows_of(synthetic_records(5_000))
    assert not blocks.add(rows)
    assert blocks.add(rows)
    block = blocks.take()
    assert block is not None
    assert block.size == 10_000
    assert blocks.take() is None


def test_frames_go_under_the_last_part_of_the_bus_spec(tmp_path: Path) -> None:
    plan = replace(plan_for(tmp_path), bus="socketcan:vcan0")
    keeper = FramesKeeper(plan, tmp_path)
    frames = np.frombuffer(FRAME.pack(1_000, 0x80, 0, 1, b""), FRAME_DTYPE)
    keeper.take(np.empty(0, ROW_DTYPE), frames, [])
    keeper.finish(summary_of())
    assert candump_text(tmp_path) == "(1000000000.000001) vcan0 080#\n"
    assert directions(tmp_path) == ["T"]
