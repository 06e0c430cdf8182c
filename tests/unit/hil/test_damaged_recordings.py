"""Recordings damaged by seed: each reader names the file or shows what can be shown, in bounded memory."""

import subprocess
import sys

import pytest

from tests.draws import ALL
from tests.told import ROOT

COUNT = 11 if ALL else 2


@pytest.mark.long
@pytest.mark.timeout(600)  # eleven seconds of processor time, beside whatever else runs
def test_no_reader_fails_at_a_damaged_recording() -> None:
    """Eleven have each file of a recording once; ``python -m tests.damage`` draws more."""
    command = [sys.executable, "-m", "tests.damage", "--count", f"{COUNT}"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert ended.stdout.splitlines()[-1].startswith(f"{COUNT} recordings, 0 wrongly told; ")
