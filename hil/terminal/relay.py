"""The path of a command's output through the parent: a terminal that does not accept it blocks nobody.

One thread reads all three pipes at once; another one writes to stderr, which may block for ever.
"""

import json
import os
import select
import signal
import threading
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from servobench.hil.machine.parent_process import Pipes
from servobench.hil.rows.run_files import PRINTED_FILE
from servobench.hil.verdict.verdict import ExitStatus

PRINTED_MARK: Final = b"printed: "
"""Prefix of each line on stderr that the user's code has printed."""
WAITING_MAX: Final = 1 << 20
"""Bytes waiting for a stderr that does not accept them; any excess is counted and lost."""
LINE_MAX: Final = 1 << 16
"""A longer printed line is cut into several."""
_SETTLE_S: Final = 0.2
"""Wait for earlier messages to reach the terminal before results follow; a stuck stderr is not waited for."""
_DRAIN_S: Final = 5.0
"""Limit for a stderr that is no terminal; at a terminal the user may continue with Ctrl-Q, any time later."""


class Relay:
    """The relay of one command."""

    def __init__(self, pipes: Pipes, reader: int) -> None:
        """``pipes``: the reading ends. ``reader``: the thread that is woken by SIGCHLD when :attr:`result` or
        :attr:`told_ended` changes."""
        self.known: dict[str, Any] = {}
        """Everything that the command has reported about itself."""
        self.result: dict[str, Any] | None = None
        """``status`` and ``results``; None: not reported."""
        self.told_ended = False
        """True once the command can no longer report anything."""
        self._pipes, self._reader = pipes, reader
        self._partial = {descriptor: b"" for descriptor in pipes}
        self._printed = _PrintedFile()
        self._stderr = _Stderr()
        self._over, over = os.pipe()
        self._end = over
        self._thread = threading.Thread(target=self._read_all, daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Print a line on stderr."""
        self._stderr.put(f"{text}\n".encode("utf-8", "backslashreplace"))

    def finish(self) -> None:
        """Take the rest of the pipes after the command's end; the user's processes may hold them open."""
        os.close(self._end)
        self._thread.join()
        if rest := self._partial[self._pipes.printed]:
            self._take_printed(rest + b"\n")
        self._printed.close()
        if self._printed.trouble:
            self.say(f"hil: note: {PRINTED_FILE}: {self._printed.trouble}")

    def settle(self) -> None:
        """Wait until stderr has taken the earlier messages."""
        self._stderr.wait(_SETTLE_S)

    def drain(self) -> None:
        """Wait until stderr has taken everything, before this process ends."""
        self._stderr.wait(None if os.isatty(2) else _DRAIN_S)

    def _read_all(self) -> None:
        poll = select.poll()
        for descriptor in (*self._pipes, self._over):
            poll.register(descriptor, select.POLLIN)
        open_ends, over = len(self._pipes), False
        while open_ends:
            ready = [descriptor for descriptor, _ in poll.poll(0 if over else None)]
            if self._over in ready:
                over = True
                poll.unregister(self._over)
                ready.remove(self._over)
            elif over and not ready:
                return
            for descriptor in ready:
                data = os.read(descriptor, 1 << 16)
                if data:
                    self._take(descriptor, data)
                    continue
                poll.unregister(descriptor)
                open_ends -= 1
                if descriptor == self._pipes.told:
                    self.told_ended = True
                    signal.pthread_kill(self._reader, signal.SIGCHLD)

    def _take(self, descriptor: int, data: bytes) -> None:
        if descriptor == self._pipes.messages:
            self._stderr.put(data)
            return
        lines, newline, rest = (self._partial[descriptor] + data).rpartition(b"\n")
        if descriptor == self._pipes.told:
            self._partial[descriptor] = rest
            for line in lines.splitlines():
                self._take_told(_as_told(line))
            return
        if len(rest) > LINE_MAX:
            lines, newline, rest = lines + newline + rest, b"\n", b""
        self._partial[descriptor] = rest
        self._take_printed(lines + newline)

    def _take_told(self, what: dict[str, Any]) -> None:
        if "status" in what:
            self.result = what
            signal.pthread_kill(self._reader, signal.SIGCHLD)
            return
        self.known |= what
        if folder := what.get("recording"):
            self._printed.begin(Path(folder))

    def _take_printed(self, lines: bytes) -> None:
        self._printed.write(lines)
        self._stderr.put(b"".join(PRINTED_MARK + line for line in lines.splitlines(keepends=True)))


def _as_told(line: bytes) -> dict[str, Any]:
    """Parse a report of the command; empty for a line in any other form, as from a command whose
    ``json.dumps`` was replaced."""
    try:
        what = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    if not isinstance(what, dict):
        return {}
    if "status" in what:
        return what if _is_result(what) else {}
    return {key: value for key, value in what.items() if key in _TOLD and _TOLD[key](value)}


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_number(value: Any) -> bool:
    return type(value) is int and 0 < value < 1 << 31


def _is_truth(value: Any) -> bool:
    return isinstance(value, bool)


def _is_status(value: Any) -> bool:
    return type(value) is int and value in set(ExitStatus)


def _is_result(value: Any) -> bool:
    return _is_status(value["status"]) and _is_text(value.get("results"))


def _is_end(value: Any) -> bool:
    words = (value.get("digest", ""), value.get("recording", "")) if isinstance(value, dict) else ()
    return bool(words) and _is_status(value.get("status")) and all(map(_is_text, words))


_TOLD: Final[Mapping[str, Callable[[Any], bool]]] = {
    "bus": _is_text,
    "bitrate": _is_number,
    "nodes": lambda value: isinstance(value, list) and all(map(_is_number, value)),
    "recording": _is_text,
    "logger": _is_number,
    "concluded": _is_end,
    "error": _is_text,
    "advice": _is_text,
    "released": _is_truth,
    "own_code": _is_truth,
    "intact": _is_truth,
}
"""Checks of the values for :func:`servobench.hil.machine.parent_process.tell_parent`."""


class _PrintedFile:
    """Output of the user's code, in the recording's folder: from its first line on."""

    def __init__(self) -> None:
        self.trouble = ""
        """Why it is not complete."""
        self._folder: Path | None = None
        self._descriptor = -1
        self._early = b""

    def begin(self, folder: Path) -> None:
        """Begin the file; earlier output goes into it too."""
        self._folder = folder
        early, self._early = self._early, b""
        self.write(early)

    def write(self, lines: bytes) -> None:
        if self.trouble or not lines:
            return
        if self._folder is None:
            self._early = (self._early + lines)[-WAITING_MAX:]
            return
        try:
            if self._descriptor < 0:
                flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
                self._descriptor = os.open(self._folder / PRINTED_FILE, flags, 0o644)
            write_all(self._descriptor, lines)
        except OSError as error:
            self.trouble = str(error.strerror)

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)


class _Stderr:
    """Takes any text at once; a thread writes it."""

    def __init__(self) -> None:
        self._waiting: deque[bytes] = deque()
        self._bytes = self._lost = 0
        self._changed = threading.Condition()
        threading.Thread(target=self._write, daemon=True).start()

    def put(self, data: bytes) -> None:
        with self._changed:
            if self._bytes > WAITING_MAX:
                self._lost += len(data)
                return
            if self._lost:
                data = b"\nhil: note: %d bytes were lost here\n%b" % (self._lost, data)
                self._lost = 0
            self._waiting.append(data)
            self._bytes += len(data)
            self._changed.notify_all()

    def wait(self, timeout_s: float | None) -> None:
        """Wait until nothing is left to write."""
        with self._changed:
            self._changed.wait_for(lambda: not self._bytes, timeout_s)

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                data = self._waiting.popleft()
            try:
                write_all(2, data)
            except OSError:
                """Full, closed, or a terminal that is gone: what is said there is owed to nobody."""
            with self._changed:
                self._bytes -= len(data)
                self._changed.notify_all()


def write_all(descriptor: int, data: bytes) -> None:
    """Write all of it; may block. Error: OSError."""
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]
