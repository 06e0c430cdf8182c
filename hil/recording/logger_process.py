"""The process of the logger as the loop's process sees it: started, asked, watched, and told the outcome.

Looks after the recording of a run while its loop runs: some twenty times a second, never in between.
"""

import json
import os
import select
import signal
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.machine.progress import Progress
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.run_files import LOGGER_LOG
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import RunOutcome
from servobench.virtual_bus.child_python import python_command, python_environment
from servobench.virtual_bus.timeline import SimulatedClock

if TYPE_CHECKING:  # the logger speaks no CANopen, and starts without it
    from servobench.drivers.canopen.network import CanopenNetwork

READY: Final = "ready"
"""The logger drains the rings."""
CONFIRM: Final = "confirm"
"""Asks the logger to store all that is there; it answers STORED, or FAILED and why."""
STORED: Final = "stored"
FAILED: Final = "failed "

_ANSWER_MAX_S: Final = 120.0
"""The logger imports Rerun and opens its files: a second, ten of them on a crowded machine, a minute on one
that is emulated."""
_TOO_SLOW: Final = "this machine is too busy or too slow to record; hil run --no-record keeps no files"
_FINISH_MAX_S: Final = 120.0
"""The files of a long run are packed and synced to a slow disk; who takes longer is stuck."""
_REAP_MAX_S: Final = 5.0
"""Between the end of its output and the end of the process itself."""


class RecordingFailed(BenchError):
    """The run is not, or not wholly, recorded."""

    exit_status = 5

    def __init__(self, trouble: str) -> None:
        super().__init__(f"not recorded: {trouble}")
        self.trouble = trouble


class LineReader:
    """The reading end of a pipe, by lines, without waiting for them.

    A buffer of the interpreter's would hide what has come.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._held = b""
        self.ended = False
        """Nobody writes any more."""

    def line(self, timeout_s: float) -> str | None:
        """The next whole line; None if it has not come in time, or never will."""
        if (
            b"\n" not in self._held
            and not self.ended
            and select.select([self._descriptor], [], [], timeout_s)[0]
        ):
            read = os.read(self._descriptor, 1 << 16)
            self.ended = not read
            self._held += read
        line, separator, rest = self._held.partition(b"\n")
        if not separator:
            return None
        self._held = rest
        return line.decode()


class LoggerProcess:
    """A logger of its own for one run."""

    def __init__(self, plan: RecordingPlan, descriptors: Sequence[int]) -> None:
        """``descriptors``: of the rings. Error: RecordingFailed."""
        self._log = None if plan.folder is None else plan.folder / LOGGER_LOG
        self._process = start_python("servobench.hil.recording.logger", descriptors, self._log)
        assert self._process.stdout is not None
        self._told = LineReader(self._process.stdout.fileno())
        self._trouble = ""
        self._say(json.dumps(plan.as_json()))

    @property
    def process_id(self) -> int:
        return self._process.pid

    def trouble(self) -> str:
        """Describe what has gone wrong so far; empty if nothing has. One system call, no waiting."""
        self._listen(0.0)
        return self._trouble

    @property
    def gone(self) -> bool:
        """True if no process drains the rings any longer."""
        self._listen(0.0)
        return self._told.ended

    def wait_ready(self) -> None:
        """Return when the logger drains. Error: RecordingFailed."""
        self._await(READY, lambda: self._listen(_ANSWER_MAX_S))

    def confirm(self, wait: Callable[[], None]) -> None:
        """Return when all that was recorded until now is in the files; ``wait`` lets a little time pass.

        Error: RecordingFailed.
        """
        self._say(CONFIRM)

        def listen() -> str | None:
            answer = self._listen(0.0)
            if answer is None and not self._trouble:
                wait()
            return answer

        self._await(STORED, listen)

    def finish(self, outcome: RunOutcome) -> Summary | None:
        """Tell how the run ended and wait for the summary; None if the logger gives none."""
        self._say(json.dumps(asdict(outcome)))
        clock = MonotonicClock()
        deadline = Instant(clock.now() + int(_FINISH_MAX_S * NS_PER_S))
        while not self._told.ended and clock.now() < deadline:
            answer = self._listen(1.0)
            if answer is not None and answer not in (READY, STORED):
                self._end()
                return from_plain(Summary, json.loads(answer))
        if not self._told.ended:
            self._trouble = self._trouble or f"the logger did not finish within {_FINISH_MAX_S:.0f} s"
        self._end()
        return None

    def _await(self, answer: str, listen: Callable[[], str | None]) -> None:
        clock = MonotonicClock()
        deadline = Instant(clock.now() + int(_ANSWER_MAX_S * NS_PER_S))
        while listen() != answer:
            if self._trouble:
                raise RecordingFailed(self._trouble)
            if clock.now() > deadline:
                raise RecordingFailed(f"the logger did not answer within {_ANSWER_MAX_S:.0f} s: {_TOO_SLOW}")

    def _listen(self, timeout_s: float) -> str | None:
        """The next answer that has come; what tells of trouble is kept apart."""
        line = self._told.line(timeout_s)
        if line is None:
            if self._told.ended and not self._trouble:
                self._trouble = self._death()
            return None
        if line.startswith(FAILED):
            self._trouble = self._trouble or line.removeprefix(FAILED)
            return None
        return line

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            """It is dead, which the end of its output tells."""

    def _death(self) -> str:
        try:
            status = self._process.wait(_REAP_MAX_S)
        except subprocess.TimeoutExpired:
            return "the logger closed its output"
        how = f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        said = last_line(self._log)
        return f"the logger {how}: {said}" if said else f"the logger {how}"

    def _end(self) -> None:
        """It has nothing left to say; one that does not end by itself is ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            """Nobody reads it."""
        try:
            self._process.wait(_REAP_MAX_S if self._told.ended else 0.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def start_python(module: str, descriptors: Sequence[int], log: Path | None) -> subprocess.Popen[str]:
    """A program of ours that gets the rings' descriptors as arguments; ``log`` takes its standard error."""
    with open(log or "/dev/null", "a") as errors:
        return subprocess.Popen(
            python_command(module, *map(str, descriptors)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            pass_fds=descriptors,
            # a session of its own: an interrupt from the terminal is for the loop, not for the logger
            start_new_session=True,
            # Rerun's analytics are off wherever CI is set
            env=python_environment(CI="1"),
        )


def last_line(log: Path | None) -> str:
    """Return the last line that a process of ours wrote to its standard error."""
    if log is None or not log.exists():
        return ""
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def salvage(plan: RecordingPlan, descriptors: Sequence[int], outcome: RunOutcome, trouble: str) -> Summary:
    """Finish the recording of a dead logger in a process of its own.

    The rings still hold what the logger had not taken. Error: RecordingFailed.
    """
    assert plan.folder is not None
    log = plan.folder / LOGGER_LOG
    wanted = {"plan": plan.as_json(), "outcome": asdict(outcome), "trouble": trouble}
    process = start_python("servobench.hil.recording.recovery", descriptors, log)
    try:
        answer, _ = process.communicate(json.dumps(wanted), timeout=_FINISH_MAX_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        answer = ""
    if not answer:
        raise RecordingFailed(f"{trouble}; {plan.folder} holds what was written: hil recover {plan.folder}")
    return from_plain(Summary, json.loads(answer))


_POLL_NS = NS_PER_MS


class RecordingWatch:
    """Ends a run that is not recorded any more, or lets it go on if that was asked for."""

    def __init__(
        self, recorder: RunRecorder, goes_on: bool, progress: Progress, say: Callable[[str, str], None]
    ) -> None:
        """``goes_on``: a run goes on unrecorded. ``say``: takes a text for the reader and its level."""
        self._recorder = recorder
        self._goes_on = goes_on
        self._progress = progress
        self._say = say
        self._phase = "running"

    def confirm(self, network: "CanopenNetwork") -> None:
        """All so far is in the files, or nothing may move. Raises RecordingFailed.

        The bus is served meanwhile, but simulated time stands still, paced or not: no run depends on
        how fast its logger starts.
        """
        wall = MonotonicClock()
        simulated = isinstance(network.clock, SimulatedClock)
        serve = wall.sleep_until if simulated else network.pump

        def wait() -> None:
            serve(Instant(wall.now() + _POLL_NS))

        self._recorder.confirm(wait)

    def attend(self, elapsed_s: float) -> None:
        """So much of the loop is done, s. Raises RecordingFailed, which is told before the drives stop."""
        trouble = "" if self._phase != "running" else self._recorder.trouble()
        if trouble:
            self._phase = f"not recorded: {trouble}"
        self._progress(self._phase, elapsed_s)
        if trouble and not self._goes_on:
            raise RecordingFailed(trouble)
        if trouble:
            self._say(self._phase, "CRITICAL")
