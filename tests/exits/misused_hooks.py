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

from servobench import (
    Compensator,
    Context,
    Controller,
    Sample,
    SetPoint,
    Setup,
    StateEstimate,
    TorqueSetPoint,
)

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


FIRST = ("__init__", "channels", "observer", "reset", "observer.reset")
"""Hooks that are called before the first cycle."""


class Observing(Compensator):
    """Of :class:`Hooks`; its hooks are of the same kind."""

    HOOKS = ("observer.reset", "receive", "sent", "estimate")

    def __init__(self, act: Callable[[str], None]) -> None:
        self._act = act
        self._sequence = 0

    def reset(self) -> None:
        self._act("observer.reset")

    def receive(self, sample: Sample) -> None:
        self._sequence = sample.sequence
        self._act("receive")

    def sent(self, _command: object) -> None:
        self._act("sent")

    def estimate(self, context: Context) -> StateEstimate:
        self._act("estimate")
        return StateEstimate(0.0, 0.0, 0.0, context.acts_at, self._sequence)


class Hooks(Controller):
    """Does ``way``, a Python statement, in the hook ``where`` of its 20th cycle."""

    def __init__(
        self, _setup: Setup, where: str = "", way: str = "", tally: str = "", torque_nm: float = 0.0
    ) -> None:
        self._where, self._way, self._torque_nm = where, way, torque_nm
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        self._tally = os.open(tally, flags) if tally else None  # which may be 0, where that was closed
        self._cycles = 0
        self.act("__init__")

    def act(self, where: str) -> None:
        """Do ``way`` if this is the hook and the cycle."""
        if where == self._where and (self._cycles == 20 or where in FIRST):
            exec(self._way, globals())

    def channels(self) -> Sequence[str]:
        self.act("channels")
        return ()

    def observer(self) -> Compensator | None:
        self.act("observer")
        return Observing(self.act) if self._where in Observing.HOOKS else None

    def reset(self) -> None:
        self.act("reset")

    def output(self, _context: Context) -> SetPoint:
        self._cycles += 1
        self.act("output")
        return TorqueSetPoint(self._torque_nm)

    def update(self, _context: Context, _command: object) -> None:
        self.act("update")
        if self._tally is not None:
            _write(self._tally, b".")

    def telemetry(self) -> Sequence[float]:
        self.act("telemetry")
        return ()


def check(_seed: int, run: Callable[[], object]) -> list[str]:
    """Do the way that the environment names in a campaign's check, before its run."""
    exec(os.environ.get("HOOKS_IN_CHECK", "pass"), globals())
    run()
    return []


if way := os.environ.get("HOOKS_AT_IMPORT"):
    exec(way, globals())

__all__ = ("atexit", "ctypes", "signal", "sys")
