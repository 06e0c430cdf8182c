"""The commit that a recording names, and what asking for it leaves in the user's tree."""

import os
import subprocess
from pathlib import Path

import pytest

from servobench.drivers.timebase import Instant
from servobench.hil.recording import run_metadata
from tests.unit.hil.recording_tools import plan_for


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.com")
    command = ["git", *who, "-C", str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    git(tmp_path, "init", "--quiet")
    (tmp_path / "a.py").write_text("one\n", encoding="utf-8")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "--quiet", "-m", "one")
    monkeypatch.setattr(run_metadata, "_ROOT", tmp_path)
    return tmp_path


def told() -> str:
    run_metadata.source_commit.cache_clear()
    commit = run_metadata.run_metadata(plan_for(Path()), Instant(0), {})["commit"]
    run_metadata.source_commit.cache_clear()
    return commit


def test_a_clean_tree_and_a_changed_one(tree: Path) -> None:
    head = git(tree, "rev-parse", "HEAD")
    (tree / "untracked.py").write_text("", encoding="utf-8")
    assert told() == head
    (tree / "a.py").write_text("two\n", encoding="utf-8")
    assert told() == f"{head}-dirty"
    git(tree, "add", "a.py")
    assert told() == f"{head}-dirty"


def test_nothing_is_written_into_the_tree(tree: Path) -> None:
    """Whoever writes the index holds its lock meanwhile, and leaves it there if it is killed."""
    index = tree / ".git" / "index"
    os.utime(tree / "a.py", ns=(1_000_000_000, 1_000_000_000))  # git would note that it looked
    before = index.read_bytes()
    assert told() == git(tree, "rev-parse", "HEAD")
    assert index.read_bytes() == before


def test_a_folder_without_commits_or_without_git_names_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_metadata, "_ROOT", tmp_path)
    assert told() == ""
    git(tmp_path, "init", "--quiet")
    assert told() == ""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert told() == ""
