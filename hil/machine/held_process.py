"""Keeps user code inside the call made to it, in the process that made the call.

``os._exit(0)`` there would end pytest, a campaign's worker or a run with the status of a success; another
program in this one's place would, too; and a copy that ``os.fork`` has left would come back a second time and
command the same drives. Native code is handled by the parent process
(:mod:`servobench.hil.terminal.supervision`).

Functions of other modules that user code has replaced.

If ``time.monotonic_ns`` is replaced the bench fails anywhere, and no user call is on the stack. So after a
failure the modules and their classes are compared with their contents before user code first ran: this costs
no cycle time.
"""

import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, NamedTuple

from servobench.hil.machine.parent_process import has_parent, tell_parent

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


_TO_BE_REPLACED: Final = "hook"
"""Suffix of names meant to be replaced, such as sys.excepthook."""
_NAMED_MOST: Final = 3
_IMMUTABLE: Final = 1 << 8
"""Py_TPFLAGS_IMMUTABLETYPE of <object.h>: a class into which nothing can be put."""


class _Held(NamedTuple):
    """Former contents of a module or a class."""

    owner: ModuleType | type
    values: dict[str, Any]
    codes: dict[str, CodeType]
    """Codes of its functions: one may be given that of another."""


class Modules:
    """Former contents of all modules."""

    def __init__(self) -> None:
        self._before: dict[str, _Held] = {}
        self._classes: dict[type, tuple[str, _Held]] = {}
        self._path: list[str] = []

    def remember(self) -> None:
        """Remember the modules: user code may run next. A module already remembered stays as it was then."""
        self._path = self._path or [*sys.path]
        for name, module in list(sys.modules.items()):
            # a lazy one, of a class of its own, would be loaded by the question
            if name in self._before or type(module) is not ModuleType:
                continue
            held = _held(module)
            if held.values.get("__file__") in OWN_FILES:
                continue
            self._before[name] = held
            for value in held.values.values():
                # by its type: an object may answer the question for its class with an error
                if issubclass(type(value), type):
                    self._remember_class(value)

    def _remember_class(self, asked: type) -> None:
        for each in type.mro(asked) if asked is not type else ():
            if each not in self._classes and not each.__flags__ & _IMMUTABLE:
                self._classes[each] = f"{each.__module__}.{each.__qualname__}", _held(each)

    def replaced(self) -> str:
        """Return names of functions, classes and modules that were replaced or removed; empty if none."""
        names = [] if set(self._path) <= set(sys.path) else ["sys.path"]
        for name, held in self._before.items():
            if sys.modules.get(name) is not held.owner:
                names.append(f"sys.modules[{name!r}]")
            names += [f"{name}.{key}" for key in _others(held) if not key.endswith(_TO_BE_REPLACED)]
        for name, held in self._classes.values():
            names += [f"{name}.{key}" for key in _others(held)]
        names.sort()
        more = len(names) - _NAMED_MOST
        return ", ".join(names[:_NAMED_MOST]) + (f" and {more} more" if more > 0 else "")


def _held(owner: ModuleType | type) -> _Held:
    values = dict(vars(owner))
    codes = {key: value.__code__ for key, value in values.items() if type(value) is FunctionType}
    return _Held(owner, values, codes)


def _others(held: _Held) -> Iterator[str]:
    """Yield keys with another function or class now, or none."""
    now: Mapping[str, Any] = vars(held.owner)
    for key, value in held.values.items():
        if now.get(key) is not value:
            if callable(value) or hasattr(type(value), "__get__"):
                yield key
        elif (code := held.codes.get(key)) is not None and now[key].__code__ is not code:
            yield key


_of_process: Final = Modules()
_is_watched = False


def watch_for_replacements() -> None:
    """Watch this process, one of the bench's own: every replacement here is the user's."""
    global _is_watched
    _is_watched = True


def remember_modules() -> None:
    """Remember the modules in a command's process, and in one that watches. Elsewhere, as under pytest,
    others have reasons to replace functions."""
    if has_parent() or _is_watched:
        tell_parent(own_code=True)
        _of_process.remember()


def replaced() -> str:
    """Return :meth:`Modules.replaced`; empty in a process that remembers none."""
    return _of_process.replaced()
