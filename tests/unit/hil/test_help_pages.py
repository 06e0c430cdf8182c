"""Every page of ``--help`` says what its source says."""

import re
from collections.abc import Iterator

import pytest
import typer
from typer.testing import CliRunner

from servobench.hil.cli import app

_BRACKETS = re.compile(r"\[[^\[\]]+\]")


def _pages() -> Iterator[tuple[str, ...]]:
    """The words of each command and group."""

    def below(command: object, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        yield words
        for name, inner in getattr(command, "commands", {}).items():
            yield from below(inner, (*words, name))

    yield from below(typer.main.get_command(app), ())


def _command(words: tuple[str, ...]) -> object:
    command: object = typer.main.get_command(app)
    for word in words:
        command = command.commands[word]  # type: ignore[attr-defined]
    return command


def _flat(text: str) -> str:
    return re.sub(r"[\s│]+", "", text)


@pytest.mark.long
@pytest.mark.parametrize("words", list(_pages()), ids=" ".join)
def test_nothing_in_brackets_is_eaten_as_markup(words: tuple[str, ...]) -> None:
    command = _command(words)
    texts = [getattr(command, "help", None) or ""]
    texts += [getattr(item, "help", None) or "" for item in getattr(command, "params", ())]
    page = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "160"}).stdout
    assert page
    for text in texts:
        for part in _BRACKETS.findall(text.replace("\\[", "[")):
            assert _flat(part) in _flat(page), part


@pytest.mark.parametrize("words", list(_pages()), ids=" ".join)
def test_what_takes_no_value_shows_none(words: tuple[str, ...]) -> None:
    page = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "160"}).stdout
    own = [line for line in page.splitlines() if not re.search("--help|-completion", line)]  # typer adds them
    assert "<bool>" not in "".join(own)
