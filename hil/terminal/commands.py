"""Turns functions into commands of ``hil``.

Errors go to stderr and into the exit status. A function's parameters are its options, as are the fields of a
parameter that is a dataclass: a command with many options passes them on as one.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from functools import wraps
from typing import Any, Final

import typer
from typer.core import TyperGroup

from servobench.hil.terminal.exit_status import reported_errors

PANELS: Final = ("Run", "Inspect", "Commission", "Design", "Review")
"""Panels of ``hil --help``, the most used first."""


class PanelGroup(TyperGroup):
    """Lists commands by panel, in the order of :data:`PANELS`."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands, as its help shows them."""
        return sorted(super().list_commands(ctx), key=lambda name: PANELS.index(self.panel_of(name)))

    def panel_of(self, name: str) -> str:
        """Return the panel of a command."""
        return str(getattr(self.commands[name], "rich_help_panel", None))


def add_commands(group: typer.Typer, *functions: Callable[..., None], panel: str | None = None) -> None:
    """Add each function under its own name; ``panel``: one of :data:`PANELS`."""
    place = group.info.name
    for function in functions:
        words = function.__name__ if place in (None, "hil") else f"{place} {function.__name__}"
        group.command(rich_help_panel=panel)(as_command(function, f"hil {words}"))


def as_command(function: Callable[..., None], words: str = "this") -> Callable[..., None]:
    """Return ``function`` as typer takes it: a dataclass among its parameters is replaced by its fields.

    ``words``: the command, as it is typed.
    """

    @wraps(function)
    def command(**values: Any) -> None:
        with reported_errors(command=words):
            _called(function, values)

    options = list(_options(function))
    vars(command)["__signature__"] = inspect.Signature(options)
    command.__annotations__ = {option.name: option.annotation for option in options}
    return command


def _options(taker: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """Yield the options of a function, or of a class of options."""
    for parameter in inspect.signature(taker).parameters.values():
        if _is_options(parameter.annotation):
            yield from _options(parameter.annotation)
        else:
            yield parameter.replace(kind=parameter.KEYWORD_ONLY)


def _called(taker: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    given = {
        name: _called(each.annotation, values) if _is_options(each.annotation) else values[name]
        for name, each in inspect.signature(taker).parameters.items()
    }
    return taker(**given)


def _is_options(annotation: Any) -> bool:
    return isinstance(annotation, type) and is_dataclass(annotation)
