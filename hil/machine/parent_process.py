"""The parent that a command runs under (:mod:`servobench.hil.terminal.supervision`), as the command sees it.

What a command prints does not leave its process by the descriptors 0 to 2: code of the user's may close, fill
or redirect these. Results are collected, and handed over whole with the exit status. Messages, and what the
user's code prints, go into pipes of their own that never block: a terminal that is stopped, full or gone
costs text, and no cycle. Without a parent, as under pytest, all of it is sys.stdout and sys.stderr.
"""

import ctypes
import faulthandler
import fcntl
import io
import json
import os
import signal
import sys
from typing import Any, Final, NamedTuple, TextIO

PIPE_BYTES: Final = 1 << 20
"""As much as a process without privileges may ask for (pipe(7)): a second of a controller that prints a line
of 1 kB in each cycle of 1 ms, while the parent does not get its turn."""
_PR_SET_PDEATHSIG: Final = 1
"""<linux/prctl.h>"""
_write: Final = os.write
"""As it is before code of the user's may put another in its place."""


class Pipes(NamedTuple):
    """Descriptors of one end of the three pipes between a command and its parent."""

    told: int
    """Lines of JSON: what the parent must know to end in the command's stead, and at last its result."""
    messages: int
    """For stderr as it is."""
    printed: int
    """What the user's code prints."""


class Terminals(NamedTuple):
    """Which of the parent's streams a person looks at."""

    stdout: bool
    stderr: bool


class StreamEnd(io.RawIOBase):
    """Takes every write; what finds a pipe full, nobody at its other end, or no room on a disk, is lost."""

    def __init__(self, descriptor: int, on_terminal: bool) -> None:
        self._descriptor = descriptor
        self._on_terminal = on_terminal
        self.trouble: OSError | None = None
        """Why the first write that was lost was."""

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self._on_terminal

    def fileno(self) -> int:
        return self._descriptor

    def close(self) -> None:
        """Nothing: the process writes to it until its end, whoever closes sys.stderr."""

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left:
                left = left[_write(self._descriptor, left) :]
        except OSError as error:  # nothing is owed to a reader who does not read
            self.trouble = self.trouble or error
        return size


class _Collected(io.StringIO):
    """The results of a command, until they are handed over."""

    def __init__(self, on_terminal: bool) -> None:
        super().__init__()
        self._on_terminal = on_terminal

    def isatty(self) -> bool:
        return self._on_terminal


class ParentProcess:
    """The ends of the pipes that a command holds."""

    def __init__(self, pipes: Pipes, terminals: Terminals) -> None:
        self._told = pipes.told
        self._owner = os.getpid()
        self.results: TextIO = _Collected(terminals.stdout)
        self.messages = _text(pipes.messages, terminals.stderr)
        self.printed = _text(pipes.printed, on_terminal=False)

    def tell(self, **what: Any) -> None:
        """Let the parent know; nothing from a copy of this process that the user's code has forked."""
        if os.getpid() != self._owner:
            return
        line = memoryview(json.dumps(what).encode() + b"\n")
        try:
            while line:
                line = line[_write(self._told, line) :]
        except OSError:
            """The user's code has closed it, which the parent takes for the end of this process."""

    def tell_result(self, status: int) -> None:
        """The command is done: its exit status, and what it has printed."""
        assert isinstance(self.results, _Collected)
        self.tell(status=status, results=self.results.getvalue())


_parent: ParentProcess | None = None
"""Of the process, as its standard streams are."""


def live_under(pipes: Pipes, terminals: Terminals, parent: int) -> ParentProcess:
    """Make this process, a child just forked, one that runs under ``parent``: it dies with it."""
    global _parent
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)  # it died before it could be watched
    for end in (pipes.messages, pipes.printed):
        os.set_blocking(end, False)
        fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    os.dup2(pipes.printed, 1)
    os.dup2(pipes.messages, 2)
    _parent = ParentProcess(pipes, terminals)
    sys.stdout, sys.stderr = _parent.printed, _parent.messages
    faulthandler.enable(pipes.messages)  # a crash in native code names the line that led to it
    return _parent


def tell_parent(**what: Any) -> None:
    """Let the parent know, if there is one.

    ``bus``, ``bitrate`` and ``nodes``: that this command moves. ``recording`` and ``logger``: its folder, and
    the process that records. ``concluded``: what the command came to: ``status``, and of a run ``digest`` and
    ``recording``. ``own_code``: code of the user's runs from now on. ``intact``: an error was looked at, and
    nothing of what the program is made of is another than before that code ran. ``error``: what ends it
    early. ``advice``: what mends an early end. ``released``: False if what ended it may have kept it from
    bringing its drives to rest.
    """
    if _parent is not None:
        _parent.tell(**what)


def has_parent() -> bool:
    """Whether this process, or the one that it was forked from, is that of a command."""
    return _parent is not None


def results() -> TextIO:
    """Where the results of a command go: stdout holds nothing else."""
    return sys.stdout if _parent is None else _parent.results


def messages() -> TextIO:
    """Where a command says what it does: stderr."""
    return sys.stderr if _parent is None else _parent.messages


def _text(descriptor: int, on_terminal: bool) -> TextIO:
    end = StreamEnd(descriptor, on_terminal)
    # the buffer of a text stream may be raw where each write goes through, as in python -u
    return io.TextIOWrapper(end, encoding="utf-8", errors="backslashreplace", write_through=True)  # type: ignore[type-var]
