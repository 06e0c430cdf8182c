"""Keeps user code inside the call made to it, in the process that made the call.

``os._exit(0)`` there would end pytest, a campaign's worker or a run with the status of a success; another
program in this one's place would, too; and a copy that ``os.fork`` has left would come back a second time and
command the same drives. Native code is handled by the parent process
(:mod:`servobench.hil.terminal.supervision`).
"""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

COPY_STATUS: Final = 70
"""Exit status of a forked copy that would have returned; only the code that forked it waits for it."""

OWN_FILES: Final[set[str]] = set()
"""Files of the user code that was called."""


_DEPTH: Final = sys.getrecursionlimit()


class LeftProcess(BaseException):
    """User code would have ended this process. Not an Exception: code that catches those goes on."""


FAILURES: Final = (Exception, SystemExit, GeneratorExit, LeftProcess)
"""Exceptions that user code may raise while Ctrl-C still is one: all but that. SystemExit would end the
process with its own status, 0 included."""


class _Calls(threading.local):
    """Calls of one thread."""

    depth = 0
    process = 0


_CALLS: Final = _Calls()


def enter_call() -> None:
    """Note that a call of user code begins in this thread."""
    if not _CALLS.depth:
        _CALLS.process = os.getpid()
    _CALLS.depth += 1


def leave_call() -> None:
    """Note its return; in a copy of the process it never returns. The stack may be as deep as before."""
    _CALLS.depth -= 1
    if sys.getrecursionlimit() < _DEPTH:
        sys.setrecursionlimit(_DEPTH)
    if os.getpid() != _CALLS.process:
        os._exit(COPY_STATUS)


@contextmanager
def held_process() -> Iterator[None]:
    """Wrap a call of user code. It raises LeftProcess instead of ending the process, and in place of anything
    that is neither an Exception nor one of Python's own requests to end."""
    enter_call()
    try:
        yield
    except (Exception, SystemExit, GeneratorExit, KeyboardInterrupt, LeftProcess):
        raise
    except BaseException as error:
        raise LeftProcess(told(error)) from error
    finally:
        leave_call()


def in_words(thing: object, how: Callable[[object], str] = str) -> str:
    """Format ``thing`` of the user's by its own ``__str__``, or by ``how``, which may end in any way."""
    try:
        with held_process():
            return how(thing)
    except (*FAILURES, KeyboardInterrupt) as error:
        return f"what cannot be told ({type(error).__name__})"


def told(error: BaseException) -> str:
    """Return the kind of an error and, if it has any, its words."""
    return f"{type(error).__name__}: {in_words(error)}".removesuffix(": ")


def _refusing(name: str) -> Callable[..., Any]:
    leave = getattr(os, name)

    def refuse(*arguments: Any) -> Any:
        if _CALLS.depth and os.getpid() == _CALLS.process:
            raise LeftProcess(f"os.{name}({', '.join(map(repr, arguments[:1]))})")
        return leave(*arguments)

    return refuse


for _name in ("_exit", "execv", "execve"):  # all others of the family call one of these
    setattr(os, _name, _refusing(_name))
