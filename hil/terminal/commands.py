"""How a function becomes a command of ``hil``.

What goes wrong in it is told on stderr and by the exit status. Its options are its parameters, and the fields
of a dataclass that one of these is of: a command with many options hands them on as one.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from functools import wraps
from typing import Any

import typer

from servobench.hil.terminal.exit_status import reported_errors


def add_commands(group: typer.Typer, *functions: Callable[..., None]) -> None:
    """Each under its own name."""
    place = group.info.name
    for function in functions:
        words = function.__name__ if place in (None, "hil") else f"{place} {function.__name__}"
        group.command()(as_command(function, f"hil {words}"))


def as_command(function: Callable[..., None], words: str = "this") -> Callable[..., None]:
    """``function`` as typer takes it: a dataclass among its parameters gives way to its fields.

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
    """Of a function, or of a class of options."""
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
