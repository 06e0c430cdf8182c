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

from servobench.hil.verdict.verdict import ExitStatus
from tests.scenario.processes import quiet_environment, simulated_drive
from tests.warm.start import hil, python

SLOW = Path(__file__).with_name("slow.toml")
COMMAND_LIMIT_S = 400
CYCLES = 30
"""3 s at 10 Hz."""
MEASURED = 100

IpLink = Callable[..., None]


@pytest.fixture(scope="module", autouse=True)
def loggers() -> None:
    """Have what a logger imports be there: one without descriptors ends at once."""
    ended = subprocess.run(
        [python(), "-m", "servobench.hil.recording.logger"],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=COMMAND_LIMIT_S,
        check=False,
    )
    assert ended.returncode == 1


@pytest.fixture(name="driven")
def with_a_drive(other: str, ip_link: IpLink, request: pytest.FixtureRequest) -> Iterator[IpLink]:
    """``ip link`` of the bench's controller, whose queue has that length; a drive is at the other one."""
    ip_link("txqueuelen", str(request.param))
    with simulated_drive(f"socketcan:{other}"):
        yield ip_link


@pytest.mark.usefixtures("driven")
@pytest.mark.parametrize("driven", [10, pytest.param(1, marks=pytest.mark.long)], indirect=True)
def test_a_run_through_a_short_queue(channel: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    status, ran = _hil("run", str(SLOW), "--bus", f"socketcan:{channel}", "--record", str(folder), "--json")
    assert ran["verdict"]["completed"] is True, ran
    assert status in (ExitStatus.PASSED, ExitStatus.NOT_TRUSTWORTHY), "its readings may be late"
    assert ran["cycles"] == CYCLES
    assert sum(ran["dropouts"].values()) < CYCLES
    assert [drive["after_last_cycle"] for drive in ran["drives"]] == ["operation enabled"]
    assert ran["drives"][0]["at_rest"] is True
    assert (folder / "frames.arrow").stat().st_size > 0


@pytest.mark.long
@pytest.mark.usefixtures("driven")
@pytest.mark.parametrize("driven", [10, 1], indirect=True)
def test_a_measurement_through_a_short_queue(channel: str) -> None:
    """Each SYNC was on the bus, by its own echo from the driver, and no reading was lost in the queue."""
    cycles = ("--cycles", str(MEASURED), "--period-us", "100000")
    status, measured = _hil("measure", "--node", "1", *cycles, "--bus", f"socketcan:{channel}", "--json")
    assert status in (ExitStatus.PASSED, ExitStatus.FAILED), measured.get("error")
    assert (measured["cycles"], measured["interrupted"], measured["enabled"]) == (MEASURED, False, False)
    assert measured["echoes"] in ("kernel", "hardware")
    assert measured["missed"] < MEASURED
    wake_up = measured["host"]["wake_up"]
    assert wake_up["measured"] is True
    assert wake_up["samples"] == MEASURED - measured["missed"]


@pytest.mark.long
@pytest.mark.usefixtures("driven")
@pytest.mark.parametrize("driven", [10, 1], indirect=True)
def test_a_drive_is_read_for_commissioning_through_a_short_queue(channel: str, tmp_path: Path) -> None:
    words = ("--bus", f"socketcan:{channel}", "--node", "1", "--out", str(tmp_path / "out"))
    status, read = _hil("commission", *words, "--dry-run", "--yes", "--json")
    assert status == ExitStatus.PASSED, read
    assert read["left"]["settings"] == "unchanged"
    assert not (tmp_path / "out" / "journal.jsonl").exists()


@pytest.mark.long
@pytest.mark.parametrize("driven", [10], indirect=True)
def test_a_controller_that_only_listens_is_named_before_anything_moves(
    driven: IpLink, channel: str, tmp_path: Path
) -> None:
    driven("down")
    driven("up", "type", "can", "bitrate", "1000000", "listen-only", "on")
    folder = tmp_path / "run"
    status, ran = _hil("run", str(SLOW), "--bus", f"socketcan:{channel}", "--record", str(folder), "--json")
    assert (status, ran["cycles"]) == (ExitStatus.PEER_FAULT, 0)
    assert f"{channel} only listens: ip link set {channel} down" in ran["verdict"]["reason"]


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
