"""Every option of every command, told whole: its type, its range, and what holds if it is absent."""

import re
from collections.abc import Iterator
from enum import EnumType
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.terminal.commands import PANELS
from tests.told import hold

TOLD = Path(__file__).with_name("told") / "options.txt"


def commands(command: Any, words: tuple[str, ...] = ("hil",)) -> Iterator[str]:
    """A line for each command or group, and one for each of its options."""
    told = " (alone: its help)" if command.no_args_is_help else ""
    yield f"{' '.join(words)}{' (hidden)' if command.hidden else ''}{told}"
    for item in command.params:
        if "completion" in item.name:  # typer's own
            continue
        yield " " + parameter(item)
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*words, name))


def parameter(item: Any) -> str:
    """``--gamma G: float from 1e-09``."""
    kind: Any = item.type_descriptor.annotation
    how = [f"{', '.join([*item.opts, *item.secondary_opts])} {item.metavar or ''}".rstrip() + ":"]
    members: Any = kind if isinstance(kind, EnumType) else ()
    choices = get_args(kind) if get_origin(kind) is Literal else [str(each.value) for each in members]
    how.append("|".join(choices) or getattr(kind, "__name__", str(kind)))
    how += [f"{word} {end!r}" for word, end in (("from", item.min), ("to", item.max)) if end is not None]
    marks = {
        "required": item.required,
        "repeated": item.nargs == -1 or item.multiple,
        "flag": getattr(item, "is_flag", False),
        "hidden": item.hidden,
    }
    how += [mark for mark, holds in marks.items() if holds]
    if item.default not in (None, "") and not item.required:
        how.append(f"else {getattr(item.default, 'value', item.default)!s}")
    return " ".join(how)


def test_the_help_page_groups_every_command_the_most_used_first() -> None:
    page = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "100"}).output
    places = [page.index(f" {panel} ─") for panel in PANELS]
    assert places == sorted(places)
    names = [
        line.split()[1]
        for line in commands(typer.main.get_command(app))
        if re.fullmatch(r"hil \S+( \(.*)?", line)
    ]
    assert [name for name in names if f"│ {name} " not in page] == []
    assert page.index("│ run ") < min(page.index(f"│ {name} ") for name in names if name != "run")


def test_every_option_is_what_it_was() -> None:
    """To the last digit: a limit that is doubled is another limit."""
    text = "\n".join(commands(typer.main.get_command(app))) + "\n"
    hold(text, TOLD)
    assert TOLD.read_text(encoding="utf-8") == text
