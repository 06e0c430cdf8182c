"""What commands print: one JSON object or text on stdout, tables of it, and what is said beside on stderr."""

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
    """``figures`` as one JSON object, or as ``show`` prints them."""
    if as_json:
        echo(json.dumps(figures, allow_nan=False))
    else:
        show(figures)


def write_line(text: str) -> None:
    """On stdout, of a command that has very many; at once if somebody looks on."""
    sys.stdout.write(f"{text}\n")
    if sys.stdout.isatty():
        sys.stdout.flush()


def echo(text: str) -> None:
    """A line of a command's results, on stdout."""
    typer.echo(text, file=results())


def note_seal(run: Path, seal: str) -> None:
    """Say of a recording that it is not sealed, or not up to its end; --unsealed has said so itself."""
    from servobench.hil.rows.seal import NOT_CHECKED, SEALED

    if seal not in ("", SEALED, NOT_CHECKED):
        say(f"hil: note: {run}: {seal}")


def say(text: str) -> None:
    """On stderr, at once."""
    print(text, file=messages(), flush=True)


def on_terminal(text: str) -> None:
    """On stderr, if somebody looks on: what is being done."""
    if messages().isatty():
        say(text)


def say_written(path: Path) -> None:
    """Which file there is now, on stderr."""
    say(f"written {path}")


def columns(*titles: str, right: tuple[str, ...] = (), **options: Any) -> "Table":
    """A table without lines; ``right``: titles of figures, whose columns end alike. ``options``: of rich."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", show_header=bool(titles))
    for title in titles:
        table.add_column(title, justify="right" if title in right else "left", **options)
    return table


def titled(lines: Mapping[str, str], **options: Any) -> "Table":
    """A line each behind its title; ``options``: of rich, for the lines."""
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
    """Figures by name, tables inside one another; ``text``: how one is written."""
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
    """A figure of a speed loop; a dash for one that is not there."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.7g}" if isinstance(value, float) else str(value)
