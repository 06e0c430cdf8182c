"""Turns functions into commands of ``hil``.

Errors go to stderr and into the exit status. A function's parameters are its options, as are the fields of a
parameter that is a dataclass: a command with many options passes them on as one.
"""

import inspect
import re
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from enum import EnumType
from functools import wraps
from typing import Any, Final, Literal, NoReturn, get_args, get_origin

import typer
from typer import Abort, BadParameter, Exit
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command_name

from servobench.drivers.errors import BenchError, printable
from servobench.hil.machine.extras import missing_extra
from servobench.hil.machine.parent_process import messages, tell_parent
from servobench.hil.machine.refusals import explained, raised_by_own_code
from servobench.hil.terminal.output import say
from servobench.hil.verdict.verdict import ExitStatus

_USAGE_ERROR: type[Exception] = BadParameter.__bases__[0]
"""Misuse of any kind, of a command that does not exist too."""


@contextmanager
def reported_errors(
    conclude: Callable[[int, str], int] = lambda status, _text: status, command: str = "this"
) -> Iterator[None]:
    """Print an error from inside on stderr and leave with its exit status.

    ``conclude``: called with that status and the error in words, right before; returns the status to leave
    with.
    ``command``: the words of the command, for an error that it lacks a package.
    """
    try:
        yield
    except BenchError as error:
        raise Exit(_told(error, conclude)) from None
    except KeyboardInterrupt:
        say("interrupted")
        tell_parent(error="interrupted")
        raise Exit(conclude(ExitStatus.INTERRUPTED, "interrupted")) from None
    except (Exception, SystemExit, GeneratorExit) as error:
        # a defect, or code of the user's that calls sys.exit(): neither leaves with the status of a verdict
        if isinstance(error, Exit | Abort | BadParameter) and not raised_by_own_code(error):
            raise
        tell_parent(released=False)
        if known := missing_extra(error, command) or explained(error):
            raise Exit(_told(known, conclude)) from None
        traceback.print_exc(file=messages())
        text = f"{type(error).__name__}: {error}"
        tell_parent(error=text)
        raise Exit(conclude(ExitStatus.DEFECT, text)) from None


def _told(error: BenchError, conclude: Callable[[int, str], int]) -> int:
    say(error_text(error))
    tell_parent(error=str(error))
    return conclude(error.exit_status, str(error))


def end_with(status: int) -> NoReturn:
    """Leave with ``status``: the command has come to its end. The parent is notified, and believes no 0
    otherwise: user code may have replaced ``sys.exit``, or raised the exception that ends a command."""
    tell_parent(concluded={"status": status})
    raise Exit(status)


def error_text(error: BenchError) -> str:
    """Format an error for the user: one line, or one line for each of several."""
    lines = [printable(line) for line in str(error).split("\n")]
    if len(lines) == 1:
        return f"hil: error: {lines[0]}"
    return "\n".join([f"hil: {len(lines)} errors:", *(f"  {line}" for line in lines)])


PANELS: Final = ("Run", "Inspect", "Commission", "Design", "Review")
"""Panels of ``hil --help``, the most used first."""


UNITS: Final = frozenset({"us", "ms", "s", "rpm", "ppm", "percent", "deg", "c"})
"""Last words of options' names that say the unit of the value."""
LETTERS: Final = {int: "N", float: "X", str: "TEXT"}


def value_shown(item: Any) -> str | None:
    """Return what help shows for the value of an option that names none: ``cst|csv``, ``MS``, ``N``."""
    kind: Any = item.type_descriptor.annotation
    if isinstance(kind, EnumType):
        members: Any = kind
        return "|".join(str(each.value) for each in members)
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    unit = item.opts[0].rpartition("-")[2]
    return unit.upper() if unit in UNITS else LETTERS.get(kind)


def _without_values(options: list[Any]) -> list[Any]:
    """Show no value beside flags that typer itself adds: it writes ``<bool>`` there."""
    for option in options:
        if getattr(option, "is_bool_flag", False) and option.metavar is None:
            option.metavar = ""
    return options


def _in_our_words(misuse: BadParameter) -> BadParameter:
    """Tell a value that typer's model refuses as a value in a file is told."""
    from pydantic import ValidationError

    from servobench.hil.configuration.config_files import found_and_expected

    if not misuse.message and (help_text := getattr(misuse.param, "help", None)):
        misuse.message = f"Expected: {help_text}".replace("\\[", "[")  # of a parameter that is missing
    if isinstance(misuse.__cause__, ValidationError):
        misuse.message = found_and_expected(misuse.__cause__.errors()[0])
    return misuse


class PlainCommand(TyperCommand):
    """Shows values as the field names them and none beside ``--help``, and tells a value that it refuses."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        item: Any
        for item in self.params:
            if item.param_type_name == "argument":
                item.display_type_rich = lambda ctx: None  # its name says what it is
            elif item.metavar is None:
                item.metavar = value_shown(item)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words. Raises BadParameter."""
        try:
            return super().parse_args(ctx, args)
        except BadParameter as misuse:
            raise _in_our_words(misuse) from None

    def get_params(self, ctx: Any) -> list[Any]:
        """Return arguments and options."""
        return _without_values(super().get_params(ctx))


class PlainGroup(TyperGroup):
    """Shows no value beside ``--help``."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return arguments and options."""
        return _without_values(super().get_params(ctx))


class PanelGroup(PlainGroup):
    """Lists commands by panel, in the order of :data:`PANELS`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; a file in its place is told the command that runs it."""
        try:
            return super().resolve_command(ctx, args)
        except _USAGE_ERROR as error:
            misuse: Any = error
            if args[0].endswith(".toml"):
                misuse.message += f" A bench file is run by: hil run {args[0]}"
            raise

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
        group.command(cls=PlainCommand, rich_help_panel=panel)(as_command(function, f"hil {words}"))


def leave_only(app: typer.Typer, words: Sequence[str]) -> None:
    """Take every command out of ``app`` but the one that ``words`` begin with, if there is one.

    Typer builds all options of all commands before it looks at the words: 3 ms a command.
    """
    named = words[0] if words else ""
    commands = [each for each in app.registered_commands if _name_of(each) == named]
    groups = [each for each in app.registered_groups if _name_of(each) == named]
    if commands or groups:
        app.registered_commands, app.registered_groups = commands, groups
    for group in groups:
        if group.typer_instance is not None:
            leave_only(group.typer_instance, words[1:])


def _name_of(each: Any) -> str:
    """Return the name of a command or group that is registered."""
    name = each.name or (each.typer_instance.info.name if hasattr(each, "typer_instance") else None)
    return str(name or get_command_name(each.callback.__name__))


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
    command.__doc__ = _reflowed(inspect.getdoc(function) or "")
    command.__annotations__ = {option.name: option.annotation for option in options}
    return command


def _reflowed(text: str) -> str:
    """Return ``text`` with each paragraph in one line, which the terminal breaks, but for indented lines."""
    return re.sub(r"(?<=\S)\n(?=\S)", " ", text)


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
