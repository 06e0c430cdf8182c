"""Some runs drawn at random hold what every run must; more of them: ``make swarm``."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from hil.testing.campaign_runs import CampaignRunner
from tests.swarm.__main__ import CASES

BATCH = CASES // 2
SWEEP = Path(__file__).with_name("swarm.toml")


def test_nothing_is_found_in_the_campaign(tmp_path: Path) -> None:
    tables = tomllib.loads(SWEEP.read_text(encoding="utf-8"))
    assert tables["campaign"]["first_seed"] == CASES
    tables["campaign"] |= {"first_seed": 0, "seeds": CASES}
    done = CampaignRunner(tmp_path, SWEEP.parent)(tables)
    assert done.table.num_rows == CASES
    done.assert_nothing_found()


@pytest.mark.parametrize("first", range(0, CASES, BATCH))
def test_every_run_is_told_as_it_was(first: int) -> None:
    command = [sys.executable, "-m", "tests.swarm", "--first", str(first), "--cases", str(BATCH)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
