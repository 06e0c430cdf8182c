"""Every command, with a stdout or stderr that is gone, full or closed: a documented status, and no traceback.

So many as STREAMS says, drawn by SEED; all of them, STREAMS=0, are a part of ``make exits``.
"""

import os
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import typer

from servobench.hil.cli import app
from servobench.hil.verdict.verdict import ExitStatus
from servobench.virtual_bus.child_python import python_command
from tests.scenario.processes import run_command
from tests.unit.hil.recorded_runs import short_run
from tests.warm.start import hil

SEED: Final = int(os.environ.get("SEED", "36"))
DRAWN: Final = int(os.environ.get("STREAMS", "3"))
REDIRECTIONS: Final = {
    "gone": '"$@" | true; exit ${PIPESTATUS[0]}',
    "full": '"$@" >/dev/full',
    "closed": '"$@" >&-',
    "messages gone": '"$@" 2> >(true)',
    "messages full": '"$@" 2>/dev/full',
    "messages closed": '"$@" 2>&-',
    "all closed": '"$@" <&- >&- 2>&-',
}


def commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """All that ``hil`` has, as words."""
    for name, command in getattr(group, "commands", {}).items():
        yield from commands(command, (*path, name))
    if not getattr(group, "commands", None):
        yield path


EVERY: Final = sorted(commands(typer.main.get_command(app)))
READING: Final = (
    ("review", "RUN"), ("review", "RUN", "--json"), ("trace", "RUN"), ("trace", "RUN", "--json"),
    ("runs", "."), ("compare", "RUN", "RUN"), ("doctor",), ("view", "RUN"),
    ("export", "RUN", "--to", "csv", "--out", "/dev/stdout"), ("recover", "RUN"),
    ("review", "RUN", "--against", "nowhere.toml"),
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return short_run(tmp_path_factory.mktemp("streams") / "RUN").parent


def ended(words: tuple[str, ...], kind: str, folder: Path) -> tuple[int, str]:
    command = python_command("servobench.hil.cli", *words)
    shell = ["bash", "-c", REDIRECTIONS[kind], "bash", *command]
    done = subprocess.run(shell, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stderr


def cases() -> list[tuple[tuple[str, ...], str]]:
    every = [
        (words, kind)
        for words in (*[(*path, "--help") for path in EVERY], *EVERY, *READING)
        for kind in REDIRECTIONS
        if words not in (("adapter",), ("scan",), ("init",))  # they need no argument to begin to work
    ]
    return random.Random(SEED).sample(every, DRAWN) if DRAWN else every


@pytest.mark.parametrize(
    ("words", "kind"), cases(), ids=lambda part: part if isinstance(part, str) else " ".join(part)
)
def test_a_command_ends_as_documented(folder: Path, words: tuple[str, ...], kind: str) -> None:
    status, said = ended(words, kind, folder)
    assert status in set(ExitStatus) - {ExitStatus.DEFECT}, said
    assert "Traceback" not in said


def test_what_is_not_read_is_told_by_the_status_and_the_rest_is_done(folder: Path) -> None:
    judged = ("review", "RUN", "--against", "nothing.toml")
    (folder / "nothing.toml").write_text("[verdict]\n")
    assert run_command([*hil(), *judged], folder).returncode == 0
    assert ended(judged, "gone", folder)[0] == ExitStatus.NOT_RECORDED
    status, said = ended((*judged, "--report", "report.html"), "full", folder)
    assert (status, "hil: error: stdout: No space left on device" in said) == (
        ExitStatus.NOT_RECORDED,
        True,
    ), said
    assert (folder / "report.html").exists()
