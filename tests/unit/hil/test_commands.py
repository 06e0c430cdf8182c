"""How a function becomes a command: options out of a class of them, errors as exit statuses."""

import re
from dataclasses import dataclass
from typing import Annotated

import typer
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.commands import add_commands

Text = Annotated[str, typer.Option("--text", help="What is said.")]
Times = Annotated[int, typer.Option("--times", min=1, help="How often.")]
Loud = Annotated[bool, typer.Option("--loud", help="In capitals.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Voice:
    """How it is said."""

    times: Times = 2
    loud: Loud = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Speech:
    """What is said, and how."""

    text: Text
    voice: Voice
    end: Annotated[str, typer.Option("--end", help="Behind it.")] = "."


def say(name: Annotated[str, typer.Argument()], speech: Speech) -> None:
    """Say it."""
    if speech.text == "nothing":
        raise BadInput("--text", "", speech.text, "something")
    text = speech.text.upper() if speech.voice.loud else speech.text
    typer.echo(f"{name}: {' '.join([text] * speech.voice.times)}{speech.end}")


def broken() -> None:
    """A defect."""
    raise ValueError("of the program")


APP = typer.Typer()
add_commands(APP, say, broken)


def output(*arguments: str, status: int = 0) -> str:
    done = CliRunner().invoke(APP, arguments)
    assert done.exit_code == status, done.output
    return done.output


def test_fields_of_a_class_are_options_with_their_defaults() -> None:
    assert output("say", "Ann", "--text", "yes") == "Ann: yes yes.\n"
    assert output("say", "Ann", "--text", "yes", "--times", "1", "--loud", "--end", "!") == "Ann: YES!\n"


def test_a_field_without_a_default_is_needed_and_bounds_hold() -> None:
    assert "--text" in output("say", "Ann", status=2)
    assert "--times" in output("say", "Ann", "--text", "yes", "--times", "0", status=2)


def test_the_page_has_them_in_their_order() -> None:
    page = output("say", "--help")
    assert "Say it." in page
    assert re.findall(r"--(?:text|times|loud|end)\b", page) == ["--text", "--times", "--loud", "--end"]


def test_errors_leave_with_their_exit_status() -> None:
    assert "hil: error: --text: found 'nothing', expected something" in output(
        "say", "Ann", "--text", "nothing", status=2
    )
    assert "ValueError: of the program" in output("broken", status=70)
