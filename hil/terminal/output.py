"""Output of the commands: one JSON object or text on stdout, tables, and notes on stderr."""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from servobench.hil.machine.parent_process import messages, results

if TYPE_CHECKING:
    from rich.table import Table

T = TypeVar("T", bound="dict[str, Any]")


def put(figures: T, as_json: bool, show: Callable[[T], None]) -> None:
    """Print ``figures`` as one JSON object, or by ``show``."""
    if as_json:
        echo(json.dumps(figures, allow_nan=False))
    else:
        show(figures)


def write_line(text: str) -> None:
    """Print one of very many lines on stdout; at once if it is a terminal."""
    sys.stdout.write(f"{text}\n")
    if sys.stdout.isatty():
        sys.stdout.flush()


def echo(text: str) -> None:
    """Print a line of a command's results, on stdout."""
    typer.echo(text, file=results())


def note_seal(run: Path, seal: str) -> None:
    """Note that a recording is not sealed, or not up to its end; --unsealed has already said so."""
    from servobench.hil.rows.seal import NOT_CHECKED, SEALED

    if seal not in ("", SEALED, NOT_CHECKED):
        say(f"hil: note: {run}: {seal}")


def say(text: str) -> None:
    """Print on stderr, at once."""
    print(text, file=messages(), flush=True)


def on_terminal(text: str) -> None:
    """Print the present activity on stderr, if it is a terminal."""
    if messages().isatty():
        say(text)


def say_written(path: Path) -> None:
    """Name a written file, on stderr."""
    say(f"written {path}")


def columns(*titles: str, right: tuple[str, ...] = (), **options: Any) -> "Table":
    """Make a table without lines; ``right``: titles of figures, whose columns are right-aligned. ``options``:
    of rich."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", show_header=bool(titles))
    for title in titles:
        table.add_column(title, justify="right" if title in right else "left", **options)
    return table


def titled(lines: Mapping[str, str], **options: Any) -> "Table":
    """Make a line for each title; ``options``: of rich, for the lines."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(**options)
    for title, line in lines.items():
        # Text, because a plain string's square brackets would be read as markup.
        table.add_row(title, Text(line))
    return table


def print_figures(
    figures: dict[str, Any], indent: str = "", *, text: Callable[[Any], str] | None = None,
    width: int = 26, gap: str = "   ",
) -> None:  # fmt: skip
    """Print figures by name, tables nested; ``text``: formats one."""
    text = text or figure_text
    for key, value in figures.items():
        if isinstance(value, dict):
            echo(f"{indent}{key}")
            print_figures(value, indent + "  ", text=text, width=width, gap=gap)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            echo(f"{indent}{key}")
            for item in value:
                echo(f"{indent}  " + gap.join(f"{name} {text(part)}" for name, part in item.items()))
        else:
            shown = "  ".join(map(text, value)) if isinstance(value, list) else text(value)
            echo(f"{indent}{key:<{width}} {shown}")


def figure_text(value: Any) -> str:
    """Format a figure of a speed loop; a dash for a missing one."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.7g}" if isinstance(value, float) else str(value)
