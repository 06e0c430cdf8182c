"""A closed loop over a controller's own driver: the drive simulated at one end of the bus, the bench at the
other, each a command as a user types it.

Programs are forked (:mod:`tests.warm`): what they import takes an emulated machine minutes, once.
"""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hil.verdict.verdict import ExitStatus
from tests.scenario.processes import quiet_environment, simulated_drive
from tests.warm.start import hil, python

SLOW = Path(__file__).with_name("slow.toml")
COMMAND_LIMIT_S = 400
CYCLES = 30
"""3 s at 10 Hz."""

IpLink = Callable[..., None]


@pytest.fixture(scope="module", autouse=True)
def loggers() -> None:
    """Have what a logger imports be there: one without descriptors ends at once."""
    ended = subprocess.run(
        [python(), "-m", "hil.recording.logger"],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=COMMAND_LIMIT_S,
        check=False,
    )
    assert ended.returncode == 1


@pytest.fixture(params=[10])
def queue(request: pytest.FixtureRequest, other: str, ip_link: IpLink) -> Iterator[int]:
    """Places in the transmit queue of the bench's end; a drive is at the other one."""
    ip_link("txqueuelen", str(request.param))
    with simulated_drive(f"socketcan:{other}"):
        yield request.param


def test_a_run_through_a_short_queue(queue: int, channel: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    status, ran = _hil("run", str(SLOW), "--bus", f"socketcan:{channel}", "--record", str(folder), "--json")
    assert ran["verdict"]["completed"] is True, (queue, ran)
    assert status in (ExitStatus.PASSED, ExitStatus.NOT_TRUSTWORTHY), "its readings may be late"
    assert ran["cycles"] == CYCLES
    assert sum(ran["dropouts"].values()) < CYCLES
    assert (folder / "frames.log").stat().st_size > 0


def test_a_measurement_through_a_short_queue(queue: int, channel: str) -> None:
    cycles = ("--cycles", "100", "--period-us", "100000")
    status, measured = _hil("measure", "--node", "1", *cycles, "--bus", f"socketcan:{channel}", "--json")
    assert status in (0, 1), (queue, measured)


def _hil(*words: str) -> tuple[int, dict[str, Any]]:
    """Status and JSON of the command."""
    ended = subprocess.run(
        [*hil(), *words],
        capture_output=True,
        text=True,
        env=quiet_environment(),
        timeout=COMMAND_LIMIT_S,
        check=False,
    )
    assert ended.stdout, ended.stderr
    said: dict[str, Any] = json.loads(ended.stdout)
    return ended.returncode, said
