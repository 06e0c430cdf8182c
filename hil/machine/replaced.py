"""Functions of other modules that user code has replaced.

If ``time.monotonic_ns`` is replaced the bench fails anywhere, and no user call is on the stack. So after a
failure the modules and their classes are compared with their contents before user code first ran: this costs
no cycle time.
"""

import sys
from collections.abc import Iterator, Mapping
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, NamedTuple

from servobench.hil.machine.held_process import OWN_FILES
from servobench.hil.machine.parent_process import has_parent, tell_parent

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
