"""The processes of a recorder, forked from one that has imported all that they need.

A logger that is started anew imports for a second, for a run of a tenth of that. What is forked here is a
process of its own as well, with the same program, pipes, rings and end; that a new interpreter finds its way
is the business of tests/scenario/test_recording_failures.py.
"""

import os
import select
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from unittest.mock import patch

from servobench.hil.machine.stopping import STOP_SIGNALS
from servobench.hil.recording import logger, logger_process, recorder, recovery

_PROGRAMS = {
    "servobench.hil.recording.logger": logger.main,
    "servobench.hil.recording.recovery": recovery.main,
}
_NEVER_S = 1e6
ROWS: Final = 1 << 12
FRAMES: Final = 1 << 15
"""Room in the rings: more than a case fills, so that what a dead logger leaves is there; little to map."""


class ForkedProcess:
    """As much of ``subprocess.Popen`` as the recorder uses."""

    def __init__(self, program: Callable[[], int], descriptors: Sequence[int], log: Path | None) -> None:
        """``descriptors``: left open, and the arguments of ``program``; ``log`` takes its standard error."""
        to_read, to_write = os.pipe()
        from_read, from_write = os.pipe()
        errors = os.open(log or os.devnull, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self.pid = os.fork()
        if not self.pid:
            for place, own in enumerate((to_read, from_write, errors)):
                os.dup2(own, place)
            _become(program, descriptors)
        for other in (to_read, from_write, errors):
            os.close(other)
        self.stdin, self.stdout = os.fdopen(to_write, "w"), os.fdopen(from_read)
        self._status: int | None = None
        self._ended = os.pidfd_open(self.pid)

    def wait(self, timeout: float | None = None) -> int:
        """Its status, negative the signal that killed it. Error: subprocess.TimeoutExpired."""
        if self._status is None:
            limit_s = _NEVER_S if timeout is None else timeout
            if not select.select([self._ended], [], [], limit_s)[0]:
                raise subprocess.TimeoutExpired("forked", limit_s)
            self._status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            os.close(self._ended)
        return self._status

    def kill(self) -> None:
        """At once."""
        if self._status is None:
            os.kill(self.pid, signal.SIGKILL)

    def communicate(self, text: str = "", timeout: float | None = None) -> tuple[str, None]:
        """What it prints before it ends."""
        try:
            self.stdin.write(text)
            self.stdin.close()
        except BrokenPipeError:
            """It did not live to read it."""
        self.wait(timeout)
        return self.stdout.read(), None


def _become(program: Callable[[], int], descriptors: Sequence[int]) -> None:
    """Be a process of which nothing is left but ``program``, and never return."""
    status = 1
    try:
        sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
        _close_others({0, 1, 2, *descriptors, *_KEPT})
        for number in STOP_SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        sys.argv = ["", *map(str, descriptors)]
        status = program()
        sys.stdout.flush()
    finally:
        try:
            if status:
                traceback.print_exc()
        finally:
            os._exit(status)


def _close_others(kept: set[int]) -> None:
    for name in os.listdir("/proc/self/fd"):
        if int(name) not in kept:
            try:
                os.close(int(name))
            except OSError:
                """It was that of the list itself."""


_KEPT: set[int] = set()


@contextmanager
def forked_loggers(
    kept: int, disturbed: Callable[[Callable[[], int]], Callable[[], int]]
) -> Iterator[list[ForkedProcess]]:
    """Inside, recorders fork their processes; the list has them, the logger of a run first.

    ``kept``: a descriptor that stays open in them. ``disturbed``: given the logger's program, what is to be
    run in its place.
    """
    started: list[ForkedProcess] = []

    def start(module: str, descriptors: Sequence[int], log: Path | None) -> ForkedProcess:
        program = _PROGRAMS[module]
        started.append(ForkedProcess(program if started else disturbed(program), descriptors, log))
        return started[-1]

    _KEPT.add(kept)
    rings = patch.multiple(recorder, ROWS_CAPACITY=ROWS, FRAMES_CAPACITY=FRAMES)
    with rings, patch.object(logger_process, "start_python", start):
        yield started
    _KEPT.discard(kept)
