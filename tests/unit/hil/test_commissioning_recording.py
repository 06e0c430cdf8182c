"""A commissioning is recorded like a run: its frames open as a log, its events say what was done."""

import json
import shutil
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.recorded.commissioning_page import commissioning_page
from servobench.hil.rows.run_files import COMMISSIONING_RECORDING, EVENTS_FILE
from tests.commissioning import unknown_world
from tests.recorded_frames import candump, directions
from tests.rrd_columns import columns, lane, numbers


def events(folder: Path) -> list[dict[str, Any]]:
    """Of the recording below ``folder``."""
    lines = (folder / COMMISSIONING_RECORDING / EVENTS_FILE).read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.fixture(scope="module")
def commissioned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Through the proof of the watch, and put back."""
    folder = tmp_path_factory.mktemp("recorded")
    _, result, _ = unknown_world(4, folder, last_step="watchdog")
    assert result.passed
    return folder


def test_every_frame_is_there_with_who_sent_it(commissioned: Path) -> None:
    recording = commissioned / COMMISSIONING_RECORDING
    with can.CanutilsLogReader(candump(recording)) as log:
        frames = list(log)
    ways = directions(recording)
    assert len(frames) == len(ways) > 500
    stamps = [frame.timestamp for frame in frames]
    assert stamps == sorted(stamps)
    sent = {frame.arbitration_id for frame, way in zip(frames, ways, strict=True) if way == "T"}
    received = {frame.arbitration_id for frame, way in zip(frames, ways, strict=True) if way == "R"}
    assert {0x000, 0x080, 0x601, 0x77F} <= sent
    assert {0x181, 0x581, 0x701} <= received
    # what was written is put back: the end is in it too
    assert any(frame.data[:1] == b"\x2f" for frame in frames[-400:] if frame.arbitration_id == 0x601)


def test_it_opens_by_hil_trace(commissioned: Path) -> None:
    done = CliRunner().invoke(app, ["trace", str(commissioned / COMMISSIONING_RECORDING)])
    assert done.exit_code == 0, done.stderr
    assert "8130h" in done.stdout, "the EMCY of the proof of the watch"


def test_its_events_say_what_was_done(commissioned: Path) -> None:
    found = events(commissioned)
    assert found[0]["at_ns"] == 0
    assert "0 ns is (1000000000.000000) of frames.arrow" in found[0]["text"]
    steps = [event["state"] for event in found if event.get("track") == "step"]
    assert steps == ["bus", "identity", "dump", "units", "setup", "stop", "watchdog"]
    texts = [event["text"] for event in found if "text" in event]
    assert "Adapter and bus: done" in texts
    assert any("EMCY 8130h" in text for text in texts)
    assert any("objects hold again what they held before" in text for text in texts)
    assert [event["at_ns"] for event in found] == sorted(event["at_ns"] for event in found)


def test_what_failed_stands_in_the_events(tmp_path: Path) -> None:
    _, result, _ = unknown_world(1, tmp_path, lacks=("1016", "100C", "100D"), last_step="watchdog")
    assert result.error is not None
    levels = {event["level"]: event["text"] for event in events(tmp_path) if "level" in event}
    assert "failed" in levels["ERROR"]
    assert levels["CRITICAL"] == str(result.error)


def test_a_folder_of_a_commissioning_is_no_run(commissioned: Path) -> None:
    done = CliRunner().invoke(app, ["runs", str(commissioned), "--json"])
    assert json.loads(done.stdout)["runs"] == []


def test_its_page_has_the_steps_the_states_and_the_shaft(commissioned: Path) -> None:
    page = commissioning_page(commissioned)
    at, steps = lane(page, "step")
    told = [event for event in events(commissioned) if event.get("track") == "step"]
    assert at.tolist() == [event["at_ns"] for event in told]
    assert len(steps) == len(told)
    _, states = lane(page, "drive")
    assert ["Operation enabled"] in states
    assert ["Quick stop active"] in states, "the proof of the watch"
    _, texts = columns(page, "/events", "TextLog:text")
    assert any("8130h" in str(text) for text in texts)
    _, ((figures,),) = columns(page, "/figures", "TextDocument:text")
    results = [
        row.split("|")[3].strip().strip("*") for row in str(figures).splitlines() if row.startswith("| ")
    ]
    assert max(map(len, results)) <= 52, "a cell shows one line, and cuts off what is longer"


@pytest.mark.long
def test_its_positions_are_those_of_the_frames(tmp_path: Path) -> None:
    """Of a shaft that has turned: the same at the same instants, but for one unit."""
    unknown_world(4, tmp_path, last_step="polarity")
    times, turns = numbers(commissioning_page(tmp_path), "/position/6064h")
    with can.CanutilsLogReader(candump(tmp_path / COMMISSIONING_RECORDING)) as log:
        read = [frame for frame in log if frame.arbitration_id == 0x181 and len(frame.data) == 8]
    counts = {
        round((frame.timestamp - 1e9) * 1e6): int.from_bytes(frame.data[4:8], "little", signed=True)
        for frame in read
    }
    seen = np.array([counts[at // 1000] for at in times.tolist()], float)
    assert np.ptp(turns) > 0.05
    unit = np.ptp(turns) / np.ptp(seen)
    np.testing.assert_allclose(turns, unit * seen, atol=1e-9)
    assert turns.max() == pytest.approx(unit * max(counts.values()))


def test_a_commissioning_that_was_killed_has_a_page_too(commissioned: Path, tmp_path: Path) -> None:
    left = tmp_path / "left" / COMMISSIONING_RECORDING
    shutil.copytree(commissioned / COMMISSIONING_RECORDING, left, ignore=shutil.ignore_patterns("*.rrd"))
    text = (left / EVENTS_FILE).read_text()
    (left / EVENTS_FILE).write_text(text[:-20])
    _, figures = columns(commissioning_page(left.parent), "/figures", "TextDocument:text")
    assert "did not come to its end" in str(figures)
