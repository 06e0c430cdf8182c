"""The parent of a command (:mod:`servobench.hil.terminal.supervision`), as the command sees it.

A command's output does not use the descriptors 0 to 2: user code may close, fill or redirect these. Results
are collected, and handed over whole with the exit status. Messages, and what the user's code prints, go into
pipes of their own that never block: a terminal that is stopped, full or gone costs text, and no cycle.
Without a parent, as under pytest, all of it is sys.stdout and sys.stderr.
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
"""The limit for a process without privileges (pipe(7)): a second of a controller that prints a line of 1 kB
in each cycle of 1 ms, while the parent does not run."""
_PR_SET_PDEATHSIG: Final = 1
"""<linux/prctl.h>"""
_write: Final = os.write
"""The function before user code may replace it."""


class Pipes(NamedTuple):
    """Descriptors of one end of the three pipes between a command and its parent."""

    told: int
    """Lines of JSON: data that the parent needs to end in the command's place, and finally its result."""
    messages: int
    """For stderr as it is."""
    printed: int
    """Output of user code."""


class Terminals(NamedTuple):
    """Which of the parent's streams are terminals."""

    stdout: bool
    stderr: bool


class StreamEnd(io.RawIOBase):
    """Accepts every write; data for a full pipe, a closed one, or a full disk are lost."""

    def __init__(self, descriptor: int, on_terminal: bool) -> None:
        self._descriptor = descriptor
        self._on_terminal = on_terminal
        self.trouble: OSError | None = None
        """Cause of the first loss."""

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self._on_terminal

    def fileno(self) -> int:
        return self._descriptor

    def close(self) -> None:
        """Do nothing: the process writes to it until its end, even if sys.stderr is closed."""

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left:
                left = left[_write(self._descriptor, left) :]
        except OSError as error:  # nothing is owed to a reader who does not read
            self.trouble = self.trouble or error
        return size


class KeptBuffer(io.BufferedWriter):
    """A buffer before a :class:`StreamEnd`, which is not closed either.

    Python 3.13 prints that a second close, that of the interpreter's end, failed.
    """

    def close(self) -> None:
        """Flush."""
        self.flush()


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
        """Notify the parent; do nothing in a copy of this process forked by user code."""
        if os.getpid() != self._owner:
            return
        line = memoryview(json.dumps(what).encode() + b"\n")
        try:
            while line:
                line = line[_write(self._told, line) :]
        except OSError:
            """The user's code has closed it, which the parent takes for the end of this process."""

    def tell_result(self, status: int) -> None:
        """Report that the command is done: its exit status, and its output."""
        assert isinstance(self.results, _Collected)
        self.tell(status=status, results=self.results.getvalue())


_parent: ParentProcess | None = None
"""Belongs to the process, like its standard streams."""


def live_under(pipes: Pipes, terminals: Terminals, parent: int) -> ParentProcess:
    """Make this process, a child just forked, run under ``parent``: it dies with it."""
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
    """Notify the parent, if there is one.

    ``bus``, ``bitrate`` and ``nodes``: moved by this command. ``recording`` and ``logger``: its folder, and
    the recording process. ``concluded``: the command's result: ``status``, and for a run ``digest`` and
    ``recording``. ``own_code``: user code runs from now on. ``intact``: after an error, the program's
    functions are unchanged since before that code ran. ``error``: cause of an early end. ``advice``: its
    cure. ``released``: False if the end may have kept it from bringing its drives to rest.
    """
    if _parent is not None:
        _parent.tell(**what)


def has_parent() -> bool:
    """Return True if this process, or the one that it was forked from, is that of a command."""
    return _parent is not None


def results() -> TextIO:
    """Return the stream for the results of a command: stdout holds nothing else."""
    return sys.stdout if _parent is None else _parent.results


def messages() -> TextIO:
    """Return the stream for a command's progress: stderr."""
    return sys.stderr if _parent is None else _parent.messages


def _text(descriptor: int, on_terminal: bool) -> TextIO:
    end = StreamEnd(descriptor, on_terminal)
    # the buffer of a text stream may be raw where each write goes through, as in python -u
    return io.TextIOWrapper(end, encoding="utf-8", errors="backslashreplace", write_through=True)  # type: ignore[type-var]
