"""A run in an environment that is not the usual one comes to the same rows, or to one of its other statuses.

So many of them as ENVIRONMENTS says, drawn by SEED; 0: all.
"""

import functools
import json
import os
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.virtual_bus.child_python import python_command
from tests.exits.environments import ENVIRONMENTS, PASSED, Environment
from tests.unit.hil.recorded_runs import BENCH

ALWAYS: Final = (
    "the current folder is gone",
    "8 files",
    "300 MB of addresses",
    "not root, without a place to write to",
    "not root, one process",
)
"""A run came to a status of its own in these, and soon."""
SEED: Final = int(os.environ.get("SEED", "36"))
COUNT: Final = int(os.environ.get("ENVIRONMENTS", "1"))
DRAWN: Final = random.Random(SEED).sample(sorted(ENVIRONMENTS), COUNT or len(ENVIRONMENTS))


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """A folder that pytest can take away whatever its files became."""
    yield tmp_path
    subprocess.run(["chmod", "-R", "u+rwX", str(tmp_path)], check=True)


def ended(script: str, place: Path, *command: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PLACE": str(place), "SEED": str(SEED)}
    shell = ["bash", "-c", script, "bash", *command]
    return subprocess.run(
        shell, env=environment, capture_output=True, text=True, errors="replace", check=False, timeout=200
    )


def run_in(environment: Environment, place: Path) -> dict[str, Any]:
    """What the command prints; skips the test if this machine, or this user, has no such environment."""
    kept = ("--record", str(place / "run")) if environment.records else ("--no-record",)
    command = python_command("servobench.hil.cli", "run", str(BENCH), "--bus", "simulated", "--json", *kept)
    done = ended(environment.script, place, *command)
    if not done.stdout:
        (probed := place / "probed").mkdir()
        if ended(environment.script, probed, "true").returncode:
            pytest.skip(done.stderr)
    assert "Traceback" not in done.stderr
    table: dict[str, Any] = json.loads(done.stdout)
    assert table["verdict"]["exit_status"] == done.returncode, done.stderr
    assert done.returncode in environment.statuses, done.stderr
    return table


@functools.cache
def usual_digest() -> str:
    return str(run_in(Environment('exec "$@"', records=False), Path())["digest"])


@pytest.mark.parametrize("name", sorted({*DRAWN, *ALWAYS}))
def test_an_environment_changes_nothing_but_how_far_a_run_comes(name: str, place: Path) -> None:
    table = run_in(ENVIRONMENTS[name], place)
    if table["verdict"]["exit_status"] == PASSED:
        assert table["digest"] == usual_digest()
