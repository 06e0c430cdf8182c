"""Some runs drawn at random hold what every run must; more of them: ``make swarm``."""

import subprocess
import sys

import pytest

from tests.swarm.__main__ import CASES

BATCH = CASES // 2


@pytest.mark.parametrize("first", range(0, CASES, BATCH))
def test_every_run_is_told_as_it_was(first: int) -> None:
    command = [sys.executable, "-m", "tests.swarm", "--first", str(first), "--cases", str(BATCH)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
