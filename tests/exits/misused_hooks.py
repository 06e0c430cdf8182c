"""A user's controller whose hooks end, take or spoil their process, in a way of the bench's choice.

It imports ``hil`` alone, as that of a user does, and counts its cycles in a file, a byte each.
"""

import atexit
import ctypes
import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from hil import Context, Controller, SetPoint, Setup, TorqueSetPoint

_write = os.write
"""What the way to end puts in its place is not to spoil the count of cycles."""


def thread(function: Callable[[], object]) -> None:
    """Run ``function`` in a thread of its own, and wait until it has run."""
    (started := threading.Thread(target=function)).start()
    started.join()


def left_thread() -> None:
    """Leave a thread behind that never ends."""
    threading.Thread(target=threading.Event().wait).start()


def held_pipes() -> None:
    """Leave a process behind that holds every descriptor, for a while."""
    if not os.fork():
        threading.Event().wait(20.0)
        os._exit(0)


def fork_and(function: Callable[[], object]) -> None:
    """Have a copy of the process do it, too."""
    os.fork()
    function()


def overflow() -> None:
    """Print more than any pipe takes."""
    for _ in range(40):
        print("x" * 100_000)


def alarmed() -> None:
    """Have a handler of a signal end the process a millisecond later, wherever it is then."""
    signal.signal(signal.SIGALRM, lambda _signal, _frame: sys.exit(0))
    signal.setitimer(signal.ITIMER_REAL, 0.001)


def traced() -> None:
    """Have a trace function end whatever is called next."""
    sys.settrace(lambda *_: sys.exit(0))


def put(name: str, value: object = None) -> None:
    """Put ``value`` in the place of what ``name`` says, as MODULE:NAME or MODULE:CLASS.NAME."""
    module, _, path = name.partition(":")
    *owners, key = path.split(".")
    owner: object = importlib.import_module(module)
    for each in owners:
        owner = getattr(owner, each)
    setattr(owner, key, value)


def stopped() -> None:
    """Stop the process, and have the command's parent asked to end once it is."""
    process, parent = os.getpid(), os.getppid()
    if not os.fork():
        while Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "T":
            pass
        os.kill(parent, signal.SIGTERM)
        os._exit(0)
    os.kill(process, signal.SIGSTOP)


class Hooks(Controller):
    """Does ``way``, a Python statement, in the hook ``where`` of its 20th cycle."""

    def __init__(self, _setup: Setup, where: str = "", way: str = "", tally: str = "") -> None:
        self._where, self._way = where, way
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        self._tally = os.open(tally, flags) if tally else None  # which may be 0, where that was closed
        self._cycles = 0
        self._act("__init__")

    def _act(self, where: str) -> None:
        if where == self._where and (self._cycles == 20 or where in ("__init__", "channels", "reset")):
            exec(self._way, globals())

    def channels(self) -> Sequence[str]:
        self._act("channels")
        return ()

    def reset(self) -> None:
        self._act("reset")

    def output(self, _context: Context) -> SetPoint:
        self._cycles += 1
        self._act("output")
        return TorqueSetPoint(0.0)

    def update(self, _context: Context, _command: object) -> None:
        self._act("update")
        if self._tally is not None:
            _write(self._tally, b".")

    def telemetry(self) -> Sequence[float]:
        self._act("telemetry")
        return ()


if way := os.environ.get("HOOKS_AT_IMPORT"):
    exec(way, globals())

__all__ = ("atexit", "ctypes", "signal", "sys")
