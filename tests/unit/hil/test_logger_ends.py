"""The end of a logger's run: what cannot be written, the files of the folder, and the process itself."""

import json
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.recording import logger as module
from servobench.hil.recording.log_files import LIVE_VIEW, Keeper
from servobench.hil.recording.logger import main
from servobench.hil.rows.events import ENTRY_DTYPE
from servobench.hil.rows.faults_file import FaultsWriter, read_faults
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import Rows
from servobench.hil.rows.side_rows import RunEvent
from servobench.hil.verdict.verdict import VerdictKind
from tests.recorded_frames import injected
from tests.unit.hil.logger_fakes import (
    LOSS,
    NOTHING_KEPT,
    OUTCOME,
    Clock,
    Input,
    Kept,
    Rings,
    clock,
    keepers,
    kept,
    log,
    put_faults,
    rings,
)
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.row_tools import plain_rows

__all__ = ["clock", "keepers", "kept", "rings"]


# ---- what cannot be written --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fails_at", "calls"),
    [
        ("take", ["take"]),
        ("flush", ["take", "take", "flush"]),
        ("finish", ["take", "take", "flush", "finish"]),
    ],
)
def test_who_cannot_write_is_given_up_and_told_and_the_others_go_on(
    rings: Rings, keepers: list[Keeper], clock: Clock, fails_at: str, calls: list[str]
) -> None:
    broken, whole = Kept("x.log", fails_at), Kept()
    keepers += [broken, whole]
    summary, told = log(rings, Input(clock, [OUTCOME]))
    assert (broken.calls, whole.calls) == (calls, ["take", "take", "flush", "finish"])
    fault = "x.log is incomplete: [Errno 28] no  room\nleft"
    assert summary.recording_faults == (fault,)
    assert told == ["failed x.log is incomplete: [Errno 28] no room left"], "in one line"
    assert summary.verdict.outcome is VerdictKind.NOT_RECORDED


def test_nothing_is_stored_any_more_where_a_file_cannot_be_written(
    rings: Rings, keepers: list[Keeper], clock: Clock
) -> None:
    keepers.append(Kept("x.log", "take"))
    _, told = log(rings, Input(clock, ["confirm", OUTCOME]))
    assert told == ["failed x.log is incomplete: [Errno 28] no room left"]


def test_a_live_view_that_is_closed_is_no_fault_of_the_recording(
    rings: Rings, keepers: list[Keeper], clock: Clock
) -> None:
    view = Kept(LIVE_VIEW, "take")
    keepers.append(view)
    summary, told = log(rings, Input(clock, ["confirm", OUTCOME]))
    assert (view.calls, summary.recording_faults, told) == (["take"], (), ["stored"])


# ---- the folder --------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", [True, False])
def test_injected_faults_are_kept_where_the_plan_wants_them(
    rings: Rings, keepers: list[Keeper], clock: Clock, tmp_path: Path, wanted: bool
) -> None:
    put_faults(rings, LOSS)
    log(rings, Input(clock, [OUTCOME]), replace(plan_for(tmp_path), faults=wanted))
    files = {"seal", "summary.json"} | ({"faults.arrow"} if wanted else set())
    assert {path.name for path in tmp_path.iterdir()} == files, "the room for the end is given back"
    if wanted:
        (entry,) = injected(tmp_path)
        assert (entry["kind"], entry["at_ns"]) == ("loss", 4 * NS_PER_MS)
    del keepers


def test_without_a_folder_no_faults_are_kept_either(
    rings: Rings, kept: Kept, clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    summary, _ = log(rings, Input(clock, [OUTCOME]), replace(NOTHING_KEPT, faults=True))
    assert (summary.recording, summary.seed) == ("", 2012)
    assert list(tmp_path.iterdir()) == []
    assert kept.calls[-1] == "finish"


def test_the_room_for_the_end_is_there_until_the_last_files_are_written(
    rings: Rings, keepers: list[Keeper], clock: Clock, tmp_path: Path
) -> None:
    sizes: list[int] = []

    class Watching(Kept):
        def _called(self, what: str) -> None:
            super()._called(what)
            sizes.append((tmp_path / ".reserve").stat().st_size)

    keepers.append(Watching())
    summary, _ = log(rings, Input(clock, [OUTCOME]), plan_for(tmp_path))
    assert sizes == [256 * 1024] * 3 + [32 * 1024]
    assert summary.recording == str(tmp_path)
    assert not (tmp_path / ".reserve").exists()


def test_a_summary_that_cannot_be_written_is_told(
    rings: Rings, kept: Kept, clock: Clock, tmp_path: Path
) -> None:
    (tmp_path / "summary.json").mkdir()
    summary, told = log(rings, Input(clock, [OUTCOME]), plan_for(tmp_path))
    assert summary.recording_faults == ("summary.json: Is a directory",)
    assert told == ["failed summary.json: Is a directory"]
    assert kept.summary is not None
    assert kept.summary.recording_faults == ()


@pytest.mark.parametrize("fails_at", ["take", "finish"])
@pytest.mark.parametrize(
    ("name", "tried"), [("records.arrow", True), ("records.tail", False), ("run.rrd", False)]
)
def test_records_that_were_given_up_are_made_whole_with_the_room_that_was_kept(
    rings: Rings,
    keepers: list[Keeper],
    clock: Clock,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    tried: bool,
    fails_at: str,
) -> None:
    calls: list[tuple[Path, int]] = []

    def whole(plan: RecordingPlan, folder: Path) -> list[str]:
        del plan
        calls.append((folder, (folder / ".reserve").stat().st_size))
        return ["2 rows lost", "and more"]

    monkeypatch.setattr(module, "whole_records", whole)
    keepers.append(Kept(name, fails_at))
    summary, _ = log(rings, Input(clock, [OUTCOME]), plan_for(tmp_path))
    assert calls == ([(tmp_path, 32 * 1024)] if tried else [])
    assert summary.recording_faults[1:] == (("2 rows lost", "and more") if tried else ())


@pytest.mark.parametrize("fails_at", ["take", "finish"])
def test_faults_that_were_given_up_have_their_end(
    rings: Rings, keepers: list[Keeper], clock: Clock, tmp_path: Path, fails_at: str
) -> None:
    path = tmp_path / "faults.arrow"

    class Cut(Kept):
        """Puts a batch into the file, and never its end."""

        def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:
            writer = FaultsWriter(path)
            writer.write(np.zeros(3, ENTRY_DTYPE))
            writer.drop()
            super().take(rows, frames, events)

    keepers.append(Cut("faults.arrow", fails_at))
    log(rings, Input(clock, [OUTCOME]), plan_for(tmp_path))
    assert len(read_faults(path).entries) == 3


def test_records_that_cannot_be_made_whole_are_incomplete_and_no_more(
    rings: Rings, keepers: list[Keeper], clock: Clock, tmp_path: Path
) -> None:
    """There is no such file: it could not even be begun."""
    keepers.append(Kept("records.arrow", "take"))
    (tmp_path / "records.arrow").mkdir()
    summary, _ = log(rings, Input(clock, [OUTCOME]), plan_for(tmp_path))
    assert len(summary.recording_faults) == 1
    assert (tmp_path / "summary.json").exists()


# ---- the process -------------------------------------------------------------------------------------


class Process(NamedTuple):
    signals: dict[int, object]
    policies: list[tuple[int, int, int]]
    ends: list[int]


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Process:
    """What the program does to its own process."""
    found = Process({}, [], [])
    monkeypatch.setattr(signal, "signal", found.signals.__setitem__)
    monkeypatch.setattr(
        os,
        "sched_setscheduler",
        lambda pid, policy, param: found.policies.append((pid, policy, param.sched_priority)),
    )
    monkeypatch.setattr(os, "_exit", found.ends.append)
    return found


def run_main(
    monkeypatch: pytest.MonkeyPatch, said: str, descriptors: Sequence[int] = (), *more: str
) -> int | None:
    """Its status, if it has one of its own; with ``said`` on its input."""
    read_end, write_end = os.pipe()
    os.write(write_end, said.encode())
    os.close(write_end)
    monkeypatch.setattr(sys, "argv", ["logger", *map(str, descriptors), *more])
    with os.fdopen(read_end) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        return main()


def test_the_program_logs_a_run_and_prints_its_summary(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], process: Process, rings: Rings
) -> None:
    rings.cycles(plain_rows(3))
    plan = json.dumps(NOTHING_KEPT.as_json())
    run_main(monkeypatch, f"{plan}\n{OUTCOME}\n", rings.descriptors, "something else")
    ready, summary = capsys.readouterr().out.splitlines()
    assert ready == "ready"
    assert json.loads(summary)["cycles"] == 3
    assert process == Process(
        dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_IGN),
        [(0, os.SCHED_OTHER, 0)],
        [0],
    )


def test_without_a_plan_it_ends_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], process: Process
) -> None:
    assert run_main(monkeypatch, "half a plan") == 1
    assert capsys.readouterr().out == ""
    assert process.ends == []


def test_files_that_cannot_be_opened_are_told_instead_of_readiness(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    process: Process,
    rings: Rings,
    tmp_path: Path,
) -> None:
    plan = json.dumps(plan_for(tmp_path / "missing").as_json())
    assert run_main(monkeypatch, f"{plan}\n{OUTCOME}\n", rings.descriptors) == 1
    path = tmp_path / "missing" / ".reserve"
    assert capsys.readouterr().out == f"failed [Errno 2] No such file or directory: '{path}'\n"
    assert process.ends == []


def test_a_writer_that_died_is_told_nothing_and_its_run_is_finished_all_the_same(
    monkeypatch: pytest.MonkeyPatch, process: Process, rings: Rings
) -> None:
    said: list[str] = []

    class Gone:
        def write(self, text: str) -> None:
            said.append(text)

        def flush(self) -> None:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Gone())
    run_main(monkeypatch, json.dumps(NOTHING_KEPT.as_json()) + "\n", rings.descriptors)
    assert said[0] == "ready"
    assert json.loads(said[2])["verdict"]["reason"] == "the process of the loop died"
    assert process.ends == [0]
