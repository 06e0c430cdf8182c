"""``hil init`` as it is typed: what it writes runs and passes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.machine.extras import examples_folder
from servobench.hil.terminal.init import FIRST
from tests.scenario.processes import quiet_environment


def _init(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["init", *words])
    return result.exit_code, result.output


def test_a_first_bench_runs_and_its_tests_pass(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "bench"
    status, text = _init(str(folder))
    assert status == 0, text
    assert {path.name for path in folder.iterdir()} == {
        "bench.toml", "motor.toml", "controller.py", "test_controller.py", "sweep.toml"
    }  # fmt: skip
    assert "hil run bench.toml" in text
    environment = {**quiet_environment(), "PYTHONDONTWRITEBYTECODE": "1"}
    for words in (
        ["-m", "servobench.hil.cli", "run", "bench.toml", "--no-record"],
        ["-m", "pytest", "-p", "no:cacheprovider"],
    ):
        done = subprocess.run(
            [sys.executable, *words],
            cwd=folder, env=environment, capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout


def test_nothing_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "motor.toml").write_text("mine")
    status, text = _init(str(tmp_path))
    assert status == 2
    assert "motor.toml" in text.replace("\n", "")
    assert [path.name for path in tmp_path.iterdir()] == ["motor.toml"]


def test_a_file_is_no_folder_to_write_in(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    status, text = _init(str(tmp_path / "taken" / "bench"))
    assert status == 2
    assert "a place to write to" in " ".join(text.split())


def test_every_example_is_written(tmp_path: Path) -> None:
    assert _init(str(tmp_path), "--examples")[0] == 0
    there = {path.relative_to(tmp_path / "examples") for path in (tmp_path / "examples").rglob("*.toml")}
    assert Path("ling2012.toml") in there
    assert there == {path.relative_to(examples_folder()) for path in examples_folder().rglob("*.toml")}


def test_a_wheel_has_the_examples_within(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / "site"
    shutil.copytree(examples_folder() / FIRST, installed / "hil" / "examples" / FIRST)
    monkeypatch.setattr("servobench.hil.machine.extras.ROOT", installed)
    assert examples_folder() == installed / "hil" / "examples"
    monkeypatch.chdir(tmp_path)
    assert _init("here")[0] == 0
    assert (tmp_path / "here" / "bench.toml").exists()


def test_a_shell_completes_commands() -> None:
    environment = {
        **os.environ,
        "_HIL_COMPLETE": "complete_bash",
        "COMP_WORDS": "hil comm",
        "COMP_CWORD": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", "from servobench.hil.cli import app; app(prog_name='hil')"],
        env=environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "commission" in done.stdout, done.stderr
