"""Processes of simulated drives: how they come up, end, and what is said of those that do not."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from servobench.drivers.errors import PeerFault
from servobench.hil.testing import hosted
from servobench.hil.testing.hosted import DriveProcess

UP = "import signal, sys, time\nprint('on the bus; Ctrl-C ends it', flush=True)\n"
WAITING = UP + "signal.sigwait([signal.SIGINT])\n"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[type]:
    """Processes of a few lines; none is left."""
    made: list[DriveProcess] = []

    def process(code: str) -> DriveProcess:
        blocked = "import signal\nsignal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])\n"
        made.append(DriveProcess([sys.executable, "-S", "-I", "-c", blocked + code], tmp_path / "drive.log"))
        return made[-1]

    yield process  # type: ignore[misc]
    for each in made:
        each.kill()


def test_a_drive_is_on_the_bus_once_it_says_so_and_ends_by_ctrl_c(start: type) -> None:
    process = start(WAITING + "print('at rest')\nsys.exit(4)\n")
    assert process.said == "on the bus; Ctrl-C ends it\n"
    assert process.pid > 0
    assert process.stop() == 4
    assert process.said.endswith("at rest\n")
    assert process.finish() == "", "the test has asked for its end"
    assert process.stop() == 4


def test_an_end_that_nobody_asked_for_is_told_with_what_it_said(start: type) -> None:
    process = start(UP + "print('no bus', file=sys.stderr)\nsys.exit(3)\n")
    process._process.wait(20)
    told = "it ended with status 3; it said:\non the bus; Ctrl-C ends it\nno bus\n"
    assert process.finish() == told
    assert process.wait() == 3
    assert process.finish() == "", "the test has seen its status"


def test_a_drive_ends_with_the_test(start: type) -> None:
    process = start(WAITING)
    assert process.finish() == ""
    assert process._process.returncode == 0
    failing = start(WAITING + "sys.exit(7)\n")
    assert failing.finish().startswith("it ended with status 7; it said:\n")


def test_a_drive_whose_plug_is_pulled_is_forgiven(start: type) -> None:
    process = start(UP + "time.sleep(60)\n")
    process.kill()
    assert process._process.returncode == -9
    assert process.finish() == ""


def test_a_drive_that_does_not_end_is_killed_and_told(start: type, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hosted, "END_LIMIT_S", 0.05)
    process = start(UP + "time.sleep(60)\n")
    told = "it did not end within 0.05 s of Ctrl-C; it said:\non the bus; Ctrl-C ends it\n"
    assert process.finish() == told
    assert process._process.returncode == -9


def test_a_drive_that_does_not_come_up_says_why(start: type, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PeerFault) as caught:
        start("import sys\nprint('no such bus')\nsys.exit(2)\n")
    assert (caught.value.summary, caught.value.evidence) == (
        "the simulated drive did not come up",
        "no such bus",
    )
    monkeypatch.setattr(hosted, "START_LIMIT_S", 0.05)
    with pytest.raises(PeerFault, match="the simulated drive did not come up"):
        start("import time\ntime.sleep(60)\n")
