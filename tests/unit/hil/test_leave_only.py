"""A process builds the options of the command that it was asked for, and of no other."""

import typer

from servobench.hil.terminal.commands import add_commands, leave_only


def first() -> None:
    """Do one thing."""


def second_one() -> None:
    """Do another."""


def named(command: object, place: str = "") -> set[str]:
    """Every command below ``command``, as it is typed."""
    inner = getattr(command, "commands", None)
    if inner is None:
        return {place}
    return {name for word, each in inner.items() for name in named(each, f"{place} {word}".strip())}


def left(*words: str) -> set[str]:
    app = typer.Typer(name="hil")
    group = typer.Typer(name="group")
    add_commands(app, first, second_one)
    add_commands(group, first, second_one)
    app.add_typer(group)
    leave_only(app, words)
    return named(typer.main.get_group(app))


ALL = {"first", "second-one", "group first", "group second-one"}


def test_what_is_named_is_left_alone() -> None:
    assert left("first", "--option") == {"first"}
    assert left("second-one") == {"second-one"}
    assert left("group", "second-one", "first") == {"group second-one"}
    assert left("group", "file.toml") == {"group first", "group second-one"}


def test_all_are_left_where_none_is_named() -> None:
    for words in ((), ("--help",), ("second_one",), ("frist",)):
        assert left(*words) == ALL
