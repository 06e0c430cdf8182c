"""Dialogue with the user: on a terminal, or unattended (``--yes``).

While waiting for an answer the bench keeps running: heartbeats are sent and stop signals are noticed.
"""

import os
import select
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from typing import IO, Any

from servobench.hil.machine.parent_process import messages
from servobench.hil.machine.stopping import StopRequest

Idle = Callable[[], None]
"""Lets a little time pass on the bus; may raise."""


class Choice(Enum):
    """The next action."""

    GO = "go"
    REPEAT = "repeat"
    SKIP = "skip"
    QUIT = "quit"


class Dialog:
    """Unattended (``--yes``): every step is done, and a failed one is not repeated."""

    attended = False
    """True if a user can be asked."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """``tell`` prints a message."""
        self.tell = tell

    def choose(self, _question: str, choices: tuple[Choice, ...], _idle: Idle) -> Choice:
        """Return the first of ``choices``."""
        return choices[0]

    def line(self, _question: str, _idle: Idle) -> str:
        """Return an empty line."""
        return ""


_KEYS = {Choice.GO: "Enter", Choice.REPEAT: "r", Choice.SKIP: "s", Choice.QUIT: "q"}


class Terminal(Dialog):
    """Attended: questions and answers by line."""

    attended = True

    def __init__(self, source: IO[str], tell: Callable[[str], None]) -> None:
        super().__init__(tell)
        self._source = source

    def choose(self, question: str, choices: tuple[Choice, ...], idle: Idle) -> Choice:
        """Ask until one of the keys comes; the end of the input means quit."""
        offered = ", ".join(f"{_KEYS[choice]} = {choice.value}" for choice in choices)
        while True:
            self.tell(f"{question} [{offered}]")
            answer = self._read(idle)
            if answer is None:
                return Choice.QUIT
            for choice in choices:
                if answer.strip().lower() in (choice.value, _KEYS[choice] if choice is not Choice.GO else ""):
                    return choice

    def line(self, question: str, idle: Idle) -> str:
        """Ask for one line."""
        self.tell(question)
        return (self._read(idle) or "").strip()

    def _read(self, idle: Idle) -> str | None:
        while not select.select([self._source], [], [], 0.0)[0]:
            idle()
        text = self._source.readline()
        return text or None


class EmergencyStop:
    """Stop signals, and any key while the shaft may turn."""

    def __init__(self, signals: StopRequest | None = None, source: IO[Any] | None = None) -> None:
        """``source``: the keyboard; None: there is none."""
        self._signals = signals
        self._descriptor = _terminal(source)
        self._armed = False
        self.key = False
        """True if a key was hit while it was armed."""

    def __call__(self) -> bool:
        """Return True to stop now."""
        if self._armed and not self.key and select.select([self._descriptor], [], [], 0.0)[0]:
            os.read(self._descriptor, 1024)
            self.key = True
        return self.key or (self._signals is not None and self._signals())

    @property
    def asked_by(self) -> str:
        """The signal that requested the end; empty if none did."""
        return "" if self._signals is None else self._signals.asked_by

    @contextmanager
    def armed(self) -> Iterator[None]:
        """Inside, single keys are noticed at once; the terminal is restored afterwards."""
        if self._descriptor < 0:
            yield
            return
        before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor, termios.TCSANOW)
        self._armed, self.key = True, False
        try:
            yield
        finally:
            self._armed = False
            termios.tcsetattr(self._descriptor, termios.TCSANOW, before)


def _terminal(source: IO[Any] | None) -> int:
    """Return the descriptor of a keyboard; -1 for anything else."""
    try:
        return source.fileno() if source is not None and source.isatty() else -1
    except (OSError, ValueError):
        return -1


def say(text: str) -> None:
    """Print on stderr; a missing reader is no reason to abandon a drive."""
    with suppress(OSError):
        print(text, file=messages(), flush=True)
