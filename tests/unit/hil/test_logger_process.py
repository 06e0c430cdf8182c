"""The logger as the loop sees it: a scripted process at the other end of its pipes, in scripted time."""

import json
import os
import select
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.recording import logger_process
from servobench.hil.recording.logger_process import (
    LoggerProcess,
    RecordingFailed,
    last_line,
    salvage,
    start_python,
)
from servobench.hil.rows.recording_plan import RecordingPlan
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.test_report import summary

OUTCOME: Final = whole_outcome(10)
RINGS: Final = (7, 8, 9, 10)

SILENT = (
    "the logger did not answer within 120 s: this machine is too busy or too slow to record; "
    "hil run --no-record keeps no files"
)


class ScriptedTime:
    """Passes by the waits alone; in the places of ``select`` and of the clock."""

    def __init__(self) -> None:
        self.ns = 0
        self.waits: list[float] = []

    def now(self) -> Instant:
        return Instant(self.ns)

    def select(self, ready: list[int], _write: list[int], _other: list[int], timeout_s: float) -> Any:
        self.waits.append(timeout_s)
        found = select.select(ready, [], [], 0.0)
        if not found[0]:
            self.ns += round(timeout_s * NS_PER_S)
        return found


class ScriptedProcess:
    """What :func:`start_python` gives; its output is a pipe into which the test writes."""

    pid = 4711

    def __init__(self) -> None:
        read_end, self._write_end = os.pipe()
        self.stdout = os.fdopen(read_end)
        self.stdin = self
        self.heard = ""
        self.log: list[object] = []
        self.status: int | None = 0
        """None: it does not end by itself."""
        self.broken = False
        """Nobody reads its input."""

    # ---- its ends of the pipes ---------------------------------------------------------------------

    def says(self, *lines: str) -> None:
        os.write(self._write_end, "".join(f"{line}\n" for line in lines).encode())

    def closes(self, status: int | None = 0) -> None:
        os.close(self._write_end)
        self.status = status

    def write(self, text: str) -> None:
        self.heard += text

    def flush(self) -> None:
        self._refuse()

    def close(self) -> None:
        self.log.append("input closed")
        self._refuse()

    def _refuse(self) -> None:
        if self.broken:
            raise BrokenPipeError

    # ---- the process itself ------------------------------------------------------------------------

    def wait(self, timeout_s: float | None = None) -> int:
        self.log.append(("wait", timeout_s))
        if self.status is None:
            raise subprocess.TimeoutExpired("logger", timeout_s or 0.0)
        return self.status

    def kill(self) -> None:
        self.log.append("killed")
        self.status = -signal.SIGKILL

    def communicate(self, text: str | None = None, timeout: float | None = None) -> tuple[str, None]:
        self.heard += text or ""
        self.log.append(("communicate", timeout))
        if self.status is None:
            raise subprocess.TimeoutExpired("recovery", timeout or 0.0)
        return self.stdout.read(), None


Started = list[tuple[str, Sequence[int], Path | None]]


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> ScriptedTime:
    found = ScriptedTime()
    monkeypatch.setattr(logger_process, "select", found)
    monkeypatch.setattr(logger_process, "MonotonicClock", lambda: found)
    return found


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch, started: Started) -> Iterator[ScriptedProcess]:
    found = ScriptedProcess()

    def start(module: str, descriptors: Sequence[int], log: Path | None) -> ScriptedProcess:
        started.append((module, descriptors, log))
        return found

    monkeypatch.setattr(logger_process, "start_python", start)
    yield found
    found.stdout.close()


@pytest.fixture
def started() -> Started:
    return []


@pytest.fixture
def plan(tmp_path: Path) -> RecordingPlan:
    return plan_for(tmp_path)


@pytest.fixture
def logger(process: ScriptedProcess, time: ScriptedTime, plan: RecordingPlan) -> LoggerProcess:
    """Started, and told its plan."""
    del time
    made = LoggerProcess(plan, RINGS)
    process.heard = ""
    return made


def failure(act: Callable[[], object]) -> str:
    with pytest.raises(RecordingFailed) as caught:
        act()
    assert str(caught.value) == f"not recorded: {caught.value.trouble}"
    assert caught.value.exit_status == 5
    return caught.value.trouble


# ---- its beginning ------------------------------------------------------------------------------------


def test_it_is_started_with_the_rings_and_told_its_plan(
    process: ScriptedProcess, started: Started, plan: RecordingPlan, tmp_path: Path
) -> None:
    logger = LoggerProcess(plan, RINGS)
    assert started == [("servobench.hil.recording.logger", RINGS, tmp_path / "logger.log")]
    assert process.heard == json.dumps(plan.as_json()) + "\n"
    assert logger.process_id == 4711
    LoggerProcess(replace(plan, folder=None), RINGS)
    assert started[1] == ("servobench.hil.recording.logger", RINGS, None), "nothing is kept"


def test_it_is_waited_for_until_it_drains(
    logger: LoggerProcess, process: ScriptedProcess, time: ScriptedTime
) -> None:
    process.says("something", "ready")
    logger.wait_ready()
    assert (time.waits, process.heard) == ([120.0], "")


def test_one_that_does_not_come_up_says_why(logger: LoggerProcess, process: ScriptedProcess) -> None:
    process.says("failed run.rrd: the disk is full", "failed and more")
    assert failure(logger.wait_ready) == "run.rrd: the disk is full"
    assert logger.trouble() == "run.rrd: the disk is full", "the first trouble is the one that is told"


def test_a_silent_one_is_given_up(logger: LoggerProcess, time: ScriptedTime) -> None:
    assert failure(logger.wait_ready) == SILENT
    assert time.waits == [120.0, 120.0], "at the deadline itself an answer may still come"


# ---- what was recorded is in the files ------------------------------------------------------------------


def test_a_confirmation_is_asked_once_and_waited_for_without_blocking(
    logger: LoggerProcess, process: ScriptedProcess, time: ScriptedTime
) -> None:
    answers = [lambda: process.says("ready"), lambda: None, lambda: process.says("stored")]
    waits = iter(answers)
    logger.confirm(lambda: next(waits)())
    assert process.heard == "confirm\n"
    assert next(waits, None) is None, "each of the three waits was needed"
    assert set(time.waits) == {0.0}


def test_trouble_ends_a_confirmation_without_a_wait(logger: LoggerProcess, process: ScriptedProcess) -> None:
    waits: list[None] = []
    process.says("failed frames.arrow is incomplete")
    assert failure(lambda: logger.confirm(lambda: waits.append(None))) == "frames.arrow is incomplete"
    assert waits == []


def test_a_confirmation_that_does_not_come_is_given_up(logger: LoggerProcess, time: ScriptedTime) -> None:
    def wait() -> None:
        time.ns += 10 * NS_PER_S

    assert failure(lambda: logger.confirm(wait)) == SILENT
    assert time.ns == 130 * NS_PER_S


# ---- while it records -----------------------------------------------------------------------------------


def test_one_that_drains_has_no_trouble_and_is_not_gone(
    logger: LoggerProcess, process: ScriptedProcess, time: ScriptedTime
) -> None:
    process.says("ready")
    assert (logger.trouble(), logger.gone, logger.trouble()) == ("", False, "")
    process.says("failed events.jsonl is incomplete")
    assert not logger.gone, "the other files are still written"
    assert logger.trouble() == "events.jsonl is incomplete"
    assert set(time.waits) == {0.0}, "nobody waits"


@pytest.mark.parametrize(
    ("status", "log", "told"),
    [
        (-signal.SIGKILL, None, "the logger was killed by SIGKILL"),
        (0, "", "the logger ended with status 0"),
        (1, "Traceback\nOSError: no\n\n", "the logger ended with status 1: OSError: no"),
        (-signal.SIGSEGV, "x", "the logger was killed by SIGSEGV: x"),
        (None, "x", "the logger closed its output"),
    ],
)
def test_the_end_of_its_output_is_its_end(
    logger: LoggerProcess,
    process: ScriptedProcess,
    tmp_path: Path,
    status: int | None,
    log: str | None,
    told: str,
) -> None:
    if log is not None:
        (tmp_path / "logger.log").write_text(log)
    process.says("ready")
    process.closes(status)
    assert logger.gone is False, "its last word has not been heard yet"
    assert logger.gone is True
    assert logger.trouble() == logger.trouble() == told
    assert process.log == [("wait", 5.0)], "asked once how it ended"
    assert failure(logger.wait_ready) == told


def test_what_it_had_complained_of_is_not_forgotten_at_its_end(
    logger: LoggerProcess, process: ScriptedProcess
) -> None:
    process.says("failed the disk is full")
    process.closes(1)
    assert logger.trouble() == "the disk is full"
    assert logger.gone
    assert logger.trouble() == "the disk is full"


# ---- the end --------------------------------------------------------------------------------------------


def test_the_summary_is_what_it_says_at_its_end(
    logger: LoggerProcess, process: ScriptedProcess, time: ScriptedTime
) -> None:
    process.says("ready", "stored", "failed frames.arrow", json.dumps(summary().as_json()))
    assert logger.finish(OUTCOME) == summary()
    assert json.loads(process.heard) == json.loads(json.dumps(asdict(OUTCOME)))
    assert process.heard.endswith("}\n")
    assert set(time.waits) == {1.0}
    # it was heard to the end of its words, not of its output: it is not waited for
    assert process.log == ["input closed", ("wait", 0.0)]
    assert process.stdout.closed


def test_one_that_does_not_end_after_its_summary_is_ended(
    logger: LoggerProcess, process: ScriptedProcess
) -> None:
    process.says(json.dumps(summary().as_json()))
    process.status = None
    assert logger.finish(OUTCOME) == summary()
    assert process.log == ["input closed", ("wait", 0.0), "killed", ("wait", None)]


def test_one_that_died_gives_no_summary(
    logger: LoggerProcess, process: ScriptedProcess, time: ScriptedTime
) -> None:
    process.broken = True
    process.closes(-signal.SIGTERM)
    assert logger.finish(OUTCOME) is None
    assert logger.trouble() == "the logger was killed by SIGTERM"
    assert process.log == [("wait", 5.0), "input closed", ("wait", 5.0)]
    assert process.stdout.closed
    assert time.ns == 0


@pytest.mark.parametrize(
    ("before", "told"), [([], "the logger did not finish within 120 s"), (["failed it"], "it")]
)
def test_one_that_hangs_is_given_two_minutes(
    logger: LoggerProcess, process: ScriptedProcess, time: ScriptedTime, before: list[str], told: str
) -> None:
    process.says("stored", *before)
    process.status = None
    assert logger.finish(OUTCOME) is None
    assert time.ns == 120 * NS_PER_S
    assert process.log == ["input closed", ("wait", 0.0), "killed", ("wait", None)]
    assert logger._trouble == told


# ---- programs of ours -----------------------------------------------------------------------------------


def test_a_program_of_ours_inherits_the_rings_and_is_in_a_session_of_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[tuple[list[str], dict[str, Any]]] = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: calls.append((command, options)))
    (tmp_path / "log").write_text("before\n")
    start_python("servobench.hil.recording.logger", (3, 4), tmp_path / "log")
    start_python("servobench.hil.recording.logger", (), None)
    (command, options), (_, without) = calls
    assert command[-4:] == ["-m", "servobench.hil.recording.logger", "3", "4"]
    assert (options["stdin"], options["stdout"]) == (subprocess.PIPE, subprocess.PIPE)
    assert (options["text"], options["start_new_session"]) == (True, True)
    assert options["pass_fds"] == (3, 4)
    assert options["env"]["CI"] == "1", "no analytics"
    assert (options["stderr"].name, options["stderr"].mode) == (str(tmp_path / "log"), "a")
    assert without["stderr"].name == "/dev/null"
    assert (tmp_path / "log").read_text() == "before\n"


@pytest.mark.parametrize(
    ("said", "line"),
    [(b"", ""), (b"\n \n", ""), (b"one\ntwo  \n\n", "two"), (b"one\xff", "one\N{REPLACEMENT CHARACTER}")],
)
def test_the_last_line_of_a_log(tmp_path: Path, said: bytes, line: str) -> None:
    path = tmp_path / "log"
    assert last_line(None) == last_line(path) == ""
    path.write_bytes(said)
    assert last_line(path) == line


def test_a_dead_logger_s_recording_is_finished_by_another_process(
    process: ScriptedProcess, started: Started, plan: RecordingPlan, tmp_path: Path
) -> None:
    process.says(json.dumps(summary().as_json()))
    process.closes()
    assert salvage(plan, RINGS, OUTCOME, "it died") == summary()
    assert started == [("servobench.hil.recording.recovery", RINGS, tmp_path / "logger.log")]
    assert json.loads(process.heard) == {
        "plan": json.loads(json.dumps(plan.as_json())),
        "outcome": json.loads(json.dumps(asdict(OUTCOME))),
        "trouble": "it died",
    }
    assert process.log == [("communicate", 120.0)]


@pytest.mark.parametrize("hangs", [True, False])
def test_where_that_fails_the_reader_is_told_what_to_do(
    process: ScriptedProcess, plan: RecordingPlan, tmp_path: Path, hangs: bool
) -> None:
    process.closes(None if hangs else 1)
    trouble = failure(lambda: salvage(plan, RINGS, OUTCOME, "it died"))
    assert trouble == f"it died; {tmp_path} holds what was written: hil recover {tmp_path}"
    ended: list[object] = ["killed", ("communicate", None)] if hangs else []
    assert process.log == [("communicate", 120.0), *ended]
