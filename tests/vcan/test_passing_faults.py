"""What befalls an adapter and passes within the drive's watchdog: the run goes on, and says what was."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from servobench.hil.verdict.verdict import ExitStatus
from tests.scenario.processes import Observer
from tests.vcan.adapter import (
    BUS_OFF,
    RESTARTED,
    drive_beside,
    echoes_like_a_driver,
    error,
    flood,
    lose,
    release,
    set_up,
)
from tests.vcan.struck_run import Strike, struck

CYCLES = 300
DOWN_S, OFF_S = 0.05, 0.1
FLOOD = 150
"""Frames: a busy emulated machine takes long for them, and a run ends after 100 cycles without a reading."""


@pytest.fixture(name="far")
def far_end(channel: str) -> Iterator[str]:
    """SPEC of the bus with the drive, behind the gateway."""
    with drive_beside(channel) as far:
        yield far


def down_for_a_moment(watching: Observer, _command: int) -> None:
    set_up(False)
    watching.wait(DOWN_S)
    set_up(True)


def bus_off_and_restarted(watching: Observer, _command: int) -> None:
    if not echoes_like_a_driver():
        pytest.skip("a lost frame must have no echo: modprobe vcan echo=1")
    error(BUS_OFF)
    lose()
    watching.wait(OFF_S)
    release()
    error(RESTARTED)


def flooded(_watching: Observer, _command: int) -> None:
    flood(FLOOD)


def wall_clock_set(watching: Observer, _command: int) -> None:
    """Kernels stamp frames by it. It is set back afterwards."""
    for step in ("+1 hour", "-1 hour"):
        subprocess.run(["date", "--set", step], check=True, stdout=subprocess.DEVNULL, timeout=60)
        watching.wait(0.5)


@pytest.mark.parametrize(
    ("strike", "events"),
    [
        pytest.param(down_for_a_moment, ["is down: nothing is sent or heard", "is up again"], id="down"),
        pytest.param(bus_off_and_restarted, ["is bus-off", "was restarted after bus-off"], id="bus-off"),
        pytest.param(flooded, ["takes no frames", "takes frames again"], id="another process floods"),
        pytest.param(wall_clock_set, [], id="wall clock"),
    ],
)
def test_a_run_goes_on_and_tells_what_was(
    far: str, tmp_path: Path, strike: Strike, events: list[str]
) -> None:
    ended = struck(far, tmp_path, strike, passes=True)
    assert ended.status in (ExitStatus.PASSED, ExitStatus.NOT_TRUSTWORTHY), ended.said
    (drive,) = ended.summary["drives"]
    assert ended.summary["verdict"]["completed"] is True
    assert (drive["after_last_cycle"], drive["at_rest"]) == ("operation enabled", True)
    assert ended.rows["sequence"].tolist() == list(range(1, CYCLES + 1))
    assert all(text in ended.events for text in events), ended.events
    print(f"{ended.missed} missed, {ended.lost} lost or late, status {ended.status}")
