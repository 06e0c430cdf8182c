"""Some runs drawn at random hold what every run must; more of them: ``make swarm``."""

import shutil
from pathlib import Path

import pytest

from tests.swarm.swarm import failures

CASES = 20
BATCH = 10


@pytest.mark.parametrize("first", range(0, CASES, BATCH))
def test_every_run_is_told_as_it_was(first: int, tmp_path: Path) -> None:
    found = []
    for number in range(first, first + BATCH):
        found += failures(number, tmp_path)
        shutil.rmtree(tmp_path / f"run-{number}", ignore_errors=True)
    assert found == []
