"""Every page of ``--help`` says what its source says."""

import re
from collections.abc import Iterator
from functools import cache

import pytest
import typer
from typer.testing import CliRunner

from servobench.drivers.compiled import ROOMS
from servobench.hil.cli import app
from servobench.hil.machine.extras import docs_folder
from tests.told import ROOT

_PAGE = re.compile(r"(?:see |full: |\(|; )hil docs ([a-z-]+)")
_BRACKETS = re.compile(r"\[[^\[\]]+\]")


def _below(command: object, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    yield words, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from _below(inner, (*words, name))


COMMANDS = dict(_below(typer.main.get_command(app)))
"""Each command and group by its words."""
LEAVES = [words for words, command in COMMANDS.items() if not hasattr(command, "commands")]


@cache
def _page(words: tuple[str, ...], columns: int = 160) -> str:
    return CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": str(columns)}).stdout


def _examples(words: tuple[str, ...]) -> list[str]:
    return re.findall(r"^ +(hil .*)$", getattr(COMMANDS[words], "help", None) or "", re.MULTILINE)


def _flat(text: str) -> str:
    return re.sub(r"[\s│]+", "", text)


@pytest.mark.long
def test_nothing_in_brackets_is_eaten_as_markup() -> None:
    for words, command in COMMANDS.items():
        texts = [getattr(command, "help", None) or ""]
        texts += [getattr(item, "help", None) or "" for item in getattr(command, "params", ())]
        page = _flat(_page(words))
        assert page, words
        for text in texts:
            for part in _BRACKETS.findall(text.replace("\\[", "[")):
                assert _flat(part) in page, (words, part)


def test_a_value_is_named_as_the_field_names_it_and_never_by_its_type() -> None:
    for words in COMMANDS:
        assert "--help" in _page(words), words
        assert re.findall(r"<[a-z%][^ =]*( range)?>", _page(words)) == [], words


def test_the_value_of_an_option_is_its_unit_its_choices_or_a_letter() -> None:
    page = _page(("eds",))
    shown = dict(re.findall(r"│ (--[a-z-]+) +(\S+)", page))
    assert shown["--node"] == "N"
    assert (shown["--period-us"], shown["--bitrate"]) == ("US", "BIT/S")
    assert shown["--mode"] == "cst|csv|csp|ip|vl|pt|pv|pp"


def test_help_sends_nobody_to_a_file_of_the_checkout() -> None:
    assert [words for words in COMMANDS if "docs/" in _page(words)] == []


def test_every_page_that_a_text_of_the_product_names_is_there() -> None:
    named = {
        page
        for room in ROOMS
        for path in (ROOT / room).rglob("*.py")
        for page in _PAGE.findall(path.read_text(encoding="utf-8"))
    }
    assert {"exit-status", "writes", "campaigns"} <= named
    assert {page for page in named if not (docs_folder() / f"{page}.md").exists()} == set()


def test_a_command_shows_itself_typed_each_in_a_line_of_a_narrow_terminal() -> None:
    for words in LEAVES:
        examples, page = _examples(words), _page(words, 80)
        shown = {line.split()[1] for line in examples}
        assert words[0] in shown
        assert shown <= {words[0], "run"}, "beside its own a run that it reads"
        assert [line for line in examples if line not in page] == []


def test_a_paragraph_is_broken_by_the_terminal_alone() -> None:
    for words in LEAVES:
        told, _, _ = (getattr(COMMANDS[words], "help", None) or "").partition("\nExamples:")
        assert re.findall(r"\S\n\S", told.strip()) == [], words
