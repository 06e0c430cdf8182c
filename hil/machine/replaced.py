"""What the user's code has put in the place of functions that are not its own.

Where ``time.monotonic_ns`` is another function the bench fails anywhere, and no call of the user's is on the
way. So it is looked for once something has failed, by what stood in all modules before code of the user's
first ran: nothing of it costs a cycle.
"""

import sys
from types import ModuleType
from typing import Any, Final

from hil.machine.held_process import OWN_FILES
from hil.machine.parent_process import has_parent

_TO_BE_REPLACED: Final = "hook"
"""How names end that Python looks up in order to be given others: sys.excepthook."""
_NAMED_MOST: Final = 3


class Modules:
    """What stood in them."""

    def __init__(self) -> None:
        self._before: dict[str, tuple[ModuleType, dict[str, Any]]] = {}
        self._path: list[str] = []

    def remember(self) -> None:
        """Code of the user's may run next. A module that is remembered already stays as it was then."""
        self._path = self._path or [*sys.path]
        for name, module in list(sys.modules.items()):
            # a lazy one, of a class of its own, would be loaded by the question
            if name in self._before or type(module) is not ModuleType:
                continue
            held = dict(vars(module))
            if held.get("__file__") not in OWN_FILES:
                self._before[name] = module, held

    def replaced(self) -> str:
        """Names of functions, classes and modules that are others now, or gone; empty if none is."""
        names = [] if set(self._path) <= set(sys.path) else ["sys.path"]
        for name, (module, held) in self._before.items():
            if sys.modules.get(name) is not module:
                names.append(f"sys.modules[{name!r}]")
            now = vars(module)
            names += [
                f"{name}.{key}"
                for key, value in held.items()
                if now.get(key) is not value and callable(value) and not key.endswith(_TO_BE_REPLACED)
            ]
        names.sort()
        more = len(names) - _NAMED_MOST
        return ", ".join(names[:_NAMED_MOST]) + (f" and {more} more" if more > 0 else "")


_of_process: Final = Modules()


def remember_modules() -> None:
    """In a command's process. Elsewhere, as under pytest, others have reasons to replace functions."""
    if has_parent():
        _of_process.remember()


def replaced() -> str:
    """As :meth:`Modules.replaced`; empty outside of a command's process."""
    return _of_process.replaced()
