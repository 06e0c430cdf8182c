"""Which recordings somebody asked for, each condition alone and at its limit; how controllers are named."""

import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.reviewing.run_index import ListedRun, RunFilter, RunState, list_runs

AT = datetime(2026, 3, 1, 12, tzinfo=UTC)
RUN = ListedRun(
    "runs/a",
    AT,
    RunState.WHOLE,
    bench="Speed Bench",
    drives=("Maker X", "Other Y"),
    controllers=("pid", "own Mpc"),
    verdict="not passed",
    commit="abc123",
)
BARE = ListedRun("runs/b", AT, RunState.NO_SUMMARY)


@pytest.mark.parametrize(
    ("asked", "run", "wanted"),
    [
        (RunFilter(), RUN, True),
        (RunFilter(), BARE, True),
        (RunFilter(bench="bench"), RUN, True),
        (RunFilter(bench="SPEED B"), RUN, True),
        (RunFilter(bench="speedb"), RUN, False),
        (RunFilter(bench="a"), BARE, False),
        (RunFilter(drive="maker"), RUN, True),
        (RunFilter(drive="y"), RUN, True),
        (RunFilter(drive="z"), RUN, False),
        (RunFilter(drive="x"), BARE, False),
        (RunFilter(controller="MPC"), RUN, True),
        (RunFilter(controller="pid"), RUN, True),
        (RunFilter(controller="hinf"), RUN, False),
        (RunFilter(controller="pid"), BARE, False),
        (RunFilter(verdict="Not"), RUN, True),
        (RunFilter(verdict="passed"), RUN, False),
        (RunFilter(verdict="no summary"), RUN, False),
        (RunFilter(verdict="no summary"), BARE, True),
        (RunFilter(verdict="whole"), RUN, False),
        (RunFilter(commit="abc"), RUN, True),
        (RunFilter(commit="bc"), RUN, False),
        (RunFilter(commit="ABC"), RUN, False),
        (RunFilter(commit="a"), BARE, False),
        (RunFilter(since=AT), RUN, True),
        (RunFilter(since=AT + timedelta(microseconds=1)), RUN, False),
        (
            RunFilter(bench="speed", drive="maker", controller="own", verdict="not", commit="a", since=AT),
            RUN,
            True,
        ),
        (
            RunFilter(bench="speed", drive="maker", controller="own", verdict="not", commit="b", since=AT),
            RUN,
            False,
        ),
    ],
)
def test_a_run_is_wanted_where_all_that_is_asked_for_holds(
    asked: RunFilter, run: ListedRun, wanted: bool
) -> None:
    assert asked.wants(run) is wanted


def test_a_run_for_programs_has_plain_values() -> None:
    assert replace(RUN, cycles=7, note="n").as_json() == {
        "path": "runs/a", "at": "2026-03-01T12:00:00+00:00", "state": "whole", "bench": "Speed Bench",
        "drives": ("Maker X", "Other Y"), "controllers": ("pid", "own Mpc"), "verdict": "not passed",
        "reason": "", "cycles": 7, "commit": "abc123", "servobench": "", "bus": "", "note": "n", "seal": "",
    }  # fmt: skip


def left(folder: Path, bench: str, summary: str = "", at: datetime = AT) -> Path:
    """What a run without records has left."""
    folder.mkdir(parents=True)
    (folder / "bench.toml").write_text(bench)
    os.utime(folder / "bench.toml", (at.timestamp(), at.timestamp()))
    (folder / ("summary.json" if summary else "events.jsonl")).write_text(summary)
    return folder


@pytest.mark.parametrize(
    ("drive", "controllers"),
    [
        ('controller = "file.toml"', ("file.toml",)),
        ('controller = ""', ("",)),
        ("node = 1", ("",)),
        ('controller = { kind = "pid" }', ("pid",)),
        ('controller = { kind = "own", object = "mine.py:Mpc" }', ("own mine.py:Mpc",)),
        ('controller = { object = "mine.py:Mpc" }', (" mine.py:Mpc",)),
        ("controller = { }", ("",)),
    ],
)
def test_a_controller_is_named_by_its_kind_and_its_class(
    tmp_path: Path, drive: str, controllers: tuple[str, ...]
) -> None:
    left(tmp_path / "a", f'[bench]\nname = "b"\n[drive.a]\n{drive}\n')
    (run,) = list_runs(tmp_path)
    assert run == ListedRun(
        str(tmp_path / "a"),
        AT,
        RunState.NO_SUMMARY,
        "b",
        (),
        controllers,
        note=f"its recorder did not live to its end: hil recover {tmp_path / 'a'}",
    )


@pytest.mark.parametrize(
    ("bench", "summary", "told"),
    [
        ("drive = 3", '{"cycles": 5}', {}),
        ("bench = 3\n[drive]\na = 1", '{"cycles": "5", "verdict": 7}', {"controllers": ("",)}),
        ("[[", '{"cycles": 5.5}', {}),
        (
            "",
            '{"verdict": {"outcome": "passed", "reason": "all kept"}}',
            {},
        ),
    ],
)
def test_files_of_another_kind_tell_nothing(
    tmp_path: Path, bench: str, summary: str, told: dict[str, object]
) -> None:
    left(tmp_path / "a", bench, summary)
    bare = ListedRun(str(tmp_path / "a"), AT, RunState.DAMAGED, note="records.arrow is missing")
    assert list_runs(tmp_path) == [replace(bare, **told)]  # type: ignore[arg-type]


def test_runs_are_listed_by_time_and_those_of_one_time_by_folder(tmp_path: Path) -> None:
    for name, hours in (("c", 0), ("a", 1), ("b", 0), ("d", -1)):
        left(tmp_path / name, "", at=AT + timedelta(hours=hours))
    assert [Path(run.path).name for run in list_runs(tmp_path)] == ["d", "b", "c", "a"]
    wanted = RunFilter(since=AT + timedelta(minutes=1))
    assert [Path(run.path).name for run in list_runs(tmp_path, wanted)] == ["a"]


def test_a_run_lies_six_folders_below_at_most(tmp_path: Path) -> None:
    left(tmp_path.joinpath(*"12345", "six"), "")
    left(tmp_path.joinpath(*"abcdef", "seven"), "")
    assert [Path(run.path).name for run in list_runs(tmp_path)] == ["six"]
    assert [Path(run.path).name for run in list_runs(tmp_path / "a")] == ["seven"]


def test_no_folder_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "none"
    with pytest.raises(BadInput) as caught:
        list_runs(path)
    assert str(caught.value) == f"DIR: found {str(path)!r}, expected a folder"
