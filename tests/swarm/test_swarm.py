"""Some runs drawn at random hold what every run must; more of them: ``make swarm``."""

import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from servobench.drivers.timebase import Instant
from servobench.hil.testing.campaign_runs import CampaignRunner
from servobench.hil.testing.wire import SeenFrame
from tests.swarm import witness
from tests.swarm.__main__ import CASES
from tests.swarm.invariants import emergencies_are_told_when_they_were_sent
from tests.swarm.ran import Ran

SWEEP = Path(__file__).with_name("swarm.toml")


def test_nothing_is_found_in_the_campaign(tmp_path: Path) -> None:
    tables = tomllib.loads(SWEEP.read_text(encoding="utf-8"))
    assert tables["campaign"]["first_seed"] == CASES
    tables["campaign"] |= {"first_seed": 0, "seeds": CASES}
    done = CampaignRunner(tmp_path, SWEEP.parent)(tables)
    assert done.table.num_rows == CASES
    done.assert_nothing_found()


def test_every_run_is_told_as_it_was() -> None:
    command = [sys.executable, "-m", "tests.swarm", "--first", "0", "--cases", str(CASES)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("segments", "sent", "told", "missed"),
    [
        ((), [], [], True),
        (("second",), [], [], False),
        (("second",), [0x4310], [], True),
        ((), [], [5], False),
    ],
    ids=["as the node", "on another segment", "by the node on its own", "told"],
)
def test_an_emergency_that_is_no_event_is_found(
    segments: tuple[str, ...], sent: list[int], told: list[int], missed: bool
) -> None:
    """On a bench of one segment whoever speaks as the node is the node; on several it may be on another."""
    ran = SimpleNamespace(
        wire=SimpleNamespace(frames=[SeenFrame(Instant(5), False, 0x082, bytes.fromhex("1043090000000000"))]),
        events=[{"at_ns": at, "text": "EMCY 4310h"} for at in told],
        config=SimpleNamespace(bus=SimpleNamespace(segment=segments)),
        case=SimpleNamespace(drives=[witness.Testimony(2, [], [(Instant(5), code) for code in sent])]),
        whole=True,
    )
    assert bool(list(emergencies_are_told_when_they_were_sent(cast("Ran", ran)))) is missed
