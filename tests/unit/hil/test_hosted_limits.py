"""How long a drive's process is waited for, in scripted time, and how it is started and told to end."""

import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.testing import hosted
from servobench.hil.testing.hosted import DriveHost, DriveProcess, DriveWish
from servobench.virtual_bus.timeline import SimulatedClock, Timeline

READY: Final = "on the bus; Ctrl-C ends it\n"


class Machine:
    """One process: it says what the test lets it say, and ends when the test lets it."""

    pid = 4711

    def __init__(self) -> None:
        self.log: list[object] = []
        self.options: dict[str, Any] = {}
        self.command: list[str] = []
        self.returncode: int | None = None
        self.ends_by_itself = True
        """After a signal, or when it is waited for."""
        self.status = 0
        self.says: Callable[[int], str] = lambda _asked: READY
        self._path: Path | None = None
        self._asked = 0

    def start(self, command: list[str], **options: Any) -> "Machine":
        self.command, self.options = command, options
        self._path = Path(options["stdout"].name)
        return self

    def poll(self) -> int | None:
        self._asked += 1
        assert self._path is not None
        self._path.write_text(self.says(self._asked))
        return self.returncode

    def wait(self, timeout_s: float | None = None) -> int:
        self.log.append(("wait", timeout_s))
        if self.returncode is None:
            if not self.ends_by_itself:
                raise subprocess.TimeoutExpired("drive", timeout_s or 0.0)
            self.returncode = self.status
        return self.returncode

    def send_signal(self, number: int) -> None:
        self.log.append(number)

    def kill(self) -> None:
        self.log.append("killed")
        self.returncode = -signal.SIGKILL


@pytest.fixture
def timeline() -> Timeline:
    return Timeline()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, timeline: Timeline) -> Machine:
    found = Machine()
    monkeypatch.setattr(subprocess, "Popen", found.start)
    monkeypatch.setattr(hosted, "MonotonicClock", lambda: SimulatedClock(timeline))
    return found


@pytest.fixture
def drive(machine: Machine, tmp_path: Path) -> DriveProcess:
    """One that is on the bus."""
    found = DriveProcess(["hil", "simulate"], tmp_path / "drive.log")
    machine.log.clear()
    return found


def test_a_drive_is_started_with_all_that_it_says_in_one_log(
    drive: DriveProcess, machine: Machine, tmp_path: Path
) -> None:
    assert machine.command == ["hil", "simulate"]
    assert machine.options["stdin"] == subprocess.DEVNULL
    assert machine.options["stdout"] is machine.options["stderr"]
    assert (machine.options["stdout"].name, machine.options["stdout"].mode) == (
        str(tmp_path / "drive.log"),
        "wb",
    )
    assert machine.options["env"]["CI"] == "true"
    assert (drive.pid, drive.said) == (4711, READY)


@pytest.fixture
def limit_s(monkeypatch: pytest.MonkeyPatch) -> float:
    """Ten looks, in place of the 6000 of a minute."""
    assert hosted.START_LIMIT_S == 60.0
    monkeypatch.setattr(hosted, "START_LIMIT_S", 0.1)
    return 0.1


@pytest.mark.parametrize("asked", [1, 2, 10])
@pytest.mark.usefixtures("limit_s")
def test_it_is_looked_for_each_ten_milliseconds_until_its_time_is_up(
    machine: Machine, timeline: Timeline, tmp_path: Path, asked: int
) -> None:
    machine.says = lambda now: READY if now >= asked else "starting\n"
    DriveProcess(["hil"], tmp_path / "drive.log")
    assert timeline.now == asked * 10 * NS_PER_MS
    assert machine.log == []


def test_then_it_is_killed_and_told(
    machine: Machine, timeline: Timeline, tmp_path: Path, limit_s: float
) -> None:
    machine.says = lambda _now: "  starting\n\n"
    with pytest.raises(PeerFault) as caught:
        DriveProcess(["hil"], tmp_path / "drive.log")
    assert (caught.value.summary, caught.value.evidence) == (
        "the simulated drive did not come up",
        "starting",
    )
    assert timeline.now == limit_s * NS_PER_S + 10 * NS_PER_MS, "at its very end it may still come"
    assert machine.log == ["killed", ("wait", None)]


def test_one_that_ends_is_told_at_once(machine: Machine, timeline: Timeline, tmp_path: Path) -> None:
    machine.says, machine.returncode = lambda _now: "no such bus\n", 2
    with pytest.raises(PeerFault, match="did not come up; no such bus"):
        DriveProcess(["hil"], tmp_path / "drive.log")
    assert timeline.now == 0


def test_ctrl_c_is_pressed_once_and_the_status_is_the_test_s(drive: DriveProcess, machine: Machine) -> None:
    machine.status = 4
    assert drive.stop() == 4
    assert drive.stop() == 4
    assert machine.log == [signal.SIGINT, ("wait", 20.0), ("wait", 20.0)]
    assert drive.finish() == "", "the test has seen it"


def test_its_end_may_be_waited_for_as_long_as_is_said(drive: DriveProcess, machine: Machine) -> None:
    assert drive.wait(3.0) == drive.wait() == 0
    assert machine.log == [("wait", 3.0), ("wait", 20.0)]


def test_a_pulled_plug_is_waited_for_and_forgiven(drive: DriveProcess, machine: Machine) -> None:
    drive.kill()
    assert machine.log == ["killed", ("wait", 20.0)]
    assert drive.finish() == ""


def test_at_the_end_of_a_test_it_is_ended_and_a_status_told(drive: DriveProcess, machine: Machine) -> None:
    machine.status = 7
    assert drive.finish() == f"it ended with status 7; it said:\n{READY}"
    assert machine.log == [signal.SIGINT, ("wait", 20.0)]
    assert drive.finish() == f"it ended with status 7; it said:\n{READY}", "nobody has asked for it yet"
    assert len(machine.log) == 2, "one that has ended is told nothing more"


def test_one_that_does_not_end_is_killed_and_told(drive: DriveProcess, machine: Machine) -> None:
    machine.ends_by_itself = False
    assert drive.finish() == f"it did not end within 20 s of Ctrl-C; it said:\n{READY}"
    assert machine.log == [signal.SIGINT, ("wait", 20.0), "killed", ("wait", None)]


def test_all_of_a_host_are_ended_and_each_complaint_told_once(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = iter(["one", "", "three"])
    monkeypatch.setattr(DriveProcess, "finish", lambda _process: next(ends))
    host = DriveHost("hub:x", tmp_path)
    for node in (1, 2, 3):
        host.start([node], DriveWish(motor="m.toml"))
    with pytest.raises(PeerFault) as caught:
        host.end()
    assert str(caught.value) == "a simulated drive on hub:x failed; one\nthree"
    host.end()
    assert host.missing([1, 2, 3, 4]) == [4], "they have been on the bus"
    assert machine.command[-1] == "1000000"


def test_a_drive_of_which_nothing_is_wished_is_the_paper_s_at_1_mbit() -> None:
    assert DriveWish() == DriveWish(1, LING2012, None, None, None, seed=0, bitrate_bit_s=1_000_000)
